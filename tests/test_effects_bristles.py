"""Bristles of LuGre friction where a simulation begins, against statics and energy."""

import mujoco
import numpy as np
import pytest

from bo_sysid.effects import survey
from bo_sysid.effects.bristles import add_bristles
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, MujocoSimulator, State
from bo_sysid.simulation.bristles import bristle_motors, loaded, with_loaded_bristles
from bo_sysid.simulation.cutting import cut

LOW, HIGH, SPEED, BEND = 2.5, 3.8, 0.09, 6e-5
SLIDER = """<mujoco><option timestep="0.0005" gravity="0 0 0"/><worldbody><body>
<joint name="s" type="slide" axis="1 0 0"/><geom size=".1" mass="1.5"/>
{second}</body></worldbody>
<actuator>{drive}</actuator></mujoco>"""
MOTOR = '<motor name="m" joint="s"/>'
TIME = np.arange(0, 20, 0.01)
LINK = """<body><joint name="h" type="hinge" axis="0 1 0"/>
<geom size=".02" pos="0 0 -.5" mass=".4"/></body>"""


def nominal(second: str = "", drive: str = MOTOR) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(SLIDER.format(second=second, drive=drive))


def rubbing(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Add the bristles to a slider."""
    moved = {"s": 0.3 * np.sin(TIME)}
    moving = Recording.from_arrays(TIME, qpos=moved, ctrl={"m": np.sin(TIME)})
    add_bristles(spec, "s", (LOW, HIGH, SPEED), BEND, survey(spec.copy().compile(), [moving]))
    return spec


def slider(second: str = "", drive: str = MOTOR) -> mujoco.MjModel:
    return rubbing(nominal(second, drive)).compile()


def begun(model: mujoco.MjModel, qvel: list[float], force: float) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qvel[:], data.ctrl[0] = qvel, force
    start = State(data.qpos[None], data.qvel[None], data.act[None])
    data.act[:] = loaded(model, bristle_motors(model), start, data.ctrl[None])[0]
    return data


@pytest.mark.parametrize("force", [3.0, -3.6, 0.4])
def test_a_held_joint_stays_where_it_is(force):
    """Straight bristles let it go at more than half of the level."""
    model = slider()
    data = begun(model, [0.0], force)
    straight = begun(model, [0.0], force)
    straight.act[:] = 0.0
    for _ in range(400):
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, straight)
    assert abs(data.qpos[0]) < 1e-9
    assert abs(straight.qpos[0]) > 1e-6


LATE = {
    "lag": '<general name="m" joint="s" dyntype="filter" dynprm="1"/>',
    "delay": '<motor name="m" joint="s" delay=".1" nsample="250"/>',
}


@pytest.mark.parametrize("late", LATE)
def test_a_joint_is_held_against_what_reaches_it_of_earlier_controls(late):
    """The control is back at 0 where the simulation begins, the motor's force is not yet."""
    model = slider(drive=LATE[late])
    act = np.zeros((1, model.na))
    past = np.full((1, 300, 1), 3.0) if model.nhistory else None
    if late == "lag":
        act[:, model.actuator_actadr[model.actuator("m").id]] = 3.0
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), act, past=past)
    bent = with_loaded_bristles(model, start, np.zeros((1, 1)))
    moved = [
        np.abs(Engine(1).rollout(model, s, np.zeros((1, 100, 1))).qpos).max() for s in (bent, start)
    ]
    assert moved[0] < 0.01 * moved[1]


def test_windows_of_a_recording_begin_with_bent_bristles():
    """A joint that friction held all along stays where it is in each of them."""
    model = Model.from_xml(rubbing(nominal()).to_xml())
    held = np.zeros(len(TIME))
    log = Recording.from_arrays(
        TIME, qpos={"s": held}, qvel={"s": held}, ctrl={"m": np.full(len(TIME), 3.0)}
    )
    windows = cut(model, [log], horizon=20)
    (found,) = MujocoSimulator(model, (), Engine(1)).predictions(np.zeros((1, 0)), windows)
    assert np.abs(windows.residual(found.values)).max() < 1e-9


def test_a_held_joint_carries_what_another_one_hands_to_it():
    """The pull of a pendulum that turns changes, and bends the bristles by so much and no more."""
    model = slider(LINK)
    data = begun(model, [0.0, 3.0], 1.5)
    straight = begun(model, [0.0, 3.0], 1.5)
    straight.act[:] = 0.0
    for _ in range(100):
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, straight)
    assert abs(data.qpos[0]) < 0.1 * BEND < 0.3 * BEND < abs(straight.qpos[0])
    assert abs(data.qvel[1]) > 2.5


@pytest.mark.parametrize("force", [3.0, -3.0])
def test_a_sliding_joint_is_braked_from_the_first_step_on(force):
    model, v = slider(), 0.6
    data = begun(model, [v], force)
    mujoco.mj_step(model, data)
    friction = LOW + (HIGH - LOW) * np.exp(-((v / SPEED) ** 2))
    expected = (force - friction) / 1.5
    assert (data.qvel[0] - v) / model.opt.timestep == pytest.approx(expected, rel=0.02)


def test_a_model_without_bristles_has_none():
    model = nominal(LINK).compile()
    assert bristle_motors(model).size == 0


def test_bristles_that_hold_nothing_are_straight_and_say_nothing():
    model = slider()
    motors = bristle_motors(model)
    model.actuator_biasprm[motors, 3:5] = 0.0
    start = State(np.zeros((2, 1)), np.array([[0.0], [1.0]]), np.zeros((2, 1)))
    with np.errstate(all="raise"):
        assert not loaded(model, motors, start, np.ones((2, 1))).any()


def test_a_finer_step_resolves_stiffer_bristles_to_those_that_bend_as_they_should():
    """At rest the force of bristles is their level times the share of their bend."""

    def bend(timestep: float) -> float:
        spec = nominal()
        spec.option.timestep = timestep
        moved = Recording.from_arrays(TIME, qpos={"s": 0.3 * np.sin(TIME)}, ctrl={"m": TIME})
        add_bristles(spec, "s", (HIGH, HIGH, SPEED), BEND, survey(spec.copy().compile(), [moved]))
        model = spec.compile()
        data = mujoco.MjData(model)
        data.act[:] = 1e-6
        mujoco.mj_forward(model, data)
        return float(HIGH * 1e-6 / abs(data.qfrc_actuator[0]))

    bends = [bend(h) for h in (8e-3, 2e-3, 1e-3, 1e-4)]
    assert bends == sorted(bends, reverse=True)
    assert bends[0] > 2 * BEND
    assert bends[-1] == pytest.approx(BEND, rel=1e-3)
