"""How long windows may be before small disturbances grow in them."""

import numpy as np
import pytest

from bo_sysid.diagnosis.search.window_lengths import limit_by_growth_rate
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import CATALOGUE, Effect
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

MASS, LENGTH, GRAVITY, STEP = 0.2, 0.1, 9.81, 0.001
INERTIA, LEVER = MASS * LENGTH**2, MASS * GRAVITY * LENGTH
FULL = 400
XML = f"""
<mujoco>
  <option timestep="{STEP}"/>
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0"/>
      <inertial pos="0 0 {LENGTH}" mass="{MASS}" diaginertia="1e-9 1e-9 1e-9"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
"""A point mass held upright, which falls as exp(λt), λ = √(g/l)."""


def upright(*chosen: Effect) -> Evidence:
    time = np.arange(0, 4, STEP)
    swing = {"hinge": 0.01 * np.sin(3 * time)}
    recording = Recording.from_arrays(time, qpos=swing, ctrl={"motor": 0.01 * np.cos(3 * time)})
    return make_evidence(Model.from_xml(XML), [recording], effects=chosen, threads=1)


def of(evidence: Evidence, **magnitudes: float) -> Hypothesis:
    members: tuple[Candidate, ...] = tuple(
        next(c for c in evidence.candidates if c.effect.id == e) for e in magnitudes
    )
    return Hypothesis(members, tuple(np.array([x]) for x in magnitudes.values()))


def falling(damping: float = 0.0, rotor: float = 0.0) -> float:
    """Return λ of (I + J) λ² + b λ - m g l = 0."""
    inertia = INERTIA + rotor
    return (np.sqrt(damping**2 + 4 * inertia * LEVER) - damping) / (2 * inertia)


def test_windows_are_as_long_as_disturbances_grow_to_e_squared() -> None:
    evidence = upright(CATALOGUE["armature"])
    assert falling() == pytest.approx(np.sqrt(GRAVITY / LENGTH))
    assert limit_by_growth_rate(evidence, FULL, STEP) == pytest.approx(
        2 / falling() / STEP, rel=0.02
    )


@pytest.mark.parametrize("known", [{"damping": 0.01}, {"rotor": 0.004}])
def test_windows_are_longer_at_a_set_that_falls_more_slowly(known: dict[str, float]) -> None:
    evidence = upright(CATALOGUE["viscous_damping"], CATALOGUE["armature"])
    names = {"damping": "viscous_damping", "rotor": "armature"}
    at = of(evidence, **{names[k]: x for k, x in known.items()})
    wanted = 2 / falling(**known) / STEP
    assert wanted > 1.1 * 2 / falling() / STEP
    assert limit_by_growth_rate(evidence, FULL, STEP, at) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize("encoder", [0.0, 1.0])
def test_a_joint_that_a_set_adds_makes_no_window_longer(encoder: float) -> None:
    evidence = upright(CATALOGUE["joint_compliance"])
    stiff = next(c for c in evidence.candidates if c.shapes[0] == encoder)
    at = Hypothesis((stiff,), (np.array([1e-3, 1e-3, 0.5]),))
    assert limit_by_growth_rate(evidence, FULL, STEP, at) == pytest.approx(
        2 / falling() / STEP, rel=0.02
    )
