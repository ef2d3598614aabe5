"""A geared arm whose model, as one from a URDF, has neither rotors nor friction nor damping."""

from collections.abc import Sequence

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.bare_joints import bare_joints, from_bare_joints
from bo_sysid.diagnosis.search.final import final_fits
from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import limit_by_residual, windows_of
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

SIGMA = 1e-4
JOINTS = ("elbow", "wrist")
ROTORS, FRICTION, DAMPING = np.array([0.3, 0.04]), np.array([2.0, 0.25]), np.array([0.6, 0.08])
WANTED = ("dry_friction", "viscous_damping", "armature")
_FRAME = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>{body}</worldbody>
  <actuator>{shoulder}
    <motor name="elbow" joint="elbow"/>
    <motor name="wrist" joint="wrist"/>
  </actuator>
</mujoco>
"""
_FOREARM = """
    <body name="forearm" pos="0 0 {height}">
      <joint name="elbow" axis="0 1 0"/>
      <geom name="forearm" type="capsule" fromto="0 0 0 0 0 -.3" size=".04" mass="1.8"/>
      <body name="hand" pos="0 0 -.3">
        <joint name="wrist" axis="0 1 0"/>
        <geom name="hand" type="capsule" fromto="0 0 0 0 0 -.08" size=".03" mass=".3"/>
      </body>
    </body>
"""
XML = _FRAME.format(body=_FOREARM.format(height=1), shoulder="")
"""The wrist's rotor has a hundred times the inertia of the hand."""


SHOULDERED = _FRAME.format(
    body=f"""
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0 0 -.35" size=".05" mass="3"/>
      {_FOREARM.format(height=-0.35)}
    </body>""",
    shoulder='<motor name="shoulder" joint="shoulder"/>',
)
"""The same below a shoulder."""
SHOULDER = {"armature": 0.5, "dry_friction": 5.0, "viscous_damping": 1.0}


def tracked(seed: int, duration: float = 5.0, xml: str = XML) -> Recording:
    """Return a recording of a loop that tracks sines, the torque that it commands logged."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(xml)
    nv, joints = model.nv, [model.joint(k).name for k in range(model.nv)]
    missing = truth(joints)
    model.opt.timestep = 2.5e-4
    model.dof_armature[:] = [missing["armature", j] for j in joints]
    model.dof_frictionloss[:] = [missing["dry_friction", j] for j in joints]
    model.dof_damping[:] = [missing["viscous_damping", j] for j in joints]
    stiff, slow = np.array([1000, 400, 60])[-nv:], np.array([50, 20, 3])[-nv:]
    model.dof_solref[:], model.dof_solimp[:] = (0.002, 1), (0.9999, 0.9999, 0.001, 0.5, 2)
    data, time = mujoco.MjData(model), np.arange(0, duration, 0.002)
    rate, phase = rng.uniform(0.2, 1.2, (5, nv)), rng.uniform(0, 6, (5, nv))
    goal = 0.3 * np.sin(2 * np.pi * rate * time[:, None, None] + phase).sum(axis=1)
    data.qpos[:] = goal[0]
    q, u = np.empty((len(time), nv)), np.empty((len(time), nv))
    for k in range(len(time)):
        q[k] = data.qpos + SIGMA * rng.normal(size=nv)
        u[k] = stiff * (goal[k] - q[k]) - slow * data.qvel
        data.ctrl[:] = u[k]
        mujoco.mj_step(model, data, 8)
    named = {n: i for i, n in enumerate(joints)}
    return Recording.from_arrays(
        time,
        qpos={n: q[:, i] for n, i in named.items()},
        ctrl={n: u[:, i] for n, i in named.items()},
    )


def truth(joints: Sequence[str]) -> dict[tuple[str, str], float]:
    """Return what is missing at each joint."""
    lower = dict(zip(WANTED, (FRICTION, DAMPING, ROTORS), strict=True))
    held = {(e, j): float(v[i]) for e, v in lower.items() for i, j in enumerate(JOINTS)}
    held |= {(e, "shoulder"): x for e, x in SHOULDER.items()}
    return {key: x for key, x in held.items() if key[1] in joints}


def begun(evidence: Evidence) -> tuple[Search, int, int, float]:
    """Return a search on the shortest windows, their length, that of full ones and the step."""
    step, full = evidence.machine.model.opt.timestep, 150
    prepared, length = limit_by_residual(evidence, full, step)
    return Search.on(prepared, list(evidence.candidates), evidence.most, None), length, full, step


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
    rivals = ("actuator_gain", "link_mass", "actuator_lag")
    chosen = [CATALOGUE[e] for e in (*WANTED, *rivals)]
    evidence = make_evidence(Model.from_xml(XML), [tracked(1)], effects=chosen, threads=1)
    best = locate(evidence).decision.best
    found = {c.key: float(x[0]) for c, x in zip(best.members, best.x, strict=True)}
    assert found.keys() == truth(JOINTS).keys()
    for key, value in truth(JOINTS).items():
        assert found[key] == pytest.approx(value, rel=0.05), key
    assert best.rms < 1.1


def test_what_bare_joints_lack_is_fitted_in_full_windows_from_far_away() -> None:
    chosen = [CATALOGUE[e] for e in (*WANTED, "actuator_gain")]
    evidence = make_evidence(
        Model.from_xml(SHOULDERED), [tracked(1, xml=SHOULDERED)], effects=chosen, threads=1
    )
    search, length, full, step = begun(evidence)
    assert length < full
    found = from_bare_joints(evidence, search, length, full, step)
    assert found is not None
    assert found.nominal.rms > 500
    magnitudes = {c.key: float(x[0]) for c, x in zip(found.best.members, found.best.x, strict=True)}
    expected = truth(("shoulder", *JOINTS))
    assert magnitudes.keys() == expected.keys()
    for key, value in expected.items():
        assert magnitudes[key] == pytest.approx(value, rel=0.1), key
    assert found.best.rms < 1.3


def test_final_fits_step_finer_where_a_share_of_the_correction_leaves_much() -> None:
    """At the model's step the true effects, of 1 900 sigma, left 1.3 of the recordings."""
    chosen, step, full = [CATALOGUE[e] for e in WANTED], 0.002, 150
    evidence = make_evidence(Model.from_xml(XML), [tracked(1, 3.0)], effects=chosen, threads=1)
    prepared = prepare(windows_of(evidence, full, step))
    search = Search.on(prepared, list(evidence.candidates), 3, None)
    expected = truth(JOINTS)
    members = tuple(
        {c.key: c for c in evidence.candidates if not c.preslides}[key] for key in expected
    )
    assert search.fit(members, [np.array([x]) for x in expected.values()]).rms > 1.5
    final = final_fits(evidence, search, full, step)
    assert final.prepared.problem.windows.timestep < step
    assert final.best.rms < 1.05
    found = {c.key: float(x[0]) for c, x in zip(final.best.members, final.best.x, strict=True)}
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, rel=0.01), key


def test_bare_joints_are_tried_where_sets_may_be_as_large_and_joints_are_many() -> None:
    chosen = [CATALOGUE[e] for e in WANTED]
    for xml, most in ((SHOULDERED, 2), (XML, 3)):
        evidence = make_evidence(
            Model.from_xml(xml), [tracked(1, 2.0, xml)], effects=chosen, most=most, threads=1
        )
        search, length, full, step = begun(evidence)
        assert bare_joints(search) == ()
        assert from_bare_joints(evidence, search, length, full, step) is None
