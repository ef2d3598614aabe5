"""`init`: machines that float."""

from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from starter_logs import TIMES, WAVE

from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.starter.init import init
from bo_sysid.starter.pose import pose_guesses, pose_rule
from bo_sysid.study import Study


def test_the_pose_of_a_floating_base_is_found_by_its_letters(tmp_path: Path) -> None:
    (tmp_path / "rover.xml").write_text(
        '<mujoco><worldbody><body name="rover"><freejoint name="root"/><geom size=".1"/>'
        '<body pos="0 .2 0"><joint name="wheel"/><geom size=".1"/></body></body></worldbody>'
        '<actuator><velocity name="drive" joint="wheel" kv="1"/></actuator></mujoco>'
    )
    time = 0.01 * np.arange(400)
    log = {"time": time, "mocap_x": 0.1 * np.sin(time), "mocap_y": 0 * time, "mocap_z": 0 * time}
    turn = 0.3 * np.sin(2 * time)
    log |= {"mocap_qx": 0 * time, "mocap_qy": 0 * time, "mocap_qz": np.sin(turn / 2)}
    log |= {"mocap_qw": np.cos(turn / 2), "wheel_pos": np.sin(time), "drive_cmd": np.cos(time)}
    pd.DataFrame(log).to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "rover.xml", [tmp_path / "log.csv"], tmp_path / "study.yaml")
    found = [started.rules.columns[f"qpos.root.{k}"]["from"] for k in range(7)]
    assert found == [f"mocap_{k}" for k in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    assert "base: fixed" not in (tmp_path / "study.yaml").read_text()
    assert "unit" not in started.rules.columns["qpos.wheel"]
    why = "cannot be compared with the model: a joint is neither a hinge nor a slide"
    assert started.rules.guesses["ctrl.drive"].reason.endswith(why)
    pd.DataFrame(log).drop(columns="mocap_qw").to_csv(tmp_path / "part.csv", index=False)
    held = init(tmp_path / "rover.xml", [tmp_path / "part.csv"], tmp_path / "other.yaml")
    assert any("wrong for one that drives or walks" in note for note in held.notes)


@pytest.mark.parametrize(
    "called", ["mocap_{}_mm", "x_mm", "pos_{}_mm", "drone_pos_{}_mm", "p{} [mm]", "mocap_{}"]
)
def test_the_unit_behind_the_letters_of_a_pose_is_left_aside_and_written(
    tmp_path: Path, called: str
) -> None:
    places = {k: called.format(k) if "{" in called else f"{k}_mm" for k in "xyz"}
    compiled = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint name="root"/><geom size=".1"/></body></worldbody>'
        "</mujoco>"
    )
    columns = {name: np.linspace(0, 500, 9) for name in places.values()}
    columns |= {f"rot_{k}": np.full(9, float(k == "w")) for k in "xyzw"}
    table = RawTable("log", columns)
    found = {g.channel: (g.column, pose_rule(table, g)) for g in pose_guesses(compiled, table)}
    assert [found[f"qpos.root.{k}"][0] for k in range(3)] == list(places.values())
    unit = {"unit": "mm"} if "mm" in called else {}
    assert found["qpos.root.0"][1] == {"from": places["x"], **unit}
    assert found["qpos.root.3"][1] == {"from": "rot_w"}


def test_a_machine_that_only_floats_is_read_from_its_pose_and_its_motors(tmp_path: Path) -> None:
    """A quadrotor has no joint but its base; its motors are the numbered columns that are left."""
    arms = "".join(f'<site name="arm{k}" pos="{x} 0 0"/>' for k, x in ((1, 0.1), (2, -0.1)))
    motors = "".join(f'<motor name="m{k}" site="arm{k}" gear="0 0 1 0 0 0"/>' for k in (1, 2))
    (tmp_path / "quad.xml").write_text(
        f'<mujoco><worldbody><body name="frame"><freejoint name="base"/><geom size=".1"/>{arms}'
        f"</body></worldbody><actuator>{motors}</actuator></mujoco>"
    )
    time = 0.01 * np.arange(300)
    log = {"time": time, **{f"mocap_{k}": 0.1 * np.sin(time) for k in "xyz"}}
    log |= {"mocap_qw": np.ones(300), **{f"mocap_q{k}": np.zeros(300) for k in "xyz"}}
    log |= {"motor2": 20 + np.cos(3 * time), "motor1": 20 + np.sin(7 * time)}  # no rates
    log |= {"battery": 16 - time}
    pd.DataFrame(log).to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "quad.xml", [tmp_path / "log.csv"], tmp_path / "study.yaml")
    columns = {n: rule["from"] for n, rule in started.rules.columns.items()}
    assert columns["qpos.base.0"] == "mocap_x"
    assert columns["qpos.base.3"] == "mocap_qw"
    assert (columns["ctrl.m1"], columns["ctrl.m2"]) == ("motor1", "motor2")
    assert set(Study.load(started.path).recordings.columns) == set(columns)

    other = {"m1": log.pop("motor1"), "m2": log.pop("motor2"), "m3": np.cos(9 * time), **log}
    pd.DataFrame(other).to_csv(tmp_path / "other.csv", index=False)
    named = init(tmp_path / "quad.xml", [tmp_path / "other.csv"], tmp_path / "other.yaml")
    text = named.path.read_text()
    assert "ctrl.m2: {from: m2}  # likely: the same name" in text
    assert "GUESS, look at it: the order" not in text
    twice = other | {"M_1": np.sin(5 * time)}  # which of both m1 is, nothing tells
    pd.DataFrame(twice).to_csv(tmp_path / "twice.csv", index=False)
    some = init(tmp_path / "quad.xml", [tmp_path / "twice.csv"], tmp_path / "twice.yaml")
    assert "ctrl.m2: {from: m2}  # likely: the same name" in some.path.read_text()
    assert "ctrl.m1: {from: FILL IN" in some.path.read_text()


@pytest.mark.parametrize(("kind", "size"), [("free", 7), ("ball", 4)])
def test_a_log_that_names_every_coordinate_of_a_pose_needs_no_guess(
    tmp_path: Path, kind: str, size: int
) -> None:
    (tmp_path / "body.xml").write_text(
        f'<mujoco><worldbody><body><joint name="root" type="{kind}"/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    turn = {size - 4: np.cos(WAVE), size - 1: np.sin(WAVE)}
    pose = {f"qpos.root.{k}": turn.get(k, 0.0 * TIMES) for k in range(size)}
    pd.DataFrame({"time": TIMES, **pose}).to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "body.xml", [tmp_path / "log.csv"], tmp_path / "study.yaml")
    assert set(Study.load(started.path).recordings.columns) <= {"time"}
    assert started.notes == ()


@pytest.mark.parametrize(
    ("place", "turn"), [("mocap_{}", "mocap_q{}"), ("pos_{}", "quat_{}"), ("{}", "q{}")]
)
def test_a_gyro_beside_the_pose_of_a_base_is_no_position(place: str, turn: str) -> None:
    text = '<mujoco><worldbody><body><freejoint name="b"/><geom size=".1"/></body></worldbody>'
    columns = {"time": TIMES, **{f"gyro_{k}": WAVE for k in "xyz"}}
    columns |= {place.format(k): 0.1 * WAVE for k in "xyz"}
    columns |= {turn.format(k): np.full(len(TIMES), float(k == "w")) for k in "wxyz"}
    columns |= {f"acc_{k}": WAVE for k in "xyz"}
    compiled = Model.from_xml(text + "</mujoco>").compile()
    found = [g.column for g in pose_guesses(compiled, RawTable("log", columns))]
    assert found == [place.format(k) for k in "xyz"] + [turn.format(k) for k in "wxyz"]


def test_joints_by_which_a_base_floats_get_no_parameters(tmp_path: Path) -> None:
    """Of a cart on wheels, friction of the joints x, z and pitch would be the wheels'."""
    (tmp_path / "balancer.xml").write_text(
        """<mujoco><worldbody><body pos="0 0 .1">
        <joint name="x" type="slide" axis="1 0 0"/> <joint name="z" type="slide" axis="0 0 1"/>
        <joint name="pitch" axis="0 1 0"/> <geom size=".02" fromto="0 0 0 0 0 .4" type="capsule"/>
        <body><joint name="wheel" axis="0 1 0"/><geom type="cylinder" size=".1 .02"/></body>
        </body></worldbody><actuator><motor name="wheel" joint="wheel"/></actuator></mujoco>"""
    )
    rng, time = np.random.default_rng(0), np.arange(1000) * 0.01
    moved = {
        f"qpos.{n}": np.sin((k + 2) * time) + 1e-4 * rng.normal(size=1000)
        for k, n in enumerate(("x", "z", "pitch", "wheel"))
    }
    frame = pd.DataFrame({"time": time, **moved, "ctrl.wheel": np.cos(2 * time)})
    frame.to_csv(tmp_path / "log.csv", index=False)
    init(tmp_path / "balancer.xml", [tmp_path / "log.csv"], tmp_path / "study.yaml")
    assert "# pitch is how the base floats" in (tmp_path / "study.yaml").read_text()
    addresses = {p.address[0] for p in Study.load(tmp_path / "study.yaml").parameters}
    assert addresses == {f"joint[wheel].{n}" for n in ("frictionloss", "damping", "armature")}
