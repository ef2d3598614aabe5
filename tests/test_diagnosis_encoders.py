"""An encoder behind gears, on a joint that a servo holds: no small change leads to it."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording

SERVO = """
<mujoco>
  <worldbody>
    <body name="bucket">
      <joint name="bucket" axis="0 1 0" damping="0.05" armature="0.01"/>
      <geom type="box" size=".07 .06 .05" pos=".08 0 .03" mass=".7"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="bucket" kp="40" kv="1.5"/></actuator>
</mujoco>
"""
SIGMA = 5e-4  # [rad]
RIVALS = ("viscous_damping", "gravity_compensation", "cogging", "servo_kp", "servo_kd")


def recorded(scale: float, way: str) -> Recording:
    """Return a log of a servo whose encoder reads 1 + scale times the position, finely stepped.

    Args:
        scale: of the reading.
        way: what the servo takes from its encoder: position and "rate", or neither, with the
            "goal" brought to the joint's own scale.
    """
    model, factor = mujoco.MjModel.from_xml_string(SERVO), 1.0 + scale
    model.opt.timestep = 5e-4
    if way == "goal":
        model.actuator_gainprm[0, 0] /= factor
    else:
        model.actuator_biasprm[0, 1:3] *= factor
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    rate, phase = rng.uniform(1.0, 6.0, 4), rng.uniform(0.0, 2 * np.pi, 4)
    time = np.arange(0.0, 8.0, 0.005)
    goal = 0.3 * np.sin(time[:, None] * rate + phase).sum(axis=1)
    seen = np.empty_like(time)
    for k, wanted in enumerate(goal):
        seen[k], data.ctrl[:] = factor * data.qpos[0], wanted
        mujoco.mj_step(model, data, nstep=10)
    seen += SIGMA * rng.standard_normal(len(time))
    told = Channel(time, goal, hold="zero")
    return Recording("servo", {"qpos.bucket": Channel(time, seen), "ctrl.servo": told})


@pytest.mark.parametrize(
    ("scale", "way", "shapes"), [(1.1, "rate", (1, 0)), (-0.5, "goal", (0, 1))]
)
def test_an_encoder_behind_gears_is_named(scale: float, way: str, shapes: tuple[int, int]) -> None:
    """From small scales alone one is another way beside damping, one less gravity and cogging."""
    effects = [CATALOGUE[name] for name in ("encoder_scale", *RIVALS)]
    model, noise = Model.from_xml(SERVO), {"qpos": SIGMA}
    found = make_evidence(model, [recorded(scale, way)], effects=effects, noise=noise, threads=1)
    best = locate(found).decision.best
    (finding,) = best.members
    assert finding.key == ("encoder_scale", "bucket")
    assert tuple(finding.shapes) == shapes
    assert best.x[0] == pytest.approx(scale, rel=0.01)
