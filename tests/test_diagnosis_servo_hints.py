"""Effects at a servo that together are one number of it: its gear, or its gain alone."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.answer.servo_hints import geared_servos, retuned_servos, servo_hints
from bo_sysid.diagnosis.windows.candidate import candidates
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import CATALOGUE, Site, survey
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

TILT = """<mujoco><worldbody><body><joint name="tilt" axis="0 1 0" damping=".03"/>
  <geom type="capsule" fromto="0 0 0 .1 0 0" size=".02" mass=".5"/></body></worldbody>
  <actuator><position name="servo" joint="tilt" kp="{kp}" kv=".15" gear="{gear}"/></actuator>
</mujoco>
"""


def machine(gear: float):
    time = np.arange(0.0, 2.0, 0.01)
    log = Recording.from_arrays(
        time, qpos={"tilt": np.sin(5 * time)}, ctrl={"servo": np.sin(5 * time + 0.1)}
    )
    return survey(Model.from_xml(TILT.format(gear=gear, kp=6)).compile(), [log])


def named(m, **magnitudes: float):
    """Return the hypothesis of some effects, the only candidates of their kind here."""
    members = {c.effect.id: c for c in candidates([CATALOGUE[e] for e in magnitudes], m)}
    x = [np.pad([v], (0, members[e].size - 1)) for e, v in magnitudes.items()]
    return Hypothesis(tuple(members[e] for e in magnitudes), tuple(x))


def acceleration(model: mujoco.MjModel) -> np.ndarray:
    data, found = mujoco.MjData(model), []
    for q, v, u in np.random.default_rng(0).uniform(-1, 1, (20, 3)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, u
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
    return np.array(found)


def edited(m, gear: float, parts: dict[str, float]) -> mujoco.MjModel:
    def edit(spec: mujoco.MjSpec) -> None:
        for e, value in parts.items():
            effect = CATALOGUE[e]
            site = Site(effect.kind, "servo" if effect.kind == "actuator" else "tilt")
            effect.parts(spec, site, np.pad([value], (0, len(effect.components) - 1)), m)

    return Model.from_xml(TILT.format(gear=gear, kp=6)).compile([edit])


@pytest.mark.parametrize("gear", [1.0, 2.0])
def test_an_output_a_spring_and_damping_together_are_another_gear(gear: float) -> None:
    """Equal to the last digits in MuJoCo, and told as one."""
    m, ratio = machine(gear), 1.2
    more = gear**2 * ratio * (ratio - 1)
    parts = {"actuator_gain": ratio - 1, "joint_spring": 6 * more, "viscous_damping": 0.15 * more}
    geared = Model.from_xml(TILT.format(gear=gear * ratio, kp=6)).compile()
    np.testing.assert_allclose(
        acceleration(edited(m, gear, parts)), acceleration(geared), rtol=1e-9
    )
    assert geared_servos(named(m, **parts), m) == {"servo": pytest.approx(ratio)}
    (said,) = servo_hints(named(m, **parts), m)
    assert "1.2 times the model's" in said


@pytest.mark.parametrize("gear", [1.0, 2.0])
def test_an_output_and_damping_together_are_another_gain(gear: float) -> None:
    """Equal to the last digits in MuJoCo, and told as one."""
    m = machine(gear)
    parts = {"actuator_gain": -0.4, "viscous_damping": 0.4 * 0.15 * gear**2}
    tuned = Model.from_xml(TILT.format(gear=gear, kp=3.6)).compile()
    np.testing.assert_allclose(acceleration(edited(m, gear, parts)), acceleration(tuned), rtol=1e-9)
    assert retuned_servos(named(m, **parts), m) == {"servo": pytest.approx(3.6)}
    (said,) = servo_hints(named(m, **parts), m)
    assert "3.6 instead of 6" in said


@pytest.mark.parametrize("size", [0.0, 0.5, 3.0])
def test_a_spring_and_damping_of_other_sizes_are_what_they_are(size: float) -> None:
    m = machine(1.0)
    found = named(m, actuator_gain=0.2, joint_spring=size, viscous_damping=size)
    assert servo_hints(found, m) == ()
    assert servo_hints(named(m, joint_spring=size), m) == ()
