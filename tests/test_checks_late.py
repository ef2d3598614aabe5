"""Drives and clocks that are late, told by the balance of forces."""

import functools

import mujoco
import numpy as np
import pytest
from wiring_logs import ARM, SERVO, recorded, speed_servo, tones, without

from bo_sysid.checks.wiring import find_wiring
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine, State


def test_a_drive_that_is_late_is_no_clock() -> None:
    log, late = recorded(), 0.025
    channels = dict(log.channels)
    told = channels["ctrl.b"]
    channels["ctrl.b"] = Channel(told.time - late, told.values, told.unit, "ctrl.b", told.hold)
    found = find_wiring(Model.from_xml(ARM).compile(), [Recording("log", channels)])
    assert found.delay == 0.0
    assert found.wires == {}
    assert [(f.level, f.kind, f.channels) for f in found.flags] == [("look", "clock", ("ctrl.b",))]
    delays = found.delays.set_index("control")["delay"]
    assert delays["ctrl.b"] == pytest.approx(1e3 * late, abs=1.5)
    assert delays["ctrl.a"] == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("late", [0.0, 0.015])
def test_a_speed_servo_that_rubs_is_as_late_as_it_is(late: float) -> None:
    """A speed servo follows closely: to the regression a lack of inertia is a delay."""
    found = speed_servo(0.15, 1, late)
    assert found.flags == ()
    assert found.delays["delay"][0] == pytest.approx(1e3 * late, abs=3.0)


@pytest.mark.parametrize("seed", [2, 3])
def test_friction_that_sticks_is_no_clock(seed: int) -> None:
    """Half of what the motor gives is dry friction, and the joint stands still again and again."""
    text = SERVO.format(kind="motor").replace('axis="0 1 0"', 'axis="0 0 1"')
    plant = Model.from_xml(text.replace("damping", 'frictionloss=".5" damping')).compile()
    time = np.arange(0.0, 12.0, 0.004)
    data, told = mujoco.MjData(plant), np.zeros((len(time), 2))
    for k, goal in enumerate(tones(time, seed)):
        data.ctrl[0] = goal - data.qpos[0] - 0.03 * data.qvel[0]
        told[k] = data.qpos[0], data.ctrl[0]
        mujoco.mj_step(plant, data, 4)
    noise = 3e-4 * np.random.default_rng(0).standard_normal(len(time))
    log = Recording.from_arrays(time, qpos={"hinge": told[:, 0] + noise}, ctrl={"m": told[:, 1]})
    found = find_wiring(Model.from_xml(text).compile(), [log])
    assert found.delay == 0.0
    assert found.flags == ()


ON_LAGS = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="shoulder" axis="0 1 0" damping=".5"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/>
      <body pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping=".5"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/></body></body>
  </worldbody>
  <actuator><position name="a" joint="shoulder" kp="60" kv="4" timeconst=".12"/>
    <position name="b" joint="elbow" kp="60" kv="4" timeconst=".12"/></actuator>
</mujoco>
"""


@functools.cache
def lagging() -> Recording:
    """Return a log of an arm on servos whose commands act through a lag of 120 ms."""
    time = np.arange(0.0, 6.0, 0.01)
    ctrl = 0.7 * np.stack([tones(time, 7), tones(time, 8)], axis=1)
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)))
    run = Engine(1).rollout(
        Model.from_xml(ON_LAGS).compile(), start, np.repeat(ctrl, 5, axis=0)[None]
    )
    qpos = run.qpos[0, ::5][:-1] + 1e-4 * np.random.default_rng(0).standard_normal((len(time), 2))
    return Recording.from_arrays(
        time,
        qpos={"shoulder": qpos[:, 0], "elbow": qpos[:, 1]},
        ctrl={"a": ctrl[:, 0], "b": ctrl[:, 1]},
    )


@pytest.mark.parametrize(("first", "last"), [(2.0, 2.6), (-1.0, 1.0), (9.0, 9.0)])
def test_a_lag_that_follows_what_no_log_has_is_no_fault(first: float, last: float) -> None:
    """Commands are lost in a gap, and before a log began; at 9 s the whole log is there."""
    found = find_wiring(Model.from_xml(ON_LAGS).compile(), [without(lagging(), first, last)])
    assert found.balance["before"].max() < 5e-3
    assert found.wires == {}
    assert found.flags == ()
