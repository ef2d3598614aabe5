"""What a servo does whose gear gives way, against the linear system that it is."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from bo_sysid.diagnosis.answer.repaired import BESIDE, MODEL, write_model
from bo_sysid.diagnosis.windows.candidate import Candidate, candidates
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.effects import CATALOGUE, Force, Machine, Site, survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, ForceLaw, State
from bo_sysid.simulation.stepper import Stepper

GEARED = """
<mujoco>
  <option timestep="0.00002" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="hinge" axis="0 0 1" armature="0.02"/>
    <geom type="box" size=".1 .1 .1" mass="3"/>
  </body></worldbody>
  <actuator><position name="motor" joint="hinge" kp="5" kv="0.4" gear="2"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize(("on_link", "more"), [(0.0, 0.0), (1.0, 0.0), (1.0, 3.0)])
def test_a_servo_behind_a_spring_closes_its_loop_where_its_encoder_sits(
    on_link: float, more: float
) -> None:
    """Against the matrix exponential of two inertias, a spring between them, and the loop.

    The loop has the gain that another effect, named after it, has changed by so much.
    """
    model = Model.from_xml(GEARED)
    machine = _surveyed(model)
    soft, lag = 0.01, 0.004
    flex = _at(machine, "joint_compliance", Site("joint", "hinge"), [soft, lag, 0.5, on_link])
    gain = _at(machine, "servo_kp", Site("actuator", "motor"), [more])
    hypothesis = Hypothesis((flex, gain), (flex.point[:3], gain.point))
    edits, made = edits_and_parts(hypothesis, machine)
    compiled = model.compile(edits)
    laws = [ForceLaw(p.joint, p.law) for p in made if isinstance(p, Force)]
    assert len(laws) == on_link
    goal, steps = 0.3, 20000
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    ctrl = np.full((1, steps, 1), goal)
    motor, play = Engine(1).rollout(compiled, start, ctrl, laws=laws).qpos[0].T

    dt, rotor, link = 2e-5, 0.02, 3 * (0.2**2 + 0.2**2) / 12
    kp, kd = (5.0 + more) * 2**2, 0.4 * 2**2  # the gear multiplies length and force
    k, b = 1 / soft, (lag + dt) / soft
    at = np.array([1 - on_link, on_link])  # where the loop is closed: motor, link
    spring, damper = k * np.array([-1, 1]), b * np.array([-1, 1])
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2] = np.concatenate([spring - kp * at, damper - kd * at]) / rotor
    A[3] = np.concatenate([-spring, -damper]) / link
    rest = goal / 2  # where the gear's length is the goal
    move = np.stack([expm(A * t) for t in np.linspace(0, steps * dt, 5)])
    exact = rest + move @ np.array([-rest, -rest, 0, 0])
    rows = np.linspace(0, steps, 5).astype(int)
    np.testing.assert_allclose(motor[rows], exact[:, 0], atol=3e-3 * rest)
    np.testing.assert_allclose((motor + play)[rows], exact[:, 1], atol=3e-3 * rest)


@pytest.mark.parametrize(
    "limit",
    [("kp=", 'forcerange="-.3 .3" kp='), ("armature", 'actuatorfrcrange="-.6 .6" armature')],
    ids=["of the drive", "of the joint"],
)
@pytest.mark.parametrize("on_link", [0.0, 1.0])
def test_a_loop_that_is_closed_at_the_link_keeps_the_limit_of_its_force(
    on_link: float, limit: tuple[str, str]
) -> None:
    """Against SciPy: two inertias, a spring between them, and a drive that saturates for long."""
    model = Model.from_xml(GEARED.replace(*limit))
    machine = _surveyed(model)
    soft, lag = 0.02, 0.01
    flex = _at(machine, "joint_compliance", Site("joint", "hinge"), [soft, lag, 0.5, on_link])
    edits, made = edits_and_parts(Hypothesis((flex,), (flex.point[:3],)), machine)
    compiled = model.compile(edits)
    laws = [ForceLaw(p.joint, p.law) for p in made if isinstance(p, Force)]
    assert len(laws) == on_link
    goal, dt, steps = 3.0, 2e-5, 40000
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    ctrl = np.full((1, steps, 1), goal)
    run = Engine(1).rollout(compiled, start, ctrl, laws=laws)
    assert not run.diverged.any()
    motor, play = run.qpos[0].T

    rotor, link = 0.02, 3 * (0.2**2 + 0.2**2) / 12
    k, b = 1 / soft, (lag + dt) / soft

    def motion(_: float, x: np.ndarray) -> list[float]:
        q, v = x[0] + on_link * (x[1] - x[0]), x[2] + on_link * (x[3] - x[2])
        torque = 2 * np.clip(5 * (goal - 2 * q) - 0.4 * 2 * v, -0.3, 0.3)
        between = k * (x[1] - x[0]) + b * (x[3] - x[2])
        return [x[2], x[3], (torque + between) / rotor, -between / link]

    at = np.linspace(0, steps * dt, 9)
    exact = solve_ivp(motion, (0, at[-1]), np.zeros(4), t_eval=at, rtol=1e-9, atol=1e-11).y
    rows = np.linspace(0, steps, 9).astype(int)
    np.testing.assert_allclose((motor + play)[rows], exact[1], atol=6e-3 * goal / 2)
    np.testing.assert_allclose(motor[rows], exact[0], atol=6e-3 * goal / 2)


def _surveyed(model: Model) -> Machine:
    time = np.arange(0, 2, 0.01)
    moved = {"hinge": np.sin(time)}
    log = Recording.from_arrays(time, qpos=moved, ctrl={"motor": np.cos(time)})
    return survey(model.compile(), [log])


def _at(machine: Machine, id: str, site: Site, x: list[float]) -> Candidate:
    extent = CATALOGUE[id].extent(site, machine)
    assert extent is not None
    return Candidate(CATALOGUE[id], site, extent, np.array(x))


def test_a_repaired_model_is_stepped_with_its_loop_closed_at_the_link(tmp_path) -> None:
    """In plain MuJoCo, from the files that a diagnosis writes, as it was simulated."""
    model, time = Model.from_xml(GEARED), np.arange(0, 2, 0.01)
    recording = Recording.from_arrays(
        time, qpos={"hinge": np.sin(time)}, ctrl={"motor": np.cos(time)}
    )
    machine = survey(model.compile(), [recording])
    found = candidates([CATALOGUE["joint_compliance"]], machine)
    member = next(c for c in found if c.point[-1] == 1.0)  # the encoder on the link
    hypothesis = Hypothesis((member,), (np.array([0.01, 0.004, 0.5]),))
    edits, parts = edits_and_parts(hypothesis, machine)
    compiled = model.compile(edits)
    laws = [ForceLaw(p.joint, p.law) for p in parts if isinstance(p, Force)]
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    ctrl = np.full((1, 500, 1), 0.3)
    simulated = Engine(1).rollout(compiled, start, ctrl, laws=laws).qpos[0, -1]
    motor_side = Engine(1).rollout(compiled, start, ctrl).qpos[0, -1]
    assert np.abs(simulated - motor_side).max() > 1e-3

    written = write_model(model, machine, hypothesis, tmp_path, timestep=2e-5)
    assert written.unrecorded == {"hinge_flex": "hinge"}
    stepper = Stepper(tmp_path / MODEL, tmp_path / BESIDE)
    for _ in range(500):
        stepper.data.ctrl[:] = 0.3
        stepper.step()
    np.testing.assert_allclose(stepper.data.qpos, simulated, atol=1e-9)


def test_no_joint_of_the_model_is_taken_for_the_one_between_motor_and_link() -> None:
    """An arm whose other joint bears the name that the added one would have."""
    xml = GEARED.replace(
        "</body>",
        '<body pos="1 0 0"><joint name="hinge_{}" axis="0 0 1"/><geom size=".1"/></body></body>',
    )
    time = np.arange(0, 2, 0.01)
    for what, effect in (("flex", "joint_compliance"), ("play", "backlash")):
        moved = {"hinge": np.sin(time), f"hinge_{what}": np.cos(time)}
        log = Recording.from_arrays(time, qpos=moved, ctrl={"motor": np.cos(time)})
        machine = survey(Model.from_xml(xml.format(what)).compile(), [log])
        other = {"joint_compliance", "backlash"} - {effect}
        found = candidates([CATALOGUE[id] for id in (effect, *other)], machine)
        assert {c.effect.id for c in found if c.site.name == "hinge"} == other


def test_a_gap_has_no_ends_where_a_model_switches_its_limits_off() -> None:
    time, flagged = np.arange(0, 2, 0.01), '<option><flag limit="disable"/></option>'
    log = Recording.from_arrays(time, qpos={"hinge": np.sin(time)}, ctrl={"motor": np.cos(time)})
    for stop, offered in (("", True), ('range="-90 90"', False)):
        xml = GEARED.replace("<worldbody>", f"{flagged}<worldbody>")
        xml = xml.replace('<joint name="hinge"', f'<joint name="hinge" {stop}')
        assert (stop or "<joint") in xml
        machine = survey(Model.from_xml(xml).compile(), [log])
        found = candidates([CATALOGUE["backlash"]], machine)
        assert bool(found) == offered
