"""Bristles of LuGre friction where a simulation begins, against statics and energy."""

import mujoco
import numpy as np
import pytest

from bo_sysid.effects import survey
from bo_sysid.effects.bristles import add_bristles, bristle_motors, loaded
from bo_sysid.recording import Recording

LOW, HIGH, SPEED, BEND = 2.5, 3.8, 0.09, 6e-5
SLIDER = """<mujoco><option timestep="0.0005" gravity="0 0 0"/><worldbody><body>
<joint name="s" type="slide" axis="1 0 0"/><geom size=".1" mass="1.5"/>
{second}</body></worldbody>
<actuator><motor name="m" joint="s"/></actuator></mujoco>"""
TIME = np.arange(0, 20, 0.01)
LINK = """<body><joint name="h" type="hinge" axis="0 1 0"/>
<geom size=".02" pos="0 0 -.5" mass=".4"/></body>"""


def slider(second: str = "") -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(SLIDER.format(second=second))
    time = np.arange(0, 20, 0.01)
    moved = {"s": 0.3 * np.sin(time)}
    moving = Recording.from_arrays(time, qpos=moved, ctrl={"m": np.sin(time)})
    machine = survey(spec.copy().compile(), [moving])
    add_bristles(spec, "s", (LOW, HIGH, SPEED), BEND, machine)
    return spec.compile()


def begun(model: mujoco.MjModel, qvel: list[float], force: float) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qvel[:], data.ctrl[0] = qvel, force
    motors = bristle_motors(model)
    bent = loaded(model, motors, data.qpos[None], data.qvel[None], data.ctrl[None])
    data.act[:] = bent[0]
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
    model = mujoco.MjSpec.from_string(SLIDER.format(second=LINK)).compile()
    assert bristle_motors(model).size == 0


def test_bristles_that_hold_nothing_are_straight_and_say_nothing():
    model = slider()
    motors = bristle_motors(model)
    model.actuator_biasprm[motors, 3:5] = 0.0
    qpos, qvel, ctrl = np.zeros((2, 1)), np.array([[0.0], [1.0]]), np.ones((2, 1))
    with np.errstate(all="raise"):
        assert not loaded(model, motors, qpos, qvel, ctrl).any()


def test_a_finer_step_resolves_stiffer_bristles_to_those_that_bend_as_they_should():
    """At rest the force of bristles is their level times the share of their bend."""

    def bend(timestep: float) -> float:
        spec = mujoco.MjSpec.from_string(SLIDER.format(second=""))
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
