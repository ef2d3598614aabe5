"""All actuators too weak by one share, which a mass that is too large does as well."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

SLED = """
<mujoco><option timestep=".002" gravity="0 0 0"/>
  <worldbody><body name="sled"><joint name="rail" type="slide" axis="1 0 0"/>
    <geom name="sled" type="box" size=".1 .1 .1" mass="{mass}"/></body></worldbody>
  <actuator><motor name="left" joint="rail" gear="{gain}"/>
    <motor name="right" joint="rail" gear="{gain}"/></actuator>
</mujoco>"""


def pushed(mass: float, gain: float) -> Recording:
    """Return 10 s of a sled that two motors push, each by a command of its own."""
    model = mujoco.MjModel.from_xml_string(SLED.format(mass=mass, gain=gain))
    data, rows, rng = mujoco.MjData(model), [], np.random.default_rng(3)
    for _ in range(5000):
        t = data.time
        data.ctrl[:] = 20 * np.sin(7 * t), 15 * np.cos(11 * t + 1) - 5 * np.sin(3 * t)
        rows.append((t, data.qpos[0] + 1e-3 * rng.normal(), *data.ctrl))
        mujoco.mj_step(model, data)
    time, place, left, right = np.array(rows).T
    return Recording.from_arrays(
        time, qpos={"rail": place}, ctrl={"left": left, "right": right}, name="pushed"
    )


@pytest.mark.parametrize(("mass", "gain"), [(2.3, 1.0), (2.0, 1 / 1.15)])
def test_a_mass_and_all_gains_together_are_told_as_equals(mass: float, gain: float) -> None:
    model = Model.from_xml(SLED.format(mass=2.0, gain=1.0))
    decision = locate(make_evidence(model, [pushed(mass, gain)], noise={"qpos": 1e-3})).decision
    sets = {frozenset(c.key for c in f.members): f for f in decision.equivalents}
    gains = sets[frozenset({("actuator_gain", "left"), ("actuator_gain", "right")})]
    np.testing.assert_allclose(np.concatenate(gains.x), 1 / 1.15 - 1, atol=0.01)
    assert len(decision.best.members) == 1  # with fewer magnitudes
    shares = dict(zip((f.key for f in decision.fits), decision.probability, strict=True))
    assert shares[gains.key] == pytest.approx(decision.probability[0], rel=0.01)
