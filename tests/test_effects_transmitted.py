"""Forces that reach a joint through a tendon or a closed chain, against mechanics on paper."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.effects import CATALOGUE, survey
from bo_sysid.effects.transmitted import transmitted
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

TIME = 0.005 * np.arange(2401)
SWING = 0.1 * np.sin(1.2 * TIME)
RATE = 0.12 * np.cos(1.2 * TIME)
COMMAND = 2.4 * np.sin(1.2 * TIME + 0.3)
BELT = """<mujoco><option timestep=".002" integrator="implicitfast"/><worldbody>
  <body name="carriage">
    <joint name="x" type="slide" axis="1 0 0" damping="4"/>
    <geom size=".05" mass="1" contype="0" conaffinity="0"/></body></worldbody>
  <tendon><fixed name="belt"><joint joint="x" coef="20"/></fixed></tendon>
  <actuator>{}</actuator></mujoco>"""
SERVO = '<position name="belt" tendon="belt" kp="2" kv=".05"{}/>'
PARALLELOGRAM = """<mujoco><option timestep=".002" gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0" mass=".1"/></default><worldbody>
  <body name="crank"><joint name="crank" axis="0 1 0"/><geom size=".01" pos="0 0 .1"/>
    <body name="coupler" pos="0 0 .1"><joint name="pin" axis="0 1 0"/>
      <geom size=".01" pos=".3 0 0"/></body></body>
  <body name="rocker" pos=".3 0 0"><joint name="rocker" axis="0 1 0"/>
    <geom size=".01" pos="0 0 .1"/></body></worldbody>
  <equality><connect body1="coupler" body2="rocker" anchor=".3 0 0" solref=".005 1"/></equality>
  <actuator><motor name="crank" joint="crank" gear="{}"/></actuator></mujoco>"""


def _largest(model: str, log: Recording, dof: int) -> float:
    return float(np.abs(transmitted(mujoco.MjModel.from_xml_string(model), [log])[:, dof]).max())


@pytest.mark.parametrize("delay", ["", ' delay=".004" nsample="4"'])
def test_a_servo_pulls_at_a_joint_through_a_tendon(delay) -> None:
    log = Recording.from_arrays(TIME, qpos={"x": SWING}, ctrl={"belt": COMMAND})
    expected = 20 * (2 * (COMMAND - 20 * SWING) - 0.05 * 20 * RATE)
    found = _largest(BELT.format(SERVO.format(delay)), log, 0)
    assert found == pytest.approx(np.abs(expected).max(), rel=0.02)


def test_how_strong_a_servo_at_a_tendon_was_is_told_with_where_its_joint_was() -> None:
    """Its command alone, a position, says 4.8 N."""
    log = Recording.from_arrays(TIME, qpos={"x": SWING}, ctrl={"belt": COMMAND})
    model = mujoco.MjModel.from_xml_string(BELT.format(SERVO.format("")))
    expected = 2 * (COMMAND - 20 * SWING) - 0.05 * 20 * RATE
    found = survey(model, [log]).actuators["belt"]
    assert found.force_max == pytest.approx(np.abs(expected).max(), rel=0.02)
    assert found.force_std == pytest.approx(expected.std(), rel=0.02)


def test_a_filtered_motor_pulls_as_late_as_it_acts() -> None:
    """Of a sine a first-order lag leaves 1 / sqrt(1 + (w tau)^2)."""
    motor = '<general name="belt" tendon="belt" dyntype="filter" dynprm="1" gainprm="1"/>'
    log = Recording.from_arrays(TIME, qpos={"x": SWING}, ctrl={"belt": np.sin(3 * TIME)})
    forces = transmitted(mujoco.MjModel.from_xml_string(BELT.format(motor)), [log])[100:, 0]
    assert np.sqrt(2) * forces.std() == pytest.approx(20 / np.sqrt(10), rel=0.05)


def test_a_muscle_at_a_tendon_pulls_as_it_did_in_the_plant() -> None:
    """Its activation follows from excitation and motion; at rest it would not pull at all."""
    muscle = '<muscle name="belt" tendon="belt" lengthrange="-3 3" force="5"/>'
    plant = mujoco.MjModel.from_xml_string(BELT.format(muscle))
    data, rows = mujoco.MjData(plant), []
    for u in np.repeat(np.clip(COMMAND, 0, 1), 2):
        data.ctrl[:] = u
        mujoco.mj_forward(plant, data)
        rows.append([data.time, data.qpos[0], u, data.qfrc_actuator[0]])
        mujoco.mj_step(plant, data)
    time, q, u, force = np.transpose(rows)
    found = transmitted(plant, [Recording.from_arrays(time, qpos={"x": q}, ctrl={"belt": u})])
    pulled = np.interp(np.linspace(time[0], time[-1], len(found)), time, force)
    assert np.abs(pulled).max() > 10
    np.testing.assert_allclose(found[20:, 0], pulled[20:], atol=0.03 * np.abs(pulled).max())


@pytest.mark.parametrize("gear", [1, -3])
def test_a_parallelogram_passes_a_torque_on_as_it_is(gear) -> None:
    log = Recording.from_arrays(
        TIME,
        qpos={"crank": SWING, "pin": -SWING, "rocker": SWING},
        ctrl={"crank": COMMAND},
    )
    model, torque = PARALLELOGRAM.format(gear), abs(gear) * np.abs(COMMAND).max()
    for dof, expected in enumerate((0.0, torque, torque)):  # the drive itself, and what follows
        assert _largest(model, log, dof) == pytest.approx(expected, rel=0.01, abs=1e-9)


def test_a_machine_whose_drives_sit_at_its_joints_passes_nothing_on() -> None:
    motor = '<motor name="belt" joint="x"/>'
    log = Recording.from_arrays(TIME, qpos={"x": SWING}, ctrl={"belt": COMMAND})
    assert _largest(BELT.format(motor), log, 0) == 0.0
    scale = survey(mujoco.MjModel.from_xml_string(BELT.format(motor)), [log]).joints["x"]
    assert scale.driven == pytest.approx(np.abs(COMMAND).max())


def test_friction_that_a_slow_belt_overcomes_is_named() -> None:
    """It is twenty times what the carriage's own inertia and damping need."""
    plant = mujoco.MjModel.from_xml_string(BELT.format(SERVO.format("")))
    plant.opt.timestep, plant.dof_frictionloss[0] = 0.0005, 8.0
    data, q = mujoco.MjData(plant), []
    for u in np.repeat(COMMAND, 10):
        q.append(data.qpos[0])
        data.ctrl[:] = u
        mujoco.mj_step(plant, data)
    noisy = np.array(q[::10]) + 2e-4 * np.random.default_rng(0).standard_normal(len(TIME))
    log = Recording.from_arrays(TIME, qpos={"x": noisy}, ctrl={"belt": COMMAND})
    model = Model.from_xml(BELT.format(SERVO.format("")))
    effects = [CATALOGUE["dry_friction"], CATALOGUE["viscous_damping"]]
    best = locate(
        make_evidence(model, [log], effects=effects, noise={"qpos": 2e-4}, threads=1)
    ).decision.best
    assert [c.key for c in best.members] == [("dry_friction", "x")]
    assert best.hypothesis.x[0][0] == pytest.approx(8.0, rel=0.02)
