"""`init`: studies from a model and nothing but raw logs."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from mcap_ros2.writer import Writer as McapWriter
from starter_logs import HAND, TIMES, WAVE, WHEEL, held_up, moved, tones

from bo_sysid.checks.check import check
from bo_sysid.cli import main
from bo_sysid.errors import RecordingError, UserError
from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.simulation import Engine, State
from bo_sysid.starter import signs
from bo_sysid.starter.behaviour import _judged
from bo_sysid.starter.columns import describe
from bo_sysid.starter.guess import guess_rules
from bo_sysid.starter.init import init
from bo_sysid.starter.matching import Guess, match
from bo_sysid.starter.naming import words
from bo_sysid.study import Study

ROOT = Path(__file__).parent.parent


SIX = ROOT / "studies" / "diagnosis" / "six_joint_arm_servos.xml"


TWO = ROOT / "studies" / "diagnosis" / "two_link_arm.xml"


START = 1_700_000_000 * 10**9


SEP = "\n" + "=" * 80 + "\n"


JOINTS = SEP.join(
    [
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort",
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
    ]
)


ARRAY = SEP.join(
    [
        "std_msgs/MultiArrayLayout layout\nfloat64[] data",
        "MSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
        "MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride",
    ]
)


@pytest.fixture
def mcap(tmp_path: Path) -> Path:
    """Write the log of the six-joint arm as ROS 2 does: joints in the order of the alphabet."""
    time, qpos, qvel, ctrl = moved(SIX, 0.5)
    joints = Model.from_file(SIX).joints
    order = np.argsort(joints)
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        states = writer.register_msgdef("sensor_msgs/msg/JointState", JOINTS)
        commands = writer.register_msgdef("std_msgs/msg/Float64MultiArray", ARRAY)
        for t, q, v, u in zip(time, qpos, qvel, ctrl, strict=True):
            ns = START + round(1e9 * t)
            head = {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": ""}
            message = {
                "header": head, "name": [joints[j] for j in order], "position": list(q[order]),
                "velocity": list(v[order]), "effort": [],
            }  # fmt: skip
            writer.write_message("/joint_states", states, message, ns, ns)
            layout = {"dim": [], "data_offset": 0}
            writer.write_message("/commands", commands, {"layout": layout, "data": list(u)}, ns, ns)
        writer.finish()
    return path


@pytest.mark.slow
def test_a_six_joint_arm_from_an_mcap_file(tmp_path: Path, mcap: Path) -> None:
    started = init(SIX, [mcap], tmp_path / "arm.yaml")
    study = Study.load(started.path)
    rules = study.recordings.columns
    assert rules["qpos.pitch"].source == "/joint_states.position.pitch"
    assert rules["qvel.base"].source == "/joint_states.velocity.base"
    assert rules["ctrl.elbow"].source == "/commands.data.2"
    assert started.rules.guesses["qpos.pitch"].confidence > 0.9
    assert "order alone" in started.rules.guesses["ctrl.elbow"].reason
    found = check(study)
    assert [f.sentence for f in found.flags if f.level == "wrong"] == []
    assert found.proposal == ""


@pytest.mark.slow
def test_signs_and_units_are_found_by_behaviour(tmp_path: Path) -> None:
    time, qpos, _, ctrl = moved(TWO, 1.0)
    frame = pd.DataFrame(
        {
            "t_ms": 1e3 * time, "angle1": np.rad2deg(qpos[:, 0]), "angle2": -qpos[:, 1],
            "torque1": ctrl[:, 0], "torque2": 1e3 * ctrl[:, 1], "note": "x",
        }
    )  # fmt: skip
    frame.to_csv(tmp_path / "log.csv", index=False)
    study = Study.load(init(TWO, [tmp_path / "log.csv"], tmp_path / "arm.yaml").path)
    rules = study.recordings.columns
    assert (rules["time"].source, rules["time"].unit) == ("t_ms", "ms")
    assert (rules["qpos.shoulder"].source, rules["qpos.shoulder"].unit) == ("angle1", "deg")
    assert (rules["qpos.elbow"].source, rules["qpos.elbow"].sign) == ("angle2", -1)
    assert rules["ctrl.elbow"].scale == pytest.approx(1e-3)
    text = (tmp_path / "arm.yaml").read_text()
    assert "# likely: the motion: unexplained forces" in text
    assert "the last quarter of the log" in text
    assert check(study).proposal == ""


@pytest.mark.parametrize(("samples", "side"), [(2, "earlier"), (-2, "later")])
def test_when_the_controls_act_is_said_without_a_sign(
    tmp_path: Path, samples: int, side: str
) -> None:
    """The log has each command two samples of 4 ms after, or before, it acted."""
    time, qpos, _, ctrl = moved(TWO, 1.0)
    logged = np.roll(ctrl, samples, axis=0)
    frame = pd.DataFrame(
        {
            "time": time, "pos_shoulder": qpos[:, 0], "pos_elbow": qpos[:, 1],
            "cmd_shoulder": logged[:, 0], "cmd_elbow": logged[:, 1],
        }
    )  # fmt: skip
    frame[10:-10].to_csv(tmp_path / "log.csv", index=False)
    path = init(TWO, [tmp_path / "log.csv"], tmp_path / "arm.yaml").path
    shift = Study.load(path).recordings.clocks["ctrl"].shift
    assert shift == pytest.approx(-0.004 * samples, abs=2e-3)
    (line,) = (x for x in path.read_text().splitlines() if "shift" in x)
    assert re.search(rf"likely: {1e3 * abs(shift):.1f} ms \(± .*\) {side} than stamped", line)
    assert ("between samples" in line) == (side == "earlier")


def test_columns_called_like_the_joints_are_positions_and_their_units_are_read(
    tmp_path: Path,
) -> None:
    time, qpos, qvel, ctrl = moved(TWO, 1.0)
    frame = pd.DataFrame(
        {
            "time": time, "shoulder": qpos[:, 0], "elbow_deg": np.rad2deg(qpos[:, 1]),
            "elbow_deg_s": np.rad2deg(qvel[:, 1]), "elbow_temperature": 30 + time,
            "u_shoulder": ctrl[:, 0], "u_elbow": ctrl[:, 1],
        }
    )  # fmt: skip
    frame.to_csv(tmp_path / "log.csv", index=False)
    study = Study.load(init(TWO, [tmp_path / "log.csv"], tmp_path / "arm.yaml").path)
    rules = study.recordings.columns
    assert rules["qpos.shoulder"].source == "shoulder"
    assert (rules["qpos.elbow"].source, rules["qpos.elbow"].unit) == ("elbow_deg", "deg")
    assert (rules["qvel.elbow"].source, rules["qvel.elbow"].unit) == ("elbow_deg_s", "deg/s")
    assert (rules["ctrl.shoulder"].source, rules["ctrl.elbow"].source) == ("u_shoulder", "u_elbow")


def test_the_control_of_a_joint_that_is_held_is_not_read(tmp_path: Path) -> None:
    """Holding a joint takes its actuator out of the model, and a channel of it would be refused."""
    time, qpos, _, ctrl = moved(TWO, 1.0)
    log = {"time": time, "pos_shoulder": qpos[:, 0], "tau_shoulder": ctrl[:, 0]}
    pd.DataFrame(log | {"tau_elbow": ctrl[:, 1]}).to_csv(tmp_path / "log.csv", index=False)
    started = init(TWO, [tmp_path / "log.csv"], tmp_path / "arm.yaml")
    assert (started.rules.held, started.rules.unused) == (("elbow",), ("tau_elbow",))
    assert "ctrl.elbow" not in Study.load(started.path).recordings.columns
    check(Study.load(started.path))


def test_a_urdf_gets_motors_and_a_joint_without_a_column_is_held(tmp_path: Path) -> None:
    link = (
        '<link name="{0}"><inertial><mass value="1"/><origin xyz="0 0 -.1"/>'
        '<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
    joint = (
        '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/>'
        '<axis xyz="0 1 0"/></joint>'
    )
    text = (
        '<robot name="arm"><link name="base"/>'
        + link.format("upper")
        + link.format("hand")
        + joint.format("elbow", "base", "upper")
        + joint.format("wrist", "upper", "hand")
        + "</robot>"
    )
    (tmp_path / "arm.urdf").write_text(text)
    time = np.arange(0.0, 4.0, 0.005)
    pd.DataFrame(
        {"time": time, "elbow_pos": np.sin(3 * time), "elbow_torque": np.cos(time)}
    ).to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "arm.urdf", [tmp_path / "log.csv"], tmp_path / "arm.yaml")
    assert any("has a motor" in n for n in started.notes)
    assert started.rules.held == ("wrist",)
    study = Study.load(started.path)
    assert study.model.hold == ("wrist",)
    exported = mujoco.MjModel.from_xml_path(str(tmp_path / "arm_motors.xml"))
    assert [exported.actuator(a).name for a in range(exported.nu)] == ["elbow", "wrist"]
    assert "continuous" not in str(check(study).flags)


def test_a_model_without_actuators_stays_as_it_was_written(tmp_path: Path) -> None:
    """A study beside it gets a model with motors of another name, and nothing where it fails."""
    model = tmp_path / "arm.xml"
    model.write_text("<!-- mine -->" + re.sub("<actuator>.*</actuator>", "", HAND, flags=re.S))
    time = np.arange(0.0, 4.0, 0.005)
    names = ("yaw", "shoulder", "elbow", "gripper")
    log = pd.DataFrame({"time": time, **{f"{n}_pos": np.sin(3 * time + len(n)) for n in names}})
    log.to_csv(tmp_path / "log.csv", index=False)
    log[["yaw_pos"]].to_csv(tmp_path / "empty.csv", index=False)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    with pytest.raises(UserError):
        init(model, [tmp_path / "empty.csv"], tmp_path / "arm.yaml")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    study = Study.load(init(model, [tmp_path / "log.csv"], tmp_path / "arm.yaml").path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.name in before} == before
    assert study.model.file == "arm_motors.xml"
    (tmp_path / "arm.yaml").unlink()
    with pytest.raises(UserError, match=r"arm_motors\.xml: exists"):
        init(model, [tmp_path / "log.csv"], tmp_path / "arm.yaml")


def test_bounds_and_limits_are_those_of_all_logs_but_the_held_out(tmp_path: Path) -> None:
    """The first log is the calmest, the held-out one the wildest."""
    model = tmp_path / "wheel.xml"
    model.write_text(WHEEL.format(limits=""))
    compiled = Model.from_file(model).compile()
    time = np.arange(0.0, 6.0, 0.004)
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    turned, torque, paths = [], [], []
    for k, drive in enumerate((0.1, 0.8, 0.5, 3.0)):
        ctrl = drive * tones(time, k)
        turned.append(Engine(1).rollout(compiled, start, ctrl[None, :, None]).qpos[0, :-1, 0])
        torque.append(ctrl)
        paths.append(tmp_path / f"log{k}.csv")
        log = {"time": time, "wheel_position": turned[-1], "wheel_torque": ctrl}
        pd.DataFrame(log).to_csv(paths[-1], index=False)
    path = init(model, paths, tmp_path / "wheel.yaml").path
    text = path.read_text()
    low, high = (float(f(np.concatenate(turned[:3]))) for f in (np.min, np.max))
    ends = re.search(r"#   wheel: \{position: \[(.*), (.*)\], velocity: ", text)
    assert ends is not None
    assert [float(x) for x in ends.groups()] == pytest.approx((low, high), abs=0.01 * (high - low))
    assert float(ends[1]) <= low
    assert float(ends[2]) >= high
    told = float(text.split("velocity: ")[1].split("}")[0])
    assert told == pytest.approx(np.abs(np.gradient(turned[1], time)).max(), rel=0.1)
    bounds = {
        p.addresses[0]: p.high for p in Study.load(path).parameter_set(Model.from_file(model))
    }
    assert bounds["joint[wheel].frictionloss"] == pytest.approx(
        2 * np.concatenate(torque[:3]).std(), rel=0.05
    )


def test_a_model_without_hinges_and_slides_is_refused_in_words() -> None:
    body = '<body><joint name="b" type="ball"/><geom size=".1"/></body>'
    ball = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    with pytest.raises(RecordingError, match=r"no hinge or slide.*'qpos.b.0'"):
        guess_rules(Model.from_xml(ball), RawTable("log", {"time": TIMES, "qpos.b.0": WAVE}))


def test_names_are_split() -> None:
    assert words("/joint_states.position.leftElbow2") == (
        "joint", "states", "position", "left", "elbow", "2",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"temp": [4, 2, 5]}, r"no column looks like a clock among 'temp'"),
        ({"a": [0, 3, 1], "pos1": [1, 2, 4]}, r"no column looks like a clock among 'a', 'pos1'"),
    ],
)
def test_columns_that_match_nothing(
    tmp_path: Path, columns: dict[str, list[float]], expected: str
) -> None:
    pd.DataFrame(columns).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(RecordingError, match=expected):
        init(TWO, [tmp_path / "log.csv"], tmp_path / "arm.yaml")
    assert not (tmp_path / "arm.yaml").exists()


def test_a_bad_cell_in_a_column_of_numbers_is_named(tmp_path: Path) -> None:
    model = tmp_path / "wheel.xml"
    model.write_text(WHEEL.format(limits=""))
    time = np.arange(0.0, 4.0, 0.01)
    frame = pd.DataFrame({"time": time, "wheel_pos": np.sin(time), "wheel_torque": np.cos(time)})
    cells = frame.astype(object)
    cells.loc[7, "wheel_torque"] = "foo"
    cells.assign(remark="all well").to_csv(tmp_path / "log.csv", index=False)
    started = init(model, [tmp_path / "log.csv"], tmp_path / "wheel.yaml")
    assert [n for n in started.notes if "log.csv" in n] == [
        f"{tmp_path / 'log.csv'}: column 'wheel_torque', row 7: 'foo' is not a number; a recorded "
        "column holds numbers only."
    ]
    for column in ("wheel_pos", "time"):
        cells = frame.astype(object)
        cells.loc[7, column] = "foo"
        cells.to_csv(tmp_path / "other.csv", index=False)
        with pytest.raises(RecordingError, match=rf"column '{column}', row 7: 'foo' is not a numb"):
            init(model, [tmp_path / "other.csv"], tmp_path / "other.yaml")


def test_logs_of_two_formats_and_a_study_that_exists(tmp_path: Path) -> None:
    for name, column in (("a", "pos1"), ("b", "pos3")):
        pd.DataFrame({"time": [0, 1, 2], column: [1, 2, 4]}).to_csv(
            tmp_path / f"{name}.csv", index=False
        )
    with pytest.raises(RecordingError, match=r"b.csv: its columns differ .*pos1, pos3"):
        init(TWO, [tmp_path / "a.csv", tmp_path / "b.csv"], tmp_path / "arm.yaml")
    (tmp_path / "arm.yaml").write_text("mine")
    with pytest.raises(UserError, match="exists; name another file"):
        init(TWO, [tmp_path / "a.csv"], tmp_path / "arm.yaml")
    assert (tmp_path / "arm.yaml").read_text() == "mine"


def test_the_command_says_what_it_guessed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    time, qpos, _, ctrl = moved(TWO, 1.0)
    pd.DataFrame({"time": time, "pos_shoulder": qpos[:, 0], "pos_elbow": qpos[:, 1],
                  "cmd_shoulder": ctrl[:, 0], "cmd_elbow": ctrl[:, 1]}).to_csv(
        tmp_path / "log.csv", index=False
    )  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["init", str(TWO), "log.csv"]) == 0
    assert "pos_elbow" in capsys.readouterr().out
    assert main(["check", "two_link_arm.yaml", "--out", "found"]) == 0
    assert "nothing to correct" in capsys.readouterr().out
    assert (tmp_path / "found" / "log.png").stat().st_size > 10_000


def test_the_command_to_go_on_with_can_be_pasted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    time, qpos, _, ctrl = moved(TWO, 1.0)
    pd.DataFrame({"time": time, "pos_shoulder": qpos[:, 0], "pos_elbow": qpos[:, 1],
                  "cmd_shoulder": ctrl[:, 0], "cmd_elbow": ctrl[:, 1]}).to_csv(
        tmp_path / "log.csv", index=False
    )  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["init", str(TWO), "log.csv", "--out", "my arm's.yaml"]) == 0
    said = capsys.readouterr().out.rpartition("then: ")[2]
    assert shlex.split(said) == ["bo-sysid", "check", "my arm's.yaml"]


GANTRY = """
<mujoco model="gantry"><option timestep="0.004"/><worldbody><body>
  <joint name="x_axis" type="slide" axis="1 0 0" range="-5 5" limited="true" damping="12"/>
  <geom type="box" size=".1 .3 .04" mass="4" contype="0" conaffinity="0"/><body>
  <joint name="y_axis" type="slide" axis="0 1 0" damping="8"/>
  <geom type="box" size=".05 .05 .03" mass="1.5" contype="0" conaffinity="0"/>
  <body name="pendulum"><joint name="swing" axis="0 1 0" damping=".002"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5" contype="0" conaffinity="0"/>
  </body></body></body></worldbody>
  <actuator><motor name="x_motor" joint="x_axis" gear="600"/>
  <position name="y_servo" joint="y_axis" kp="900" kv="40"/></actuator></mujoco>"""


def moved_gantry(path: Path) -> pd.DataFrame:
    """Return the log of a gantry, whose motor has gear and whose servo is told in mm."""
    path.write_text(GANTRY)
    model = Model.from_file(path).compile()
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = np.stack([0.05 * tones(time, 3), 0.1 * tones(time, 4)], axis=1)
    start = State(np.zeros((1, model.nq)), np.zeros((1, model.nv)), np.zeros((1, 0)))
    q = Engine(1).rollout(model, start, ctrl[None]).qpos[0, :-1]
    q = q + 1e-5 * np.random.default_rng(0).standard_normal(q.shape)
    return pd.DataFrame(
        {"epoch": 1.7e9 + time, "PosX_mm": 1e3 * q[:, 0], "PosY_mm": 1e3 * q[:, 1],
         "Pend_deg": np.rad2deg(q[:, 2]), "TqX": ctrl[:, 0], "CmdY_mm": 1e3 * ctrl[:, 1]}
    )  # fmt: skip


def test_letters_and_beginnings_of_words_are_names(tmp_path: Path) -> None:
    moved_gantry(tmp_path / "gantry.xml").to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "gantry.xml", [tmp_path / "log.csv"], tmp_path / "gantry.yaml")
    rules = {n: (r.source, r.unit) for n, r in Study.load(started.path).recordings.columns.items()}
    assert rules == {
        "time": ("epoch", None), "qpos.x_axis": ("PosX_mm", "mm"), "qpos.y_axis": ("PosY_mm", "mm"),
        "qpos.swing": ("Pend_deg", "deg"), "ctrl.x_motor": ("TqX", None),
        "ctrl.y_servo": ("CmdY_mm", "mm"),
    }  # fmt: skip
    reasons = {n: g.reason for n, g in started.rules.guesses.items()}
    assert all("the motion agrees" in r for r in reasons.values())
    # the pendulum swings along x, and so tells which way that counts; nothing tells it of y
    assert {n for n, r in reasons.items() if "both turned" in r} == {"qpos.y_axis", "ctrl.y_servo"}
    assert check(Study.load(started.path)).proposal == ""


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("a1_deg", "b1_mm", "b2_mm"), {"swing": 0, "x_axis": 1, "y_axis": 2}),
        (("a_mm", "b_deg", "c_mm"), {"swing": 1, "x_axis": 0, "y_axis": 2}),
        (("a_mm", "b_deg"), {"swing": 1}),
    ],
)
def test_a_unit_keeps_a_column_from_a_joint_that_cannot_have_it(
    names: tuple[str, ...], expected: dict[str, int]
) -> None:
    """By their order alone, an angle would be a slide's position, and a length a hinge's."""
    table = RawTable("log", {"time": TIMES, **{n: (k + 1) * WAVE for k, n in enumerate(names)}})
    rules = guess_rules(Model.from_xml(GANTRY.replace('name="pendulum"', "")), table).columns
    found = {n: names.index(r["from"]) for n, r in rules.items() if n != "time"}
    assert {n.removeprefix("qpos."): k for n, k in found.items()} == expected


def test_columns_of_no_name_are_matched_by_what_they_move(tmp_path: Path) -> None:
    log = moved_gantry(tmp_path / "gantry.xml")
    rng = np.random.default_rng(3)
    log["vbat"] = 24 + 0.1 * rng.standard_normal(len(log))
    names = {"TqX": "ch7", "CmdY_mm": "ch3_mm"}
    log.rename(columns=names).to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "gantry.xml", [tmp_path / "log.csv"], tmp_path / "gantry.yaml")
    rules = started.rules
    assert (rules.columns["ctrl.x_motor"]["from"], rules.columns["ctrl.y_servo"]["from"]) == (
        "ch7", "ch3_mm",
    )  # fmt: skip
    assert "the force at x_axis" in rules.guesses["ctrl.x_motor"].reason
    assert rules.unused == ()
    assert rules.columns["aux.voltage"] == {"from": "vbat", "unit": "V"}  # by its name


def test_a_log_that_fits_nothing_gives_a_study_to_fill_in(tmp_path: Path) -> None:
    time = np.arange(0.0, 2.0, 0.01)
    log = pd.DataFrame({"time": time, "temp": 30 + time, "code": np.cos(9 * time)})
    log.to_csv(tmp_path / "log.csv", index=False)
    started = init(TWO, [tmp_path / "log.csv"], tmp_path / "arm.yaml")
    assert started.notes == (
        "No column was found for: qpos.shoulder, qpos.elbow, ctrl.shoulder, ctrl.elbow. Fill in "
        "what is marked.",
    )
    study = Study.load(started.path)
    rules = {n: r.source for n, r in study.recordings.columns.items()}
    channels = ("qpos.shoulder", "qpos.elbow", "ctrl.shoulder", "ctrl.elbow")
    assert rules == dict.fromkeys(channels, "FILL IN")
    assert (
        "qpos.elbow: {from: FILL IN}  # not found; one of: temp, code" in started.path.read_text()
    )
    with pytest.raises(RecordingError, match=r"shoulder: fill in the column.*temp, code"):
        check(study)


def test_a_control_without_a_column_is_to_be_filled_in(tmp_path: Path) -> None:
    time, angle, _ = held_up(tmp_path / "boom.xml")
    spare = np.random.default_rng(2).standard_normal((2, len(time)))
    log = pd.DataFrame({"time": time, "enc_boom": angle, "vbat": spare[0], "code": spare[1]})
    log.to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "boom.xml", [tmp_path / "log.csv"], tmp_path / "boom.yaml")
    text = started.path.read_text()
    assert "ctrl.boom_drive: {from: FILL IN}  # not found; one of: vbat, code" in text
    guess = started.rules.guesses["qpos.boom_joint"]  # its sign is known by nobody
    assert guess.confidence <= 0.7
    assert "its sign is not told: not all that moves boom_joint is known" in guess.reason


def test_a_cable_at_one_joint_is_not_said_to_drive_several(tmp_path: Path) -> None:
    """A finger with a spring that the model lacks: its forces are not explained."""
    finger = """<mujoco><worldbody><body>
        <joint name="knuckle" axis="0 1 0" damping=".01" stiffness="{spring}" armature=".0005"/>
        <geom type="capsule" fromto="0 0 0 .08 0 0" size=".01" mass=".07"/>
        </body></worldbody>
        <tendon><fixed name="cable"><joint joint="knuckle" coef="0.01"/></fixed></tendon>
        <actuator><motor name="winch" tendon="cable"/></actuator></mujoco>"""
    (tmp_path / "plant.xml").write_text(finger.format(spring=0.3))
    (tmp_path / "finger.xml").write_text(finger.format(spring=0))
    time, qpos, _, ctrl = moved(tmp_path / "plant.xml", 14.0)
    log = pd.DataFrame({"time": time, "knuckle": qpos[:, 0], "pull": ctrl[:, 0]})
    log.to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "finger.xml", [tmp_path / "log.csv"], tmp_path / "finger.yaml")
    told = "its sign is not told: no joint shows it whose forces the model explains"
    assert told in started.rules.guesses["ctrl.winch"].reason


def test_a_log_that_is_too_short_is_told_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "two.csv").write_text("time,shoulder,elbow\n0,0,0\n0.01,0.1,0.1\n")
    with pytest.raises(RecordingError, match=r"two\.csv: 2 samples of qpos\.shoulder"):
        init(TWO, [tmp_path / "two.csv"], tmp_path / "study.yaml")


def test_a_sign_that_a_rough_balance_tells_is_not_laid_to_other_joints() -> None:
    """The only joint of a gripper had its sign told by "the motion of others"."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="knuckle" axis="0 1 0"/><geom size=".1"/></body>
        </worldbody></mujoco>"""
    )
    guess = Guess("qpos.knuckle", "knuckle", "", "the name", 1.0)
    own, others = (
        _judged(model, {guess.channel: guess}, signs.Tested(left, {}, {}))[guess.channel].reason
        for left in ({"knuckle": 0.29}, {})
    )
    assert own == "the name; the motion tells its sign; 29 % of the forces there stay unexplained"
    assert others == "the name; the motion of others tells its sign"


@pytest.mark.parametrize(("sign", "zero"), [(1, 0.0), (-1, 0.0), (1, -2.2)])
def test_a_sign_that_the_range_asks_for_stands_unless_the_motion_disagrees(
    tmp_path: Path, sign: int, zero: float
) -> None:
    """An encoder that is 2.2 rad off lies outside the range, its mirror image inside."""
    time, angle, ctrl = held_up(tmp_path / "boom.xml")
    encoder = np.rad2deg(sign * angle + zero)
    assert -150 < -encoder.max() < -encoder.min() < 150
    log = pd.DataFrame({"time": time, "enc_boom_deg": encoder, "tau_boom_Nm": ctrl})
    log.to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "boom.xml", [tmp_path / "log.csv"], tmp_path / "boom.yaml")
    rule = Study.load(started.path).recordings.columns["qpos.boom_joint"]
    assert rule.sign == sign
    assert rule.offset == pytest.approx(-zero, abs=0.02)
    guess = started.rules.guesses["qpos.boom_joint"]
    assert ("the mirror image inside" in guess.reason) == (sign < 0)
    assert ("a load that the model lacks" in guess.reason) == (zero != 0.0)
    expected = 0.5 if zero else 0.95 if sign > 0 else 0.8
    assert guess.confidence == pytest.approx(expected)


def test_a_drive_that_is_late_alone_gives_no_clock(tmp_path: Path) -> None:
    log = moved_gantry(tmp_path / "gantry.xml")
    log["TqX"] = np.roll(log["TqX"], -6)  # logged 24 ms before it acts
    log[10:-10].to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "gantry.xml", [tmp_path / "log.csv"], tmp_path / "gantry.yaml")
    assert Study.load(started.path).recordings.clocks == {}
    assert started.rules.columns["ctrl.x_motor"]["from"] == "TqX"


FOUR_BAR = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <default><joint axis="0 1 0" damping=".02"/><geom type="capsule" size=".01" contype="0"
    conaffinity="0" mass=".2"/></default>
  <worldbody>
    <body name="crank">
      <joint name="crank"/><geom fromto="0 0 0 0 0 .1"/>
      <body name="coupler" pos="0 0 .1"><joint name="pin"/><geom fromto="0 0 0 .3 0 0"/></body>
    </body>
    <body name="rocker" pos=".3 0 -.1"><joint name="rocker"/><geom fromto="0 0 0 0 0 .2"/></body>
  </worldbody>
  <equality><connect body1="coupler" body2="rocker" anchor=".3 0 0"/></equality>
  <actuator><motor name="drive" joint="crank"/></actuator>
</mujoco>
"""


def test_a_linkage_is_read_from_the_angle_of_its_motor(tmp_path: Path) -> None:
    """Three joints, one motor: the columns are too few for all, and enough for what is driven."""
    model = mujoco.MjModel.from_xml_string(FOUR_BAR)
    data, rows = mujoco.MjData(model), []
    for k in range(800):
        data.ctrl[0] = 0.25 * np.sin(0.03 * k) + 0.15 * np.sin(0.071 * k)
        rows.append((data.time, data.qpos[0], data.ctrl[0]))
        mujoco.mj_step(model, data, 2)
    (tmp_path / "four.xml").write_text(FOUR_BAR)
    columns = ["Time [s]", "Motor angle [rad]", "Torque [Nm]"]
    pd.DataFrame(rows, columns=columns).to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "four.xml", [tmp_path / "log.csv"], tmp_path / "study.yaml")
    found = {n: rule["from"] for n, rule in started.rules.columns.items() if "." in n}
    assert found == {"qpos.crank": "Motor angle [rad]", "ctrl.drive": "Torque [Nm]"}
    assert set(Study.load(started.path).model.unrecorded) == {"pin", "rocker"}


@pytest.mark.parametrize("first", [0, 1, 2])
def test_a_log_may_count_from_another_number_than_the_model(first: int) -> None:
    """Most numbers are shared, and none means the same where the first is another."""
    table = RawTable("log", {f"q{k + first}": np.arange(9.0) for k in range(4)})
    told = [replace(c, kind="position") for c in describe(table)]
    joints = [f"joint_{k + 1}" for k in range(4)]
    found = match("qpos", joints, told)
    assert {g.channel: g.column for g in found} == {
        f"qpos.joint_{k + 1}": f"q{k + first}" for k in range(4)
    }
    more = match("qpos", joints, [*told, replace(told[-1], name="q9", words=("q", "9"))])
    known = {f"qpos.joint_{k}": f"q{k}" for k in range(1, 5)} if first == 1 else {}
    assert {g.channel: g.column for g in more} == known


def test_a_joint_that_never_moves_gets_no_parameters(tmp_path: Path) -> None:
    rng, time = np.random.default_rng(0), np.arange(1000) * 0.01
    frame = pd.DataFrame(
        {
            "time": time,
            "qpos.shoulder": np.sin(2 * time) + 1e-4 * rng.normal(size=1000),
            "qpos.elbow": 0.3 + 1e-4 * rng.normal(size=1000),
            "ctrl.shoulder": np.cos(2 * time),
            "ctrl.elbow": 0 * time,
        }
    )
    frame.to_csv(tmp_path / "log.csv", index=False)
    init(TWO, [tmp_path / "log.csv"], tmp_path / "study.yaml")
    text = (tmp_path / "study.yaml").read_text()
    assert "# elbow never moves in the log" in text
    parameters = Study.load(tmp_path / "study.yaml").parameters
    assert [p.unit for p in parameters] == ["N m", "N m s/rad", "kg m²"]
    addresses = {p.address[0] for p in parameters}
    assert addresses == {f"joint[shoulder].{n}" for n in ("frictionloss", "damping", "armature")}


def test_a_joint_that_never_turns_back_gets_parameters(tmp_path: Path) -> None:
    rng, time = np.random.default_rng(0), np.arange(1000) * 0.01
    noise = lambda: 1e-4 * rng.normal(size=1000)  # noqa: E731
    frame = pd.DataFrame({"time": time, "qpos.shoulder": np.sin(2 * time) + noise()})
    frame["qpos.elbow"] = 0.1 * time + noise()
    frame["ctrl.shoulder"], frame["ctrl.elbow"] = np.cos(2 * time), np.sin(time)
    frame.to_csv(tmp_path / "log.csv", index=False)
    init(TWO, [tmp_path / "log.csv"], tmp_path / "study.yaml")
    assert "never moves" not in (tmp_path / "study.yaml").read_text()
    addresses = {p.address[0] for p in Study.load(tmp_path / "study.yaml").parameters}
    assert "joint[elbow].damping" in addresses
