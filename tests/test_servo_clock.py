"""A servo without any delay: neither its clock nor its missing force says that it has one."""

import mujoco
import numpy as np
import pytest

from bo_sysid.checks.estimate import Estimate, delay
from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.traces import Traces
from bo_sysid.diagnosis.unexplained.missing_force import missing_force
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.timestep import FINER
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording

KP, STEP = 40.0, 0.002
SERVO = f"""
<mujoco>
  <option timestep="{STEP}"/>
  <worldbody>
    <body>
      <joint name="bucket" axis="0 1 0" damping="0.05" armature="0.01"/>
      <geom type="box" size=".07 .06 .05" pos=".08 0 .03" mass=".7"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="bucket" kp="{KP:g}" kv="1.5"/></actuator>
</mujoco>
"""
NOISE = 5e-4  # [rad]


def recorded(seed: int, seconds: float = 12.0, noise: float = NOISE) -> Recording:
    """Return a log of 200 Hz of the servo, which moves continuously (Runge-Kutta)."""
    model = mujoco.MjModel.from_xml_string(SERVO)
    model.opt.timestep, model.opt.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_RK4
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    rate, phase = rng.uniform(1.0, 6.0, 4), rng.uniform(0.0, 2 * np.pi, 4)
    time = np.arange(0.0, seconds, 0.005)
    goal = 0.3 * np.sin(time[:, None] * rate + phase).sum(axis=1)
    data.qpos[:] = goal[0]
    seen = np.empty_like(time)
    for k, wanted in enumerate(goal):
        seen[k], data.ctrl[:] = data.qpos[0], wanted
        mujoco.mj_step(model, data, nstep=10)
    seen += noise * rng.standard_normal(len(time))
    return Recording(
        "servo",
        {"qpos.bucket": Channel(time, seen), "ctrl.servo": Channel(time, goal, hold="zero")},
    )


def clock(recording: Recording) -> Estimate:
    evidence = WiringEvidence(
        mujoco.MjModel.from_xml_string(SERVO), Traces([recording], ["qpos.bucket"]), 1200
    )
    return delay(evidence, evidence.identity(), "ctrl.servo")


@pytest.mark.parametrize("noise", [1e-4, NOISE])
def test_a_servo_that_acts_at_its_stamps_is_said_to_within_the_interval(noise: float) -> None:
    """Noise in speeds and accelerations makes it seem late by 2 to 4 ms; the interval says so."""
    told = [clock(recorded(seed, noise=noise)) for seed in range(6)]
    size = np.sqrt(np.mean([e.sigma**2 for e in told]))
    assert abs(np.mean([e.value for e in told])) < 1.96 * size < 0.01
    assert sum(abs(e.value) > 1.96 * e.sigma for e in told) <= 1
    assert not any(abs(e.value) > 4 * e.sigma for e in told)  # none would be corrected


def test_without_noise_the_clock_of_a_servo_is_exact() -> None:
    told = [clock(recorded(seed, noise=0.0)) for seed in range(3)]
    assert max(abs(e.value) for e in told) < 1e-4
    assert max(e.sigma for e in told) < 1e-3


@pytest.mark.parametrize("division", [1, 8])
def test_half_a_long_step_of_a_servo_is_no_missing_force(division: int) -> None:
    """A command that is held for a step moves a model half a step early: k h/2 over speed."""
    evidence = make_evidence(Model.from_xml(SERVO), [recorded(0)], noise={"qpos": NOISE}, threads=1)
    shown = (1 - 1 / division) / (1 - 1 / FINER)
    pieces = missing_force(evidence, Hypothesis(numerics=shown), STEP)
    slope = np.polyfit(pieces["speed"], pieces["nominal"], 1)[0]
    sigma = pieces["sigma"].median() / (pieces["speed"].std() * np.sqrt(len(pieces)))
    assert slope == pytest.approx(-0.5 * STEP * KP / division, abs=4 * sigma)
    assert 4 * sigma < 0.1 * STEP * KP
    np.testing.assert_allclose(pieces["repaired"], pieces["nominal"], rtol=1e-6, atol=1e-9)
