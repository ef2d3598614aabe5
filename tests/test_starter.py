"""`init`: studies from a model and nothing but raw logs."""

import re
import shlex
from dataclasses import replace
from math import pi
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from mcap_ros2.writer import Writer as McapWriter

from bo_sysid.checks.check import check
from bo_sysid.cli import main
from bo_sysid.errors import RecordingError, UserError
from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.simulation import Engine, State
from bo_sysid.starter import columns as starter_columns
from bo_sysid.starter import signs
from bo_sysid.starter.behaviour import _judged
from bo_sysid.starter.columns import derivatives, describe
from bo_sysid.starter.guess import guess_rules, read
from bo_sysid.starter.init import init
from bo_sysid.starter.matching import Guess, match
from bo_sysid.starter.naming import words
from bo_sysid.starter.pose import pose_guesses, pose_rule
from bo_sysid.starter.reading import clock_rule
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


def tones(time: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = [np.sin(2 * pi * f * time + rng.uniform(0, 6)) for f in rng.uniform(0.2, 2.0, 5)]
    return np.sum(parts, axis=0) / 3 * np.minimum(time / 0.5, 1.0)


def moved(path: Path, drive: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return time, positions, speeds and controls of a model under random tones."""
    model = Model.from_file(path).compile()
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = np.stack([drive * tones(time, a + 3) for a in range(model.nu)], axis=1)
    start = State(np.zeros((1, model.nq)), np.zeros((1, model.nv)), np.zeros((1, 0)))
    steps = round(0.004 / model.opt.timestep)
    run = Engine(1).rollout(model, start, np.repeat(ctrl, steps, axis=0)[None])
    noise = 1e-4 * np.random.default_rng(0).standard_normal((len(time), model.nq))
    return time, run.qpos[0, :-1:steps] + noise, run.qvel[0, :-1:steps], ctrl


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


def test_rates_are_told_from_positions_by_behaviour() -> None:
    time = np.arange(0.0, 6.0, 0.01)
    q, p = np.sin(2 * time), np.sin(3.1 * time + 1)
    table = RawTable(
        "log",
        {
            "clock": time,
            "a": q,
            "b": p,
            "c": 3.1 * np.cos(3.1 * time + 1),
            "d": 2 * np.cos(2 * time),
        },
    )
    assert derivatives(table, ["a", "b", "c", "d"]) == {"d": "a", "c": "b"}
    kinds = {c.name: c.kind for c in describe(table)}
    assert kinds == {
        "clock": "time", "a": "position", "b": "position", "c": "velocity", "d": "velocity",
    }  # fmt: skip


def test_columns_are_smoothed_one_by_one_and_not_in_pairs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Logs of thousands of columns take long enough without."""
    smooth, calls = starter_columns._smooth, []

    def counted(values: np.ndarray) -> np.ndarray:
        calls.append(1)
        return smooth(values)

    monkeypatch.setattr(starter_columns, "_smooth", counted)
    time, taken = np.arange(0.0, 6.0, 0.01), []
    for count in (5, 10):
        waves = {f"c{k}": np.sin((1 + k) * time) for k in range(count)}
        calls.clear()
        derivatives(RawTable("log", waves), list(waves))
        taken.append(len(calls))
    assert taken[1] == 2 * taken[0]


def test_axes_of_one_place_are_no_rates_of_each_other() -> None:
    """On a circle y is the rate of x but for its scale; the speed beside them is told."""
    time = np.arange(0.0, 6.0, 0.01)
    columns = {
        "time": time,
        "mocap_x": np.cos(2 * time),
        "mocap_y": np.sin(2 * time),
        "a": np.sin(3.1 * time),
        "b": 3.1 * np.cos(3.1 * time),
    }
    kinds = {c.name: c.kind for c in describe(RawTable("log", columns))}
    assert kinds == {
        "time": "time", "mocap_x": "other", "mocap_y": "other", "a": "position", "b": "velocity",
    }  # fmt: skip


HAND = """
<mujoco><worldbody><body><joint name="yaw"/><geom size=".1"/><body><joint name="shoulder"/>
  <geom size=".1"/><body><joint name="elbow"/><geom size=".1"/><body>
  <joint name="gripper" type="slide"/><geom size=".1"/></body></body></body></body></worldbody>
  <actuator><position name="ma" joint="yaw"/><position name="mb" joint="shoulder"/>
  <position name="mc" joint="elbow"/><position name="md" joint="gripper"/></actuator></mujoco>
"""
TIMES = 1e6 * np.arange(0.0, 2.0, 0.01)
WAVE = np.sin(1e-6 * TIMES)


def test_columns_between_known_ones_are_matched_by_their_order() -> None:
    names = [f"J{k + 1}_{n} {w} (deg)" for k, n in enumerate(("Yaw", "Pitch", "Elbow"))
             for w in ("pos", "cmd")]  # fmt: skip
    table = RawTable("log", {"stamp_us": TIMES, **dict.fromkeys(names, 30 * WAVE)})
    rules = guess_rules(Model.from_xml(HAND), table)
    assert rules.held == ("gripper",)
    assert rules.unmatched == ("md",)
    assert rules.columns["time"] == {"from": "stamp_us", "unit": "us"}
    assert rules.columns["qpos.shoulder"] == {"from": "J2_Pitch pos (deg)", "unit": "deg"}
    assert rules.columns["ctrl.mb"] == {"from": "J2_Pitch cmd (deg)", "unit": "deg"}
    assert rules.guesses["ctrl.mb"].confidence < 0.5
    swapped = ["J3_Elbow pos (deg)", "J2_Pitch pos (deg)", "J1_Yaw pos (deg)"]
    other = RawTable("log", {"t": 1e-6 * TIMES, **dict.fromkeys(swapped, 30 * WAVE)})
    assert guess_rules(Model.from_xml(HAND), other).held == ("shoulder", "gripper")


@pytest.mark.parametrize("name", ["stamp", "stamp_ns"])
def test_a_clock_of_durations_needs_no_unit(name: str) -> None:
    seconds = np.arange(200) * 1.0
    spans = (1e9 * seconds).astype("timedelta64[ns]")
    table = RawTable("log", {name: spans, "yaw": np.sin(seconds)})
    assert guess_rules(Model.from_xml(HAND), table).columns["time"] == {"from": name}


WHEEL = """
<mujoco><option timestep="0.004"/><worldbody><body>
  <joint name="wheel" axis="0 1 0" damping="0.02" {limits}/>
  <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass="1"/></body></worldbody>
  <actuator><motor name="wheel" joint="wheel"/></actuator></mujoco>"""
LIMITED = 'limited="true" range="-3 3"'


@pytest.mark.parametrize(
    ("limits", "stated", "expected"),
    [
        ("", None, {}),
        (LIMITED, None, {"unit": "deg"}),
        (LIMITED, "rad", {}),
        (LIMITED, "degrees", {}),
        (LIMITED, "counts", {"unit": "ticks", "scale": pytest.approx(2 * pi / 4096)}),
    ],
)
def test_a_unit_is_guessed_by_the_reach_only_where_limits_speak_for_it(
    limits: str, stated: str | None, expected: dict[str, object]
) -> None:
    units = {} if stated is None else {"wheel_position": stated}
    table = RawTable("log", {"time": TIMES, "wheel_position": 196 * WAVE}, units=units)
    rules = guess_rules(Model.from_xml(WHEEL.format(limits=limits)), table)
    assert rules.columns["qpos.wheel"] == {"from": "wheel_position", **expected}
    guess = rules.guesses["qpos.wheel"]
    if expected:
        told = "4096 ticks" if "scale" in expected else "deg, since it reaches 196"
        assert guess.confidence <= 0.5
        assert told in guess.reason
    else:
        assert guess.confidence > 0.9
        assert "reaches" not in guess.reason


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 180 / pi])
def test_the_motion_tells_the_unit_of_a_wheel_that_turns_on(tmp_path: Path, factor: float) -> None:
    model = tmp_path / "wheel.xml"
    model.write_text(WHEEL.format(limits=""))
    time = np.arange(0.0, 12.0, 0.004)
    ctrl = (2.0 + tones(time, 3))[:, None]
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    run = Engine(1).rollout(Model.from_file(model).compile(), start, ctrl[None])
    qpos = run.qpos[0, :-1, 0]
    assert np.abs(qpos).max() > 50
    log = {"time": time, "wheel_position": factor * qpos, "wheel_torque": ctrl[:, 0]}
    pd.DataFrame(log).to_csv(tmp_path / "log.csv", index=False)
    started = init(model, [tmp_path / "log.csv"], tmp_path / "wheel.yaml")
    rule = Study.load(started.path).recordings.columns["qpos.wheel"]
    assert (rule.source, rule.unit) == ("wheel_position", None if factor == 1.0 else "deg")


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


def test_names_of_elements_are_no_units_and_the_last_column_is_the_last_control() -> None:
    joints = ("yaw", "shoulder", "elbow", "gripper")
    told = {f"qpos.{j}": (k + 1) * WAVE for k, j in enumerate(joints)}
    ctrl = {"ctrl.ma": WAVE, "ctrl.mb": WAVE, "ctrl.mc": WAVE, "grip": 2 * WAVE}
    rules = guess_rules(Model.from_xml(HAND), RawTable("log", {"time": TIMES, **told, **ctrl}))
    assert rules.columns["ctrl.ma"] == {}
    assert rules.columns["ctrl.md"] == {"from": "grip"}
    assert rules.guesses["ctrl.md"].confidence == pytest.approx(0.3)
    friction = (
        '<general name="stuck" joint="yaw" dyntype="dcmotor" dynprm="0 0 0 0 0 20 .1" input="none" '
        'gaintype="dcmotor" biastype="dcmotor" gainprm="1 1e-6" biasprm="0 0 0 .1 .15 .1" '
        'actdim="1" actearly="true"/></actuator>'
    )
    stuck = Model.from_xml(HAND.replace("</actuator>", friction))
    table = RawTable("log", {"time": TIMES, **told, **ctrl})
    assert guess_rules(stuck, table).columns == rules.columns  # friction waits for no column


def test_a_model_without_hinges_and_slides_is_refused_in_words() -> None:
    body = '<body><joint name="b" type="ball"/><geom size=".1"/></body>'
    ball = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    with pytest.raises(RecordingError, match=r"no hinge or slide.*'qpos.b.0'"):
        guess_rules(Model.from_xml(ball), RawTable("log", {"time": TIMES, "qpos.b.0": WAVE}))


@pytest.mark.parametrize(
    ("name", "unit", "kind", "words"),
    [
        ("Strom_ist [mA]", "mA", "other", ("strom", "ist")),
        ("torque (mNm)", "mNm", "effort", ("torque",)),
        ("tau_Nm", "Nm", "effort", ("tau",)),
        ("motorCurrent_mA", "mA", "effort", ("motor", "current")),
        ("u [V]", "V", "command", ("u",)),
        ("Drehzahl [rpm]", "rpm", "velocity", ("drehzahl",)),
        ("Winkel [°]", "°", "position", ("winkel",)),
        ("shaft(deg/s)", "deg/s", "velocity", ("shaft",)),
        ("joint(1)", "", "position", ("joint", "1")),
        ("motor_A", "", "other", ("motor", "a")),
        ("elbow [MA]", "", "other", ("elbow", "ma")),
    ],
)
def test_units_in_brackets_are_read_before_names_are_split(
    name: str, unit: str, kind: str, words: tuple[str, ...]
) -> None:
    table = RawTable("log", {"time": TIMES, name: WAVE})
    (column,) = (c for c in describe(table) if c.name == name)
    assert (column.unit, column.kind, column.words) == (unit, kind, words)


@pytest.mark.parametrize(
    ("column", "factor"), [("i [mA]", 1e-3), ("tau_mNm", 1e-3), ("i [A]", 1.0)]
)
def test_a_control_is_read_in_the_unit_that_its_column_carries(column: str, factor: float) -> None:
    table = RawTable("log", {"t [ms]": 1e-3 * TIMES, "angle [deg]": 30 * WAVE, column: 50 * WAVE})
    rules = guess_rules(Model.from_xml(WHEEL.format(limits="")), table)
    channels = read(table, rules).channels
    np.testing.assert_allclose(channels["ctrl.wheel"].values, 50 * factor * WAVE)
    np.testing.assert_allclose(channels["qpos.wheel"].values, np.deg2rad(30 * WAVE))
    np.testing.assert_allclose(channels["qpos.wheel"].time, 1e-6 * TIMES)


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
BOOM = """
<mujoco><option timestep="0.004"/><compiler angle="degree"/><worldbody><body name="boom">
  <joint name="boom_joint" axis="0 1 0" range="-30 150" limited="true" damping=".05"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/></body></worldbody>
  <actuator><motor name="boom_drive" joint="boom_joint" gear="50"/></actuator></mujoco>"""


def held_up(path: Path, centre: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time, angle and control of a boom that a controller moves about an angle."""
    path.write_text(BOOM)
    model = Model.from_file(path).compile()
    data, time = mujoco.MjData(model), np.arange(0.0, 12.0, model.opt.timestep)
    wanted, angles, ctrl = centre + 0.6 * tones(time, 2), [], []
    data.qpos[:] = wanted[0]
    for goal in wanted:
        data.ctrl[:] = (20 * (goal - data.qpos[0]) - data.qvel[0]) / 50
        angles.append(float(data.qpos[0]))
        ctrl.append(float(data.ctrl[0]))
        mujoco.mj_step(model, data)
    noise = 1e-4 * np.random.default_rng(1).standard_normal(len(time))
    return time, np.array(angles) + noise, np.array(ctrl)


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


def test_a_current_is_no_goal_of_a_servo() -> None:
    servo = BOOM.replace('<motor name="boom_drive" joint="boom_joint" gear="50"/>',
                         '<position name="boom_drive" joint="boom_joint" kp="20"/>')  # fmt: skip
    table = RawTable("log", {"time": TIMES, "enc_boom_deg": 30 * WAVE, "i_boom_A": WAVE})
    rules = guess_rules(Model.from_xml(servo), table)
    assert (rules.unmatched, rules.unused) == (("boom_drive",), ("i_boom_A",))


def test_a_current_of_which_the_model_explains_nothing_lacks_its_scale(tmp_path: Path) -> None:
    """The current of something else is in it, so that no constant explains the motion."""
    time, angle, ctrl = held_up(tmp_path / "boom.xml")
    bend = np.gradient(np.gradient(angle, time), time)
    torque = 50 * ctrl + 3 * np.convolve(bend, np.ones(25) / 25, mode="same") + 9 * np.cos(9 * time)
    log = pd.DataFrame({"time": time, "enc_boom": angle, "i_boom_A": torque})
    log.to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "boom.xml", [tmp_path / "log.csv"], tmp_path / "boom.yaml")
    guess = started.rules.guesses["ctrl.boom_drive"]
    assert "scale" not in started.rules.columns["ctrl.boom_drive"]
    assert "its scale is missing" in guess.reason
    assert guess.confidence <= 0.5


def test_a_current_is_told_to_need_the_motors_constant(tmp_path: Path) -> None:
    time, angle, ctrl = held_up(tmp_path / "boom.xml")
    log = pd.DataFrame({"time": time, "enc_boom": angle, "i_boom_A": ctrl / 0.08})
    log.to_csv(tmp_path / "log.csv", index=False)
    started = init(tmp_path / "boom.xml", [tmp_path / "log.csv"], tmp_path / "boom.yaml")
    rule = Study.load(started.path).recordings.columns["ctrl.boom_drive"]
    assert (rule.source, rule.unit) == ("i_boom_A", "A")
    assert rule.scale == pytest.approx(0.08, rel=0.02)
    before = started.path.read_text().split("    ctrl.boom_drive:")[0].splitlines()[-1]
    assert before.strip() == (
        "# boom_drive is told in A: scale is the motor's constant in N m/A before the gear; the "
        "model multiplies by its gear of 50"
    )


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


def test_the_clock_is_the_column_that_is_called_time_or_never_falls() -> None:
    time = np.arange(200) * 0.01
    loop = 0.001 + 1e-5 * np.sin(7 * time)
    for name in ("time", "stamp_time"):
        table = RawTable("log", {"loop_time": loop, name: time})
        columns = [replace(c, kind="time") for c in describe(table)]
        assert clock_rule(table, columns)[0].get("from", "time") == name


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
