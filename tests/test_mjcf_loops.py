"""Closed chains: joints that follow, against geometry and against MuJoCo's own motion."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest

from bo_sysid import Study, diagnose
from bo_sysid.checks.balance import Dynamics, unexplained
from bo_sysid.errors import ModelError, RecordingError
from bo_sysid.identify.problem import make_problem
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.loops import Loops
from bo_sysid.report.robot import Posed
from bo_sysid.starter.init import init
from bo_sysid.study.overview import overview

# a parallelogram: the coupler keeps its direction, the rocker turns as the crank does
PARALLELOGRAM = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <default><geom type="capsule" size=".01" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body><joint name="crank" axis="0 1 0"/><geom fromto="0 0 0 0 0 -.2" mass=".3"/>
      <body name="coupler" pos="0 0 -.2"><joint name="pin" axis="0 1 0"/>
        <geom fromto="0 0 0 .3 0 0" mass=".4"/></body></body>
    <body name="rocker" pos=".3 0 0"><joint name="follower" axis="0 1 0"/>
      <geom fromto="0 0 0 0 0 -.2" mass=".2"/></body>
  </worldbody>
  <equality><connect name="loop" body1="coupler" body2="rocker" anchor=".3 0 0" solref=".004 1"/>
  </equality>
  <actuator><motor name="drive" joint="crank"/></actuator>
</mujoco>
"""
FINGERS = """
<mujoco>
  <worldbody>
    <body><joint name="left" axis="1 0 0"/><geom size=".01" pos="0 0 .1" mass=".1"/></body>
    <body pos="0 .1 0"><joint name="right" axis="1 0 0"/><geom size=".01" pos="0 0 .1" mass=".1"/>
    </body>
  </worldbody>
  <equality><joint name="mimic" joint1="right" joint2="left" polycoef="0.1 -2 0 0 0"/></equality>
  <actuator><motor name="grip" joint="left"/></actuator>
</mujoco>
"""


def test_a_parallelogram_keeps_its_coupler_parallel() -> None:
    loops = Loops.of(mujoco.MjModel.from_xml_string(PARALLELOGRAM))
    assert loops.joints == ("pin", "follower")  # the crank has the motor
    turned = np.linspace(-0.8, 0.8, 9)
    qpos = np.column_stack([turned, np.zeros(9), np.zeros(9)])
    closed = loops.followed(qpos)
    np.testing.assert_allclose(closed, np.column_stack([turned, -turned, turned]), atol=1e-9)
    np.testing.assert_allclose(loops.opening(closed), 0, atol=1e-9)
    np.testing.assert_allclose(loops.response(closed)[:, :, 0], [[1, -1, 1]] * 9, atol=1e-9)
    _, qvel = loops.closed(closed, np.tile([2.0, 7.0, 7.0], (9, 1)))
    np.testing.assert_allclose(qvel, [[2, -2, 2]] * 9, atol=1e-8)


def test_accelerations_keep_a_loop_closed() -> None:
    uneven = PARALLELOGRAM.replace('"rocker" pos=".3 0 0"', '"rocker" pos=".3 0 .05"')
    loops = Loops.of(mujoco.MjModel.from_xml_string(uneven))
    qpos = loops.followed(np.array([[0.2, 0, 0], [0.5, 0, 0]]))
    qpos, qvel = loops.closed(qpos, np.array([[3.0, 0, 0], [-2.0, 0, 0]]))
    qacc = loops.accelerated(qpos, qvel, np.array([[4.0, 0, 0], [1.0, 0, 0]]))
    h = 1e-3
    for sign in (-1, 1):  # the opening of a Taylor step is of third order
        later = qpos + sign * h * qvel + 0.5 * h**2 * qacc
        assert loops.opening(later).max() < 50 * h**3
    assert np.abs(qacc[:, 1:] - loops.response(qpos)[:, 1:, 0] * qacc[:, :1]).max() > 0.1


def test_a_mimic_follows_in_proportion_and_a_soft_equality_does_not() -> None:
    model = mujoco.MjModel.from_xml_string(FINGERS)
    loops = Loops.of(model)
    assert (loops.joints, loops.mirrored) == (("right",), {"right": "left"})
    qpos, qvel = loops.closed(np.array([[0.3, 0.0]]), np.array([[1.0, 0.0]]))
    np.testing.assert_allclose(qpos, [[0.3, 0.1 - 2 * 0.3]])
    np.testing.assert_allclose(qvel, [[1.0, -2.0]])
    assert Loops.of(model, ["left"]).mirrored == {"left": "right"}
    soft = FINGERS.replace('<joint name="mimic"', '<joint solref="-50 -1" name="mimic"')
    assert not Loops.of(mujoco.MjModel.from_xml_string(soft))
    assert not Loops.of(model, [], ["left", "right"])


def test_one_column_is_read_for_two_joints_only_where_they_are_tied(tmp_path: Path) -> None:
    time = 0.01 * np.arange(80)
    columns = ["time", "qpos.left", "right", "ctrl.grip"]
    frame = pd.DataFrame(
        dict(zip(columns, [time, *np.sin([time, 2 * time, 3 * time])], strict=True))
    )
    frame.to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "tied.xml").write_text(FINGERS)
    (tmp_path / "apart.xml").write_text(re.sub("<equality>.*</equality>", "", FINGERS))
    study = {"recordings": {"train": "log.csv", "columns": {"qpos.right": "qpos.left"}}}
    overview(Study.from_dict({"model": "tied.xml", **study}, tmp_path))
    with pytest.raises(
        RecordingError, match=r"log.csv: qpos.left: .* as qpos.right and as qpos.left; .*'right'"
    ):
        overview(Study.from_dict({"model": "apart.xml", **study}, tmp_path))


def _turned(seconds: float, sigma: float = 0.0, seed: int = 0, change: str = "") -> pd.DataFrame:
    """Return what a parallelogram with a payload does under a multisine, seen at the crank."""
    spec = mujoco.MjSpec.from_string(PARALLELOGRAM)
    spec.option.timestep = 0.0005
    if change:
        spec.joint("crank").frictionloss = 0.05
        spec.body("coupler").geoms[0].mass = 0.6
    model = spec.compile()
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(seed), []
    phase, tone = rng.uniform(0, 2 * np.pi, 4), np.array([0.5, 0.9, 1.3, 2.1])
    for _ in range(round(seconds / 0.005)):
        control = 0.35 * np.sin(2 * np.pi * tone * data.time + phase).sum()
        control -= 0.05 * data.qvel[0] + 1.0 * data.qpos[0]
        rows.append([data.time, data.qpos[0] + sigma * rng.standard_normal(), control, *data.qpos])
        data.ctrl[0] = control
        for _step in range(10):
            mujoco.mj_step(model, data)
    columns = ["time", "qpos.crank", "ctrl.drive", "crank", "pin", "follower"]
    return pd.DataFrame(rows, columns=columns)


def test_the_balance_of_a_closed_chain_is_that_of_its_free_joint() -> None:
    frame = _turned(4.0)
    q = frame[["crank", "pin", "follower"]].to_numpy()
    v = np.gradient(q, 0.005, axis=0)
    a = np.gradient(v, 0.005, axis=0)
    inner = slice(5, -5)
    for silent in ((), ("pin", "follower")):
        given = [x.copy() for x in (q[inner], v[inner], a[inner])]
        for x in given if silent else ():
            x[:, 1:] = 0.0  # what was not recorded
        dynamics = Dynamics(mujoco.MjModel.from_xml_string(PARALLELOGRAM), silent)
        terms = dynamics.terms(*given)
        force = terms.actuated(frame[["ctrl.drive"]].to_numpy()[inner])
        assert unexplained(terms, force[None])[0, 0] < 0.003
        bodies = dynamics.of_bodies(*given).sum(axis=2)  # nothing but masses needs a force here
        np.testing.assert_allclose(bodies[:, 0], terms.required_force[:, 0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(terms.required_force[:, 1:], 0, atol=1e-12)


def _study(folder: Path, source: object) -> Study:
    (folder / "bar.xml").write_text(PARALLELOGRAM)
    for name, seed, seconds in (("a", 1, 5.0), ("b", 2, 3.0)):
        made = _turned(seconds, 3e-4, seed, "changed")
        made[["time", "qpos.crank", "ctrl.drive"]].to_csv(folder / f"{name}.csv", index=False)
    recordings = {"train": "a.csv", "holdout": "b.csv"}
    effects = ["dry_friction", "viscous_damping", "link_mass", "actuator_gain"]
    content = {"model": source, "recordings": recordings, "diagnosis": {"effects": effects}}
    return Study.from_dict(content, folder)


def test_what_a_closed_chain_lacks_is_found_from_its_motor_alone(tmp_path: Path) -> None:
    source = {"file": "bar.xml", "unrecorded": {"pin": None, "follower": None}}
    result = diagnose(_study(tmp_path, source))
    found = result.findings.set_index("effect").value
    assert set(found.index) == {"dry_friction", "link_mass"}
    assert found["dry_friction"] == pytest.approx(0.05, rel=0.05)
    ahead = {m: result.holdout.error("forecast", 0.08, m) for m in ("repaired", "noise_floor")}
    assert ahead["repaired"] <= 1.15 * ahead["noise_floor"]


@pytest.mark.parametrize("verb", [overview, make_problem, diagnose])
def test_a_log_without_passive_joints_says_that_they_follow(tmp_path: Path, verb) -> None:
    damping = {"address": "joint[crank].damping", "low": 0, "high": 1}
    content = _study(tmp_path, "bar.xml").resolved(relative_to=tmp_path) | {"parameters": [damping]}
    with pytest.raises(RecordingError, match=r"unrecorded: \{pin: null, follower: null\}"):
        verb(Study.from_dict(content, tmp_path))


def test_a_joint_that_is_tied_is_not_held(tmp_path: Path) -> None:
    (tmp_path / "hand.xml").write_text(FINGERS)
    with pytest.raises(ModelError, match=r"the equality mimic moves right with other joints"):
        Model.from_file(tmp_path / "hand.xml", hold=["right"])


def test_init_lets_joints_of_a_loop_follow(tmp_path: Path) -> None:
    _study(tmp_path, "bar.xml")
    started = init(tmp_path / "bar.xml", [tmp_path / "a.csv"], tmp_path / "study.yaml")
    assert (started.rules.held, started.rules.following) == ((), ("pin", "follower"))
    text = (tmp_path / "study.yaml").read_text()
    assert "unrecorded: {pin: null, follower: null}" in text
    assert "scale: " not in text.replace("apply: scale", "")


def test_a_picture_shows_the_chain_closed() -> None:
    posed = Posed.of(Model.from_xml(PARALLELOGRAM), {"qpos.crank": 0.5})
    np.testing.assert_allclose(posed.data.qpos, [0.5, -0.5, 0.5], atol=1e-9)
