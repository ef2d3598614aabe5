"""A link that is driven against its stops: they are met as contacts are."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

SIGMA, EVERY = 4e-4, 0.005
LINK = """<mujoco><compiler angle="degree"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body><joint name="link" axis="0 1 0" armature=".01" damping=".05" range="-40 30"
solreflimit=".02 .6"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8"
contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor name="drive" joint="link"/></actuator></mujoco>"""


def driven(friction: float) -> Recording:
    """Return a link that meets its stops, stepped eight times finer than the model."""
    spec = mujoco.MjSpec.from_string(LINK)
    spec.option.timestep = 0.00025
    spec.joint("link").frictionloss = friction
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    time, angles, torques = np.arange(0, 8, EVERY), [], []
    waves = rng.uniform(0.3, 1.6, 4), rng.uniform(0, 6, 4)
    for t in time:
        data.ctrl[0] = 0.9 * np.sin(2 * np.pi * waves[0] * t + waves[1]).sum()
        angles.append(data.qpos[0] + SIGMA * rng.standard_normal())
        torques.append(data.ctrl[0])
        mujoco.mj_step(model, data, round(EVERY / model.opt.timestep))
    return Recording.from_arrays(time, qpos={"link": angles}, ctrl={"drive": np.array(torques)})


@pytest.mark.parametrize("friction", [0.0, 0.06])
def test_stops_that_are_met_ask_for_no_other_name(friction: float) -> None:
    recording = driven(friction)
    beyond = np.rad2deg(recording.channels["qpos.link"].values)
    assert (beyond > 30).mean() > 0.02
    assert (beyond < -40).mean() > 0.02
    looked_for = ("dry_friction", "backlash", "cogging", "armature", "viscous_damping")
    evidence = make_evidence(
        Model.from_xml(LINK), [recording], effects=[CATALOGUE[e] for e in looked_for], threads=1
    )
    best = locate(evidence).decision.best
    assert [c.effect.id for c in best.members] == (["dry_friction"] if friction else [])
    if friction:
        assert best.x[0][0] == pytest.approx(friction, rel=0.15)
