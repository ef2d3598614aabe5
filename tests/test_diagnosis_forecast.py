"""The noise floor of a forecast against the straight line through noisy points."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from diagnosis_helpers import candidate

from bo_sysid.diagnosis.answer.tables import traces
from bo_sysid.diagnosis.windows.estimated_starts import caught_up
from bo_sysid.diagnosis.windows.forecast import fitted, forecast, forecast_problem, noise_floor
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine

SIGMA, SAMPLING = 1e-3, 0.005
MASS = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>{floor}
<body pos="0 0 1"><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
</worldbody><actuator><motor name="slide" joint="slide"/></actuator></mujoco>"""
FLOOR = '<geom type="plane" size="1 1 .1" pos="0 0 -5"/>'
"""Never reached; that it could be is what decides how the floor is computed."""


def posed(model: Model, recording: Recording, past: float = 0.1):
    sigma = {n: SIGMA for n in recording.channels if n.startswith("qpos.")}
    return forecast_problem(
        model, survey(model.compile(), [recording]), [recording], sigma,
        past=past, ahead=0.1, timestep=0.005, engine=Engine(1),
    )  # fmt: skip


@pytest.mark.parametrize(("floor", "within"), [("", 0.01), (FLOOR, 0.05)])
def test_the_noise_floor_is_that_of_a_line_through_noisy_points(floor, within):
    model, rng = Model.from_xml(MASS.format(floor=floor)), np.random.default_rng(0)
    time = np.arange(0, 60, SAMPLING)
    shown = 0.2 * time + SIGMA * rng.normal(size=len(time))
    still = {"slide": np.zeros(len(time))}
    recording = Recording.from_arrays(time, qpos={"slide": shown}, ctrl=still)
    problem, past = posed(model, recording)
    X = np.stack([np.ones(problem.count), np.arange(problem.count)], axis=1)
    spread = np.linalg.inv(X[:past].T @ X[:past])
    expected = np.sqrt(1 + np.mean(np.einsum("ij,jk,ik->i", X[past:], spread, X[past:])))
    errors = forecast(problem, past, Hypothesis())
    assert expected > 1.25
    assert noise_floor(problem, past, Hypothesis(), errors) == pytest.approx(expected, rel=within)
    assert errors.ahead == pytest.approx(expected, rel=0.05)


TWO = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>
<body><joint name="fast" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
<body pos="0 2 0"><joint name="slow" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
</worldbody></mujoco>"""


def test_what_was_not_recorded_counts_in_no_error_and_in_no_floor():
    """Two masses that drift, one sampled at a quarter of the rate: noise and nothing else."""
    rng, time = np.random.default_rng(1), np.arange(0, 120, SAMPLING)
    channels = {
        f"qpos.{n}": Channel(t, 0.1 * t + SIGMA * rng.normal(size=len(t)))
        for n, t in (("fast", time), ("slow", time[::4]))
    }
    problem, past = posed(Model.from_xml(TWO), Recording("drift", channels), past=0.2)
    errors = forecast(problem, past, Hypothesis())
    seen = problem.weight[:, past:] > 0
    assert seen[..., 1].mean() == pytest.approx(0.25, abs=0.01)
    assert errors.ahead == pytest.approx(np.sqrt(np.mean(errors.residual[seen] ** 2)))
    floor = noise_floor(problem, past, Hypothesis(), errors)
    assert errors.ahead == pytest.approx(floor, rel=0.03)
    whole = fitted(problem, Hypothesis())
    assert whole.ahead == pytest.approx(1.0, rel=0.03)


def test_a_reading_of_another_scale_is_forecast_as_well_as_any():
    """A mass that drifts, read at .6 and 1.8 of where it is: noise and nothing else."""
    rng, time = np.random.default_rng(2), np.arange(0, 60, SAMPLING)
    moved = 0.3 * np.sin(0.2 * time)
    force = -0.04 * moved
    model = Model.from_xml(MASS.format(floor=""))
    for scale in (-0.4, 0.8):
        shown = (1 + scale) * moved + SIGMA * rng.normal(size=len(time))
        channels = {"slide": shown}
        recording = Recording.from_arrays(time, qpos=channels, ctrl={"slide": force})
        problem, past = posed(model, recording)
        encoder = candidate(problem.machine, "encoder_scale", "slide")
        at = Hypothesis((encoder,), (np.array([scale]),))
        errors = forecast(problem, past, at)
        assert errors.ahead == pytest.approx(noise_floor(problem, past, at, errors), rel=0.05)


STUCK = """<mujoco><option timestep="0.0005" gravity="0 0 0"/><worldbody>
<body><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body>
</worldbody><actuator><motor name="slide" joint="slide"/></actuator></mujoco>"""


def held(duration: float):
    """A mass that bristles hold under a load that changes, and the friction that holds it."""
    rng, time = np.random.default_rng(3), np.arange(0, duration, SAMPLING)
    rest = SIGMA * rng.normal(size=len(time))
    force = 1.5 + 0.4 * np.sin(3 * time)
    recording = Recording.from_arrays(time, qpos={"slide": rest}, ctrl={"slide": force})
    problem, past = posed(Model.from_xml(STUCK), recording)
    friction = candidate(problem.machine, "dry_friction", "slide")
    bent = replace(friction, point=np.array([2.0, 1.0, 1e-4]))
    return problem, past, Hypothesis((bent,), (np.array([2.0]),))


def test_a_joint_that_friction_holds_under_load_is_forecast_at_rest():
    """Noise hides whether it moves."""
    problem, past, at = held(20.0)
    errors = forecast(problem, past, at)
    assert errors.ahead < 1.1
    floor = noise_floor(problem, past, at, errors)
    assert errors.ahead == pytest.approx(floor, rel=0.05)


def test_windows_of_a_held_joint_that_began_in_motion_begin_at_rest():
    problem, _, at = held(5.0)
    begin = problem.windows.start
    moving = replace(begin, qvel=np.full_like(begin.qvel, 0.5))
    count = (problem.weight > 0).sum(axis=(1, 2))
    before = (problem.residual(at, moving) ** 2).sum(axis=1) / count
    found, r = caught_up(problem, at, moving)
    assert (before > 10).all()
    assert ((r**2).sum(axis=1) / count).mean() == pytest.approx(1.0, abs=0.2)
    assert np.abs(found.qvel).max() < 0.05


def test_recordings_of_another_rate_are_forecast_over_the_same_time():
    """A hold-out at a fifth of the training's rate: windows of .1 + .1 s, not of half a second."""
    model, time = Model.from_xml(MASS.format(floor="")), np.arange(0, 10, SAMPLING)
    fast, slow = (
        Recording.from_arrays(t, qpos={"slide": 0.2 * t}, ctrl={"slide": np.zeros(len(t))})
        for t in (time, time[::5])
    )
    problem, past = forecast_problem(
        model, survey(model.compile(), [fast]), [slow], {"qpos.slide": SIGMA},
        past=0.1, ahead=0.1, timestep=0.005, engine=Engine(1),
    )  # fmt: skip
    assert (past, problem.weight.shape[1]) == (4, 8)


SPINNING = """<mujoco><option timestep="0.005" gravity="0 0 0"/><worldbody>
<geom type="plane" size="1 1 .1" pos="0 0 -5"/>
<body><freejoint name="root"/><geom type="box" size=".1 .06 .03" mass="1"/></body>
</worldbody></mujoco>"""


def spinning(size: str = ".1 .06 .03") -> np.ndarray:
    """Return the recorded poses of a box that spins freely, by MuJoCo itself."""
    model = mujoco.MjModel.from_xml_string(SPINNING.replace(".1 .06 .03", size))
    data, rows = mujoco.MjData(model), []
    data.qvel[3:] = 2.0, 9.0, 1.0
    for _ in range(800):
        rows.append(data.qpos.copy())
        mujoco.mj_step(model, data)
    return np.array(rows)


def logged(poses: np.ndarray, sigma: float) -> list[Recording]:
    """Return noisy poses in a row, and the same as a logger writes them that keeps w positive."""
    seen = poses + sigma * np.random.default_rng(0).standard_normal(poses.shape)
    turned = seen * np.where((seen[:, 3:4] < 0) & (np.arange(7) > 2), -1.0, 1.0)
    assert (np.abs(np.diff(turned[:, 3:], axis=0)).max(axis=1) > 0.5).sum() > 4
    time = SAMPLING * np.arange(len(poses))
    return [Recording.from_arrays(time, qpos={"root": p}) for p in (seen, turned)]


def test_a_quaternion_that_changes_its_sign_in_a_log_has_the_floor_of_one_that_does_not():
    model, floors = Model.from_xml(SPINNING), []
    for recording in logged(spinning(), SIGMA):
        problem, past = posed(model, recording)
        errors = forecast(problem, past, Hypothesis())
        floors.append(noise_floor(problem, past, Hypothesis(), errors))
    assert floors[1] == pytest.approx(floors[0], rel=0.05)


def test_traces_of_a_quaternion_are_orientations_with_the_sign_that_was_recorded():
    _, recording = logged(spinning(".1 .05 .05"), 0.0)  # another box than the model's
    problem, past = posed(Model.from_xml(SPINNING), recording)
    table = traces(problem, past, {"nominal": forecast(problem, past, Hypothesis()).residual})
    rows = ["window", "time"]
    told = {
        column: table.pivot_table(index=rows, columns="channel", values=column).to_numpy()[:, 3:]
        for column in ("recorded", "nominal")
    }
    apart = np.linalg.norm(told["recorded"] - told["nominal"], axis=1)
    assert 0.05 < apart.max() < 1.0
    np.testing.assert_allclose(np.linalg.norm(told["nominal"], axis=1), 1.0, atol=1e-6)
