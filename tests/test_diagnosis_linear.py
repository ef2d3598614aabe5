"""Signatures against brute force: the simulator run with and without the effect."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, candidate, posed, record

from bo_sysid.diagnosis.sets.signatures import signatures
from bo_sysid.diagnosis.windows.candidate import Candidate, candidates
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.observation import observe
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE, Machine, Reading, survey
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, Trajectory

SERVOS = (
    Path(__file__).parents[1] / "studies" / "concealed" / "machines" / "two_link_arm_servos.xml"
)


@pytest.fixture(scope="module")
def prepared():
    problem, machine = posed(record(duration=4.0))
    return prepare(problem), machine


@pytest.mark.parametrize(
    ("effect", "site", "component"),
    [
        ("dry_friction", "elbow", 0),
        ("viscous_damping", "shoulder", 0),
        ("joint_spring", "elbow", 0),
        ("joint_spring", "elbow", 1),
        ("armature", "shoulder", 0),
        ("payload", "forearm", 0),
        ("link_mass", "upper", 0),
        ("actuator_gain", "elbow", 0),
        ("actuator_delay", "shoulder", 0),
        ("actuator_lag", "elbow", 0),
        ("encoder_offset", "shoulder", 0),
        ("sensor_delay", "qpos.elbow", 0),
        ("gravity_tilt", "world", 1),
        ("cogging", "elbow", 0),
        ("stribeck_friction", "elbow", 1),
    ],
)
def test_signature_equals_the_difference_of_two_simulations(
    prepared, effect: str, site: str, component: int
) -> None:
    ready, machine = prepared
    c = candidate(machine, effect, site)
    signature = signatures(ready.linear, [c])[..., component].astype(float)
    x = np.zeros(c.size)
    x[component] = 0.3 * c.point[component]
    problem = replace(ready.problem, correction=None)
    before = problem.residual(Hypothesis(), ready.start)
    after = problem.residual(Hypothesis((c,), (x,)), ready.start)
    exact = project(ready.linear.Q, before - after) / x[component]
    cosine = (signature * exact).sum() / np.linalg.norm(signature) / np.linalg.norm(exact)
    assert cosine > 0.99
    assert np.linalg.norm(signature) == pytest.approx(np.linalg.norm(exact), rel=0.1)


@pytest.mark.parametrize(
    ("effect", "site"), [("actuator_lag", "elbow"), ("actuator_deadzone", "elbow")]
)
def test_signatures_of_commands_beyond_their_range_are_those_of_what_acts(effect, site) -> None:
    spec = arm().spec()
    for name, most in (("shoulder", 0.4), ("elbow", 0.1)):
        spec.actuator(name).ctrllimited, spec.actuator(name).ctrlrange = True, [-most, most]
    model, recording = Model("arm", "arm", spec), record(duration=4.0)
    assert np.abs(recording.channels["ctrl.elbow"].values).max() > 0.15
    machine = survey(model.compile(), [recording])
    sigma = dict.fromkeys(("qpos.shoulder", "qpos.elbow"), SIGMA)
    problem = cut_problem(model, machine, [recording], sigma, (), horizon=100, engine=Engine(1))
    c, start = candidate(machine, effect, site), problem.windows.start
    linear = linearise(problem, Hypothesis(), start)
    signature = signatures(linear, [c])[..., 0].astype(float)
    x = 0.3 * c.point
    moved = problem.residual(Hypothesis(), start) - problem.residual(Hypothesis((c,), (x,)), start)
    exact = project(linear.Q, moved) / x[0]
    assert np.linalg.norm(signature - exact) < 0.1 * np.linalg.norm(exact)


def test_columns_of_many_candidates_are_those_of_each_and_zero_of_those_left_out(prepared) -> None:
    ready, machine = prepared
    many = candidates([CATALOGUE[i] for i in ("dry_friction", "joint_spring", "cogging")], machine)
    assert sum(c.size for c in many) > 24  # more than are propagated at once
    kept = [c for c in many if c.effect.id != "joint_spring"]
    found = signatures(ready.linear, many, left_out=[c for c in many if c not in kept])
    each = [
        signatures(ready.linear, [c]) if c in kept else np.zeros((*found.shape[:2], c.size))
        for c in many
    ]
    np.testing.assert_allclose(found, np.concatenate(each, axis=-1), rtol=1e-5, atol=1e-6)


def test_a_change_of_start_is_projected_out(prepared) -> None:
    ready, _ = prepared
    problem = replace(ready.problem, correction=None)
    rng = np.random.default_rng(0)
    small = 1e-4 * rng.normal(size=(len(ready.start), 4))
    moved = ready.start.moved(problem.machine.model, small)
    change = problem.residual(Hypothesis(), ready.start) - problem.residual(Hypothesis(), moved)
    left = project(ready.linear.Q, change)
    assert np.linalg.norm(left) < 0.02 * np.linalg.norm(change)


def test_linear_response_to_the_start_equals_finite_differences(prepared) -> None:
    ready, _ = prepared
    problem = replace(ready.problem, correction=None)
    base = problem.residual(Hypothesis(), ready.start)
    for k in range(4):
        step = np.zeros((len(ready.start), 4))
        step[:, k] = 1e-4
        moved = ready.start.moved(problem.machine.model, step)
        exact = (base - problem.residual(Hypothesis(), moved)) / 1e-4
        np.testing.assert_allclose(ready.linear.J[..., k], exact, atol=0.03 * np.abs(exact).max())


def test_some_windows_with_other_weights_need_no_new_simulation(prepared) -> None:
    ready, machine = prepared
    keep = np.arange(len(ready.start)) % 3 > 0
    factor = np.random.default_rng(0).uniform(0.2, 1.0, ready.problem.weight.shape)
    lighter = replace(ready.problem, weight=ready.problem.weight * factor)
    derived = ready.linear.observing(lighter).rows(keep)
    anew = linearise(lighter.rows(keep), ready.linear.hypothesis, ready.start.rows(keep))
    np.testing.assert_allclose(derived.J, anew.J, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(derived.start_gain, anew.start_gain, rtol=1e-6, atol=1e-9)
    c = candidate(machine, "joint_spring", "elbow")
    np.testing.assert_allclose(
        signatures(derived, [c]), signatures(anew, [c]), rtol=1e-5, atol=1e-4
    )


def test_signatures_hold_at_a_hypothesis_that_is_not_nominal(prepared) -> None:
    ready, machine = prepared
    friction = candidate(machine, "dry_friction", "elbow")
    damping = candidate(machine, "viscous_damping", "shoulder")
    at = Hypothesis((friction,), (np.array([0.02]),))
    problem = replace(ready.problem, correction=None)
    linear = linearise(problem, at, ready.start)
    x = 0.3 * damping.probe
    both = Hypothesis((friction, damping), (np.array([0.02]), x))
    exact = problem.residual(at, ready.start) - problem.residual(both, ready.start)
    exact = project(linear.Q, exact).ravel() / x[0]
    signature = signatures(linear, [damping])[..., 0].ravel()
    assert signature @ exact / np.linalg.norm(signature) / np.linalg.norm(exact) > 0.99


def test_signature_beside_a_soft_gear_in_a_servos_loop_is_that_of_the_effect() -> None:
    """The loop is closed at the link, so that the gear brings a force of its own."""
    model = Model.from_file(SERVOS)
    recording = _commanded(model)
    machine = survey(model.compile(), [recording])
    sigma = dict.fromkeys(("qpos.shoulder", "qpos.elbow"), SIGMA)
    problem = cut_problem(model, machine, [recording], sigma, (), horizon=100, engine=Engine(1))
    c = candidate(machine, "encoder_offset", "shoulder")
    assert _missed_beside_a_gear(problem, machine, c) < 0.2


def test_back_emf_beside_a_soft_gear_acts_at_the_motor() -> None:
    """A motor closes no loop: the encoder at the link sees less of it, and brings no force."""
    problem, machine = posed(record(duration=4.0))
    c = candidate(machine, "back_emf", "elbow")
    assert _missed_beside_a_gear(problem, machine, c) < 0.2


def _missed_beside_a_gear(problem: Problem, machine: Machine, c: Candidate) -> float:
    """Return by what share a signature misses the difference of two simulations.

    Beside a soft gear at the elbow, whose encoder sits on the link.
    """
    soft = candidates([CATALOGUE["joint_compliance"]], machine)
    flex = next(s for s in soft if s.site.name == "elbow" and s.full(s.point)[3] == 1.0)
    alone = Hypothesis((flex,), (flex.point,))
    ready = prepare(problem, alone)
    signature = signatures(ready.linear, [c])[..., 0].astype(float)
    x = 0.3 * c.point
    problem = replace(ready.problem, correction=None)
    before = problem.residual(alone, ready.start)
    after = problem.residual(Hypothesis((flex, c), (flex.point, x)), ready.start)
    exact = project(ready.linear.Q, before - after) / x[0]
    return float(np.linalg.norm(signature - exact) / np.linalg.norm(exact))


def _commanded(model: Model) -> Recording:
    """Return a recording of servos that are told to move."""
    compiled = model.compile()
    data, time = mujoco.MjData(compiled), np.arange(0, 4, compiled.opt.timestep)
    goal = 0.5 * np.sin(np.outer(time, [4.0, 7.0]))
    qpos = np.empty_like(goal)
    for k, data.ctrl[:] in enumerate(goal):
        qpos[k] = data.qpos
        mujoco.mj_step(compiled, data)
    qpos += SIGMA * np.random.default_rng(0).normal(size=qpos.shape)
    names = [compiled.actuator(i).name for i in range(compiled.nu)]
    return Recording.from_arrays(
        time,
        qpos=dict(zip(("shoulder", "elbow"), qpos.T, strict=True)),
        ctrl=dict(zip(names, goal.T, strict=True)),
    )


def test_a_late_sensor_shows_what_was_before_the_window(prepared) -> None:
    """A window cut out of a longer motion, as far back as its own acceleration tells."""
    ready, _ = prepared
    problem, late = ready.problem, 15
    windows = problem.windows.beginning(60)
    t = problem.simulate(Hypothesis(), ready.start).trajectory
    later = Trajectory(t.qpos[:, late:], t.qvel[:, late:], t.act[:, late:], None, t.diverged)
    reading = Reading("qpos.elbow", delay=late * windows.timestep)
    k, now = windows.channels.index("qpos.elbow"), windows.step[0]
    seen, truth = observe(problem.layout, windows, later, [reading])[..., k], t.qpos[:, now, 1]
    back, early = windows.timestep * (now - late), now < late
    straight = later.qpos[:, :1, 1] + later.qvel[:, :1, 1] * back
    np.testing.assert_allclose(seen[:, ~early], truth[:, ~early], atol=1e-9)
    missed = np.abs(seen - truth)[:, early].max()
    assert missed < 0.3 * np.abs(straight - truth)[:, early].max()


def test_contact_is_expected_where_it_can_happen_only() -> None:
    assert can_touch(Model.from_dm_control("cheetah", "run").compile())
    assert not can_touch(Model.from_dm_control("pendulum", "swingup").compile())  # disabled there
    assert not can_touch(Model.from_dm_control("cartpole", "swingup").compile())


@pytest.mark.parametrize("readings", [[("encoder_scale", 0.5)], [("sensor_delay", 0.03)], None])
def test_response_to_the_start_is_seen_through_the_readings(prepared, readings) -> None:
    """Against two simulations; None is both of them at the elbow."""
    ready, machine = prepared
    readings = readings or [("encoder_scale", -0.4), ("sensor_delay", 0.02)]
    sites = {"encoder_scale": "elbow", "sensor_delay": "qpos.elbow"}
    members = tuple(candidate(machine, id, sites[id]) for id, _ in readings)
    at = Hypothesis(members, tuple(np.array([x]) for _, x in readings))
    problem = replace(ready.problem, correction=None)
    J = linearise(problem, at, ready.start).J
    base = problem.residual(at, ready.start)
    for k in range(4):
        step = np.zeros((len(ready.start), 4))
        step[:, k] = 1e-4
        moved = ready.start.moved(problem.machine.model, step)
        exact = (base - problem.residual(at, moved)) / 1e-4
        np.testing.assert_allclose(J[..., k], exact, atol=0.03 * np.abs(exact).max())


def test_what_a_delayed_reading_shows_from_before_its_log_does_not_count(prepared) -> None:
    ready, machine = prepared
    late = candidate(machine, "sensor_delay", "qpos.elbow")
    at = Hypothesis((late,), (np.array([0.03]),))
    problem = replace(ready.problem, correction=None)
    elbow = problem.windows.channels.index("qpos.elbow")
    r = problem.residual(at, ready.start).reshape(problem.weight.shape)
    instants = problem.windows.time[0] + problem.windows.step[0] * problem.windows.timestep
    unknown = instants - problem.recordings[0].span[0] < 0.03
    assert 5 < unknown.sum() < 20
    assert (r[0, unknown, elbow] == 0).all()
    assert (r[0, ~unknown, elbow] != 0).all()
    assert (r[0, :, 1 - elbow] != 0).all()
    assert (r[1:, :, elbow] != 0).all()
    J = linearise(problem, at, ready.start).J.reshape(*r.shape, -1)
    assert (J[0, unknown, elbow] == 0).all()


BALL = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body pos="0 0 1"><joint name="yaw" axis="0 0 1" damping=".05" armature=".002"/>
      <geom type="capsule" size=".015" fromto="0 0 0 .25 0 0" mass=".4" contype="0"/>
      <body pos=".25 0 0"><joint name="ball" type="ball" damping=".002"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 .05 -.3" mass=".2" contype="0"/>
      </body></body>
  </worldbody>
  <actuator><motor name="tau" joint="yaw"/></actuator>
</mujoco>
"""


def test_a_quaternion_follows_its_start() -> None:
    """The response of a ball joint's quaternion against two simulations."""
    model = Model.from_xml(BALL)
    plant = model.compile()
    data, rows = mujoco.MjData(plant), []
    for k in range(300):
        data.ctrl[0] = 0.1 * np.sin(0.05 * k)
        rows.append([data.time, *data.qpos, *data.ctrl])
        for _ in range(5):
            mujoco.mj_step(plant, data)
    time, yaw, *ball, tau = np.transpose(rows)
    motion = {"yaw": yaw, **{f"ball.{i}": q for i, q in enumerate(ball)}}
    recording = Recording.from_arrays(time, qpos=motion, ctrl={"tau": tau})
    sigma = {f"qpos.{n}": 1e-3 for n in motion}
    machine = survey(plant, [recording])
    problem = cut_problem(model, machine, [recording], sigma, (), horizon=20, engine=Engine(1))
    start = problem.windows.start
    linear, here = linearise(problem, Hypothesis(), start), problem.residual(Hypothesis(), start)
    for k in range(2 * plant.nv):
        change = np.zeros((len(start), 2 * plant.nv))
        change[:, k] = 1e-6
        there = problem.residual(Hypothesis(), problem.moved(start, change))
        seen = (here - there) / 1e-6
        error = np.linalg.norm(linear.J[..., k] - seen)
        assert error < 0.1 * np.linalg.norm(seen), k  # its matrices are held over 8 ms


GEARED = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="link">
      <joint name="motor" axis="0 1 0" damping="0.05" armature="0.02"/>
      <joint name="gear" axis="0 1 0" damping="0.02" stiffness="20"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="motor"/></actuator>
</mujoco>
"""


def test_a_joint_that_another_ones_encoder_shows_is_seen_there(tmp_path: Path) -> None:
    """The response of an encoder on the link to starts of a gear that nothing else measures."""
    file = tmp_path / "geared.xml"
    file.write_text(GEARED)
    model = Model.from_file(file, unrecorded={"gear": "motor"})
    plant, time = model.compile(), np.arange(0, 1, 0.003)  # stamps between the steps
    moved, told = {"motor": np.sin(4 * time)}, {"motor": np.cos(5 * time)}
    recording = Recording.from_arrays(time, qpos=moved, ctrl=told)
    machine, sigma = survey(plant, [recording]), {"qpos.motor": 1e-3}
    problem = cut_problem(model, machine, [recording], sigma, (), horizon=30, engine=Engine(1))
    start = problem.windows.start
    linear, here = linearise(problem, Hypothesis(), start), problem.residual(Hypothesis(), start)
    for k in range(2 * plant.nv):
        change = np.zeros((len(start), 2 * plant.nv))
        change[:, k] = 1e-6
        seen = (here - problem.residual(Hypothesis(), problem.moved(start, change))) / 1e-6
        error = np.linalg.norm(linear.J[..., k] - seen)
        assert error < 0.01 * np.linalg.norm(seen), k
