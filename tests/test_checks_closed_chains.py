"""A closed chain that was recorded where it cannot close, and forces that noise drowns."""

import mujoco
import numpy as np
import pandas as pd
import pytest

from bo_sysid.checks.comparable import comparable
from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.wiring_text import noise_flags, open_flags
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

# a crank of 0.3 m and two passive links of 0.2 m from a pivot 0.5 m away: the pivot is within
# 0.4 m of the crank's end up to arccos(0.6) = 0.93 rad
CRANK = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
<body name="crank"><joint name="a" axis="0 -1 0" damping=".01"/>
 <geom type="capsule" fromto="0 0 0 .3 0 0" size=".01" mass=".3"/></body>
<body name="one" pos=".5 0 0"><joint name="b" axis="0 -1 0" damping=".01"/>
 <geom type="capsule" fromto="0 0 0 -.1 0 .1732" size=".01" mass=".2"/>
 <body name="two" pos="-.1 0 .1732"><joint name="c" axis="0 -1 0" damping=".01"/>
  <geom type="capsule" fromto="0 0 0 -.1 0 -.1732" size=".01" mass=".2"/></body></body></worldbody>
<equality><connect body1="crank" body2="two" anchor=".3 0 0" solref="2e-3 1"/></equality>
<actuator><motor name="a" joint="a" ctrlrange="-1 1"/></actuator></mujoco>"""
REACH = np.arccos(0.6)


def recorded(scale: float) -> Recording:
    """The crank of a simulated machine, within its reach, times a wrong scale."""
    plant = mujoco.MjModel.from_xml_string(CRANK)
    data, time = mujoco.MjData(plant), 0.002 * np.arange(4000)
    goal = 0.7 * np.sin(4 * time) * np.cos(1.3 * time)
    angle, torque = np.zeros(len(time)), np.zeros(len(time))
    for k in range(len(time)):
        angle[k] = data.qpos[0]
        torque[k] = data.ctrl[0] = 4 * (goal[k] - data.qpos[0]) - 0.2 * data.qvel[0]
        mujoco.mj_step(plant, data)
    assert 0.5 < np.abs(angle).max() < REACH
    seen = scale * (angle + np.random.default_rng(0).normal(0, 1e-5, len(time)))
    return Recording.from_arrays(time, qpos={"a": seen}, ctrl={"a": torque})


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_a_chain_that_cannot_close_as_it_was_recorded_is_told(scale: float) -> None:
    log = recorded(scale)
    beyond = (np.abs(log.channels["qpos.a"].values) > REACH).mean()
    made = comparable(Model.from_xml(CRANK).compile(), [log], 400)
    assert not isinstance(made, str)
    evidence = WiringEvidence(*made)
    flags = open_flags(evidence, evidence.identity())
    assert len(flags) == (scale == 2.0)
    for flag in flags:
        assert (flag.level, flag.channels) == ("wrong", ("a",))
        assert flag.evidence["share"] > beyond - 0.05  # where it is lost it may stay so


@pytest.mark.parametrize(("noise", "told"), [(1e-6, ()), (0.8, ("a",))])
def test_forces_that_noise_drowns_are_not_tested(noise: float, told: tuple[str, ...]) -> None:
    balance = pd.DataFrame(
        {"joint": ["a", "b"], "before": [1.0, 0.0], "after": [1.0 - noise, 0.0]}
        | {"noise": [noise, 9.0], "used": [True, False]}
    )
    assert tuple(n for flag in noise_flags(balance) for n in flag.channels) == told
