"""A geared arm whose model, as one from a URDF, has neither rotors nor friction nor damping."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.diagnose import make_evidence
from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

SIGMA = 1e-4
JOINTS = ("elbow", "wrist")
ROTORS, FRICTION, DAMPING = np.array([0.3, 0.04]), np.array([2.0, 0.25]), np.array([0.6, 0.08])
XML = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="forearm" pos="0 0 1">
      <joint name="elbow" axis="0 1 0"/>
      <geom name="forearm" type="capsule" fromto="0 0 0 0 0 -.3" size=".04" mass="1.8"/>
      <body name="hand" pos="0 0 -.3">
        <joint name="wrist" axis="0 1 0"/>
        <geom name="hand" type="capsule" fromto="0 0 0 0 0 -.08" size=".03" mass=".3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="elbow" joint="elbow"/>
    <motor name="wrist" joint="wrist"/>
  </actuator>
</mujoco>
"""
"""The wrist's rotor has a hundred times the inertia of the hand."""


def tracked(seed: int, duration: float = 5.0) -> Recording:
    """Return a recording of a loop that tracks sines, the torque that it commands logged."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(XML)
    model.opt.timestep = 2.5e-4
    model.dof_armature[:], model.dof_frictionloss[:], model.dof_damping[:] = (
        ROTORS,
        FRICTION,
        DAMPING,
    )
    model.dof_solref[:], model.dof_solimp[:] = (0.002, 1), (0.9999, 0.9999, 0.001, 0.5, 2)
    data, time = mujoco.MjData(model), np.arange(0, duration, 0.002)
    rate, phase = rng.uniform(0.2, 1.2, (5, 2)), rng.uniform(0, 6, (5, 2))
    goal = 0.3 * np.sin(2 * np.pi * rate * time[:, None, None] + phase).sum(axis=1)
    data.qpos[:] = goal[0]
    q, u = np.empty((len(time), 2)), np.empty((len(time), 2))
    for k in range(len(time)):
        q[k] = data.qpos + SIGMA * rng.normal(size=2)
        u[k] = [400, 60] * (goal[k] - q[k]) - [20, 3] * data.qvel
        data.ctrl[:] = u[k]
        mujoco.mj_step(model, data, 8)
    named = {n: i for i, n in enumerate(JOINTS)}
    return Recording.from_arrays(
        time,
        qpos={n: q[:, i] for n, i in named.items()},
        ctrl={n: u[:, i] for n, i in named.items()},
    )


def test_bounds_hold_what_a_gear_and_a_gripper_can_do() -> None:
    chosen = [CATALOGUE[e] for e in ("armature", "payload")]
    evidence = make_evidence(
        Model.from_xml(XML), [tracked(1, 2.0)], effects=chosen, noise={"qpos": SIGMA}, threads=1
    )
    high = {c.key: float(c.high[0]) for c in evidence.candidates}
    link = evidence.machine.joints["wrist"].inertia
    assert link < ROTORS[1] / 20  # a bound of a few of it would hold the rotor out
    assert ROTORS[1] < high["armature", "wrist"] < 100 * ROTORS[1]
    assert high["payload", "hand"] == pytest.approx(1.8 + 0.3)  # what moves, not five hands


@pytest.mark.slow
def test_rotors_friction_and_damping_of_all_joints_are_named_with_their_sizes() -> None:
    wanted = ("dry_friction", "viscous_damping", "armature")
    rivals = ("actuator_gain", "link_mass", "actuator_lag")
    chosen = [CATALOGUE[e] for e in (*wanted, *rivals)]
    evidence = make_evidence(Model.from_xml(XML), [tracked(1)], effects=chosen, threads=1)
    best = locate(evidence).decision.best
    found = {c.key: float(x[0]) for c, x in zip(best.members, best.x, strict=True)}
    truth = dict(zip(wanted, (FRICTION, DAMPING, ROTORS), strict=True))
    expected = {(e, j): v[i] for e, v in truth.items() for i, j in enumerate(JOINTS)}
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, rel=0.05), key
    assert best.rms < 1.1
