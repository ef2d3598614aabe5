"""A supply that sags while it is recorded: plants by plain MuJoCo."""

import mujoco
import numpy as np
import pytest
from diagnosis_helpers import ARM, SIGMA, arm

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.effects import CATALOGUE
from bo_sysid.recording import Channel, Recording

FULL, FINER = 24.0, 8
LOOKED_FOR = (
    "voltage_sag", "actuator_gain", "actuator_saturation", "back_emf", "viscous_damping",
    "dry_friction", "armature", "payload",
)  # fmt: skip


def driven_by_a_battery(duration: float) -> Recording:
    """Return a log of an arm whose elbow's torque is in proportion to a voltage that falls."""
    plant, rng = mujoco.MjModel.from_xml_path(str(ARM)), np.random.default_rng(0)
    step = plant.opt.timestep
    plant.opt.timestep = step / FINER
    data, time = mujoco.MjData(plant), np.arange(0.0, duration, step)
    rate, phase = 2 * np.pi * rng.uniform(0.3, 2.0, (2, 6)), rng.uniform(0, 6, (2, 6))
    tones = np.sin(rate[:, :, None] * time + phase[:, :, None]).sum(axis=1)
    u, volts = tones.T * (0.5, 0.18), FULL - 3.0 * time / duration - 2.0 * np.abs(np.sin(time))
    q = np.empty_like(u)
    for k in range(len(time)):
        q[k], data.ctrl[:] = data.qpos, u[k] * (1.0, volts[k] / FULL)
        mujoco.mj_step(plant, data, nstep=FINER)
    q += SIGMA * rng.standard_normal(q.shape)
    joints = ("shoulder", "elbow")
    log = Recording.from_arrays(
        time,
        qpos=dict(zip(joints, q.T, strict=True)),
        ctrl=dict(zip(joints, u.T, strict=True)),
    )
    supply = Channel(time, volts, "V", hold="zero")
    return Recording("battery", {**log.channels, "aux.voltage": supply})


def test_a_supply_that_sags_is_named_with_its_volts() -> None:
    log = driven_by_a_battery(6.0)
    effects, noise = [CATALOGUE[name] for name in LOOKED_FOR], {"qpos": SIGMA}
    best = locate(
        make_evidence(arm(), [log], effects=effects, noise=noise, threads=1)
    ).decision.best
    (found,), (x,) = best.members, best.x
    assert found.key == ("voltage_sag", "elbow")
    assert x[0] == pytest.approx(np.ptp(log.channels["aux.voltage"].values), rel=0.03)
    assert best.rms < 1.05
