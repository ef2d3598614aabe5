"""Noise of recorded controls: weights against linear algebra, responses against simulations."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.search.noisy_inputs import noisy_inputs
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.input_noise import disturbances
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.process_noise import ProcessNoise, weighting
from bo_sysid.diagnosis.windows.windowing import nothing, prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

STEP, SIGMA, NOISE = 0.004, 1e-4, 0.1  # [s], [rad], [N m]
XML = """<mujoco><option timestep="0.004" integrator="implicitfast"/><worldbody><body>
<joint name="a" axis="0 1 0" damping=".1" frictionloss="{rub}"/>
<geom size=".05" pos="0 0 -.3" mass="1"/></body></worldbody>
<actuator><motor name="drive" joint="a"/></actuator></mujoco>"""
LOOKED_FOR = ("dry_friction", "viscous_damping", "joint_spring", "armature", "actuator_delay")


def evidence(
    *,
    rub: float = 0.0,
    measured: float = 0.0,
    sent: float = 0.0,
    late: int = 0,
    seconds: float = 20,
) -> Evidence:
    """What a pendulum does, of whose torque noise was `measured`, or `sent` and arrived `late`."""
    plant = mujoco.MjModel.from_xml_string(XML.format(rub=rub))
    plant.opt.timestep = STEP / 4
    data, rng = mujoco.MjData(plant), np.random.default_rng(5)
    time = STEP * np.arange(round(seconds / STEP))
    u = sum(np.sin(2 * np.pi * f * time + p) for f, p in ((0.31, 0.1), (0.83, 2.0), (1.9, 4.0)))
    u = u + sent * rng.standard_normal(len(time))
    arrived = np.concatenate([np.repeat(u[0], late), u])[: len(u)]
    q = np.zeros(len(u))
    for k in range(len(u)):
        q[k], data.ctrl[0] = data.qpos[0], arrived[k]
        mujoco.mj_step(plant, data, nstep=4)
    q += SIGMA * rng.standard_normal(len(q))
    shown = u + measured * rng.standard_normal(len(u))
    recording = Recording.from_arrays(time, qpos={"a": q}, ctrl={"drive": shown})
    effects = [e for e in CATALOGUE.values() if e.id in LOOKED_FOR]
    model = Model.from_xml(XML.format(rub=0))
    return make_evidence(model, [recording], effects=effects, noise={"qpos": SIGMA}, threads=1)


def searched(made: Evidence) -> Search:
    """Return the search at its beginning."""
    prepared = prepare(windows_of(made, 40, STEP))
    return Search.on(prepared, list(made.candidates), made.most, None)


def test_weights_are_the_inverse_root_of_the_covariance() -> None:
    A = np.random.default_rng(0).normal(size=(3, 7, 4)) * [1e-3, 0.3, 1.0, 30.0]
    Q = weighting(A)
    root = np.eye(7) - Q @ Q.transpose(0, 2, 1)
    covariance = np.eye(7) + A @ A.transpose(0, 2, 1)
    assert np.allclose(root @ covariance @ root, np.eye(7), atol=5e-3)
    few = ProcessNoise(A, Q, np.zeros((3, 9, 1)), np.zeros((3, 7))).beginning(5, 6)
    root = np.eye(5) - few.basis @ few.basis.transpose(0, 2, 1)
    assert np.allclose(root @ covariance[:, :5, :5] @ root, np.eye(5), atol=5e-3)
    assert few.controls.shape == (3, 6, 1)


def test_likely_noise_is_the_mean_given_what_is_left() -> None:
    rng = np.random.default_rng(1)
    A, left = rng.normal(size=(2, 6, 3)), rng.normal(size=(2, 6))
    found = ProcessNoise.about(A, np.zeros((2, 1, 1)), np.zeros((2, 3))).likely(left)
    for a, r, xi in zip(A, left, found, strict=True):
        joint = np.block([[np.eye(3), a.T], [a, a @ a.T + np.eye(6)]])  # of noise and what is left
        assert xi == pytest.approx(joint[:3, 3:] @ np.linalg.solve(joint[3:, 3:], r))


def test_the_response_has_the_covariance_of_simulations_with_drawn_noise() -> None:
    made = evidence(seconds=6)
    problem = windows_of(made, 40, STEP)
    start = problem.windows.start
    linear = linearise(problem, nothing(problem), start)
    A = disturbances(linear, {"drive": NOISE})[0][0]
    model, rng, draws = problem.compiled(nothing(problem))[0], np.random.default_rng(2), 1500
    ctrl = np.repeat(problem.windows.ctrl[:1], draws, axis=0)
    ctrl = ctrl + NOISE * rng.standard_normal(ctrl.shape)  # one value a control, as it was sampled
    many = start.rows(np.zeros(draws, int))
    q = problem.engine.rollout(model, many, ctrl).qpos[..., 0]
    seen = q[:, problem.windows.step[0][: problem.windows.observed.shape[1]]]
    covariance = np.cov(seen.T) / SIGMA**2
    assert np.allclose(np.sqrt(np.diag(A @ A.T))[5:], np.sqrt(np.diag(covariance))[5:], rtol=0.1)
    late, early = -1, 20
    told = (A @ A.T)[early, late] / np.sqrt((A @ A.T)[early, early] * (A @ A.T)[late, late])
    drawn = covariance[early, late] / np.sqrt(covariance[early, early] * covariance[late, late])
    assert told == pytest.approx(drawn, abs=0.03)


def test_noise_of_a_slow_control_is_that_of_its_own_samples_beside_fast_ones() -> None:
    made = evidence(seconds=4)
    (fast,) = made.recordings
    drive = fast.channels["ctrl.drive"]
    thinned = replace(drive, time=drive.time[::10], values=drive.values[::10])
    slow = replace(fast, name="slow", channels={**fast.channels, "ctrl.drive": thinned})

    def done(*recordings: Recording) -> list[np.ndarray]:
        problem = windows_of(replace(made, recordings=recordings), 40, STEP)
        linear = linearise(problem, nothing(problem), problem.windows.start)
        A, courses = disturbances(linear, {"drive": NOISE})
        drawn = np.ones((len(A), A.shape[2]))
        added = (courses.added(drawn) ** 2).mean(axis=(1, 2))
        of = problem.windows.recording
        return [
            np.array([(A[of == k] ** 2).sum(axis=2).mean(), added[of == k].mean()])
            for k in range(len(recordings))
        ]

    (alone,), (quick,) = done(slow), done(fast)
    assert alone[0] > 5 * quick[0]
    for found, wanted in zip(done(fast, slow, fast), (quick, alone, quick), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=0.05)


def test_noise_that_was_measured_is_told_from_noise_that_was_sent() -> None:
    measured = noisy_inputs(searched(evidence(measured=NOISE)))
    assert measured == {"drive": pytest.approx(NOISE, rel=0.1)}
    assert not noisy_inputs(searched(evidence(sent=NOISE)))
    assert not noisy_inputs(searched(evidence(sent=NOISE, late=2)))
    assert not noisy_inputs(searched(evidence()))


def test_a_log_too_short_for_a_spectrum_has_no_noise() -> None:
    assert not noisy_inputs(searched(evidence(measured=NOISE, seconds=1.6)))


def test_friction_is_found_and_sized_through_noise_of_the_torque() -> None:
    located = locate(evidence(rub=0.05, measured=NOISE))
    best = located.decision.best
    assert [c.key for c in best.members] == [("dry_friction", "a")]
    deviation = float(np.sqrt(best.covariance[0, 0]))
    assert abs(best.x[0][0] - 0.05) < 3 * deviation < 0.015
    assert best.rms == pytest.approx(1.0, abs=0.06)
    assert located.evidence.input_noise == {"drive": pytest.approx(NOISE, rel=0.1)}


def test_nothing_is_named_where_only_the_torque_is_noisy() -> None:
    located = locate(evidence(measured=NOISE))
    assert not located.decision.best.members
    assert located.decision.nominal.rms == pytest.approx(1.0, abs=0.06)
