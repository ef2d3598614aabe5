"""Loads that a model lacks, which look like encoders with another zero."""

import mujoco
import numpy as np
import pytest

from bo_sysid.checks.balance import Dynamics
from bo_sysid.checks.wiring import Wiring, find_wiring
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, State

TOOL = '<body pos="{at}"><inertial pos="0 0 0" mass="{mass}" diaginertia="1e-9 1e-9 1e-9"/></body>'
ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast" gravity="0.3 0 -9.81"/>
  <worldbody>
    <body><joint name="pan" axis="0 1 0" damping=".3"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/>
      <body pos="0 0 -.3" euler="20 30 0"><joint name="tilt" axis="1 0 .3" damping=".2"/>
        <geom type="capsule" fromto="0 0 0 0 .2 -.1" size=".02" mass=".4"/>
        <body name="hand" pos="0 .2 -.1"><joint name="roll" axis="0 1 0" damping=".1"/>
          <geom size=".04" pos="0 .05 .02" mass=".3"/>{}</body></body></body>
  </worldbody>
  <actuator><motor name="a" joint="pan"/><motor name="b" joint="tilt"/>
    <motor name="c" joint="roll"/></actuator>
</mujoco>
"""
JOINTS, TIME = ("pan", "tilt", "roll"), np.arange(0.0, 12.0, 0.004)


def test_a_mass_at_a_point_needs_what_a_body_there_needs() -> None:
    mass, at = 0.7, np.array([0.07, -0.03, 0.12])
    plain, loaded = (
        Dynamics(mujoco.MjModel.from_xml_string(ARM.format(tool)))
        for tool in ("", TOOL.format(mass=mass, at="0.07 -0.03 0.12"))
    )
    motion = np.random.default_rng(0).normal(size=(3, 5, 3))
    needed = loaded.terms(*motion).required_force - plain.terms(*motion).required_force
    hand = plain.model.body("hand").id
    points = plain.of_points(*motion, hand, np.array([at, 0 * at]))
    assert mass * points[..., 0] == pytest.approx(needed, abs=1e-7)


def wiring(tool: str, zero: float) -> Wiring:
    """Return what is found of a log of the arm with a tool, the zero of its last encoder moved."""
    machine = Model.from_xml(ARM.format(tool)).compile()
    rng = np.random.default_rng(2)
    tones = 2 * np.pi * rng.uniform(0.2, 1.8, (5, 1, 3)) * TIME[:, None]
    ctrl = np.sin(tones + rng.uniform(0, 6, (5, 1, 3))).sum(axis=0) * [0.9, 0.6, 0.15]
    run = Engine(1).rollout(
        machine,
        State(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 0))),
        np.repeat(ctrl, 2, 0)[None],
    )
    qpos = run.qpos[0, :-1:2] + 1e-4 * rng.standard_normal((len(TIME), 3)) + [0, 0, zero]
    log = Recording.from_arrays(
        TIME,
        qpos=dict(zip(JOINTS, qpos.T, strict=True)),
        ctrl=dict(zip("abc", ctrl.T, strict=True)),
    )
    return find_wiring(Model.from_xml(ARM.format("")).compile(), [log])


def test_the_weight_of_a_tool_is_no_zero_of_an_encoder() -> None:
    found = wiring(TOOL.format(mass=0.15, at="0.08 0.05 0"), 0.0)
    assert not found.wires
    (told,) = (f for f in found.flags if f.kind == "load")
    assert told.level == "look"
    assert told.evidence["mass"] == pytest.approx(0.15, rel=0.1)


def test_a_zero_is_no_load() -> None:
    found = wiring("", 0.4)
    assert found.wires["qpos.roll"].offset == pytest.approx(-0.4, abs=0.01)
    assert not [f for f in found.flags if f.kind == "load"]


STAND = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body><joint name="pitch" axis="0 1 0" damping=".01"/>
    <geom type="capsule" fromto="-.2 0 -.05 .2 0 -.05" size=".01" mass=".5"/></body></worldbody>
  <actuator><motor name="motor" joint="pitch"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("constant", [-0.15, 0.15])
def test_a_constant_torque_may_be_what_seems_to_be_another_zero(constant: float) -> None:
    """About one pose both do the same: a propeller with an offset was told a zero of .7 rad."""
    model = mujoco.MjModel.from_xml_string(STAND)
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(0), []
    for goal in 0.15 * np.sin(3 * TIME) + 0.1 * np.sin(7.1 * TIME):
        angle, speed = float(data.qpos[0]), float(data.qvel[0])
        torque = 2.0 * (goal - angle) - 0.15 * speed - constant
        rows.append([angle + 1e-4 * rng.standard_normal(), torque])
        data.ctrl[0] = torque + constant
        mujoco.mj_step(model, data, 2)
    shown, told = np.array(rows).T
    log = Recording.from_arrays(TIME, qpos={"pitch": shown}, ctrl={"motor": told})
    found = find_wiring(Model.from_xml(STAND).compile(), [log])
    assert not found.wires
    (flag,) = (f for f in found.flags if f.kind == "zero")
    assert (flag.level, flag.channels) == ("look", ("qpos.pitch",))
    assert "a constant force at pitch as well" in flag.sentence
