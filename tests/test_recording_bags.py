"""MCAP, ROS bags, LeRobot and HDF5, written by the field's own libraries."""

import contextlib
import json
import sqlite3
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bo_sysid.errors import RecordingError
from bo_sysid.recording import read_recording, read_recordings, read_table, read_tables
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_train

START = 1_700_000_000 * 10**9
SEP = "\n" + "=" * 80 + "\n"
TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
HEADER = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
JOINTS = SEP.join(
    [
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort",
        HEADER,
        TIME,
    ]
)
ARRAY = SEP.join(
    [
        "std_msgs/MultiArrayLayout layout\nfloat64[] data",
        "MSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
        "MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride",
    ]
)
DURATION = "MSG: builtin_interfaces/Duration\nint32 sec\nuint32 nanosec"
POINT = (
    "MSG: trajectory_msgs/JointTrajectoryPoint\nfloat64[] positions\nfloat64[] velocities\n"
    "float64[] accelerations\nfloat64[] effort\nbuiltin_interfaces/Duration time_from_start"
)
TRAJECTORY = SEP.join(
    [
        "std_msgs/Header header\nstring[] joint_names\n"
        "trajectory_msgs/JointTrajectoryPoint[] points",
        HEADER, TIME, POINT, DURATION,
    ]
)  # fmt: skip
STATE = SEP.join(
    [
        "std_msgs/Header header\nstring[] joint_names\n"
        "trajectory_msgs/JointTrajectoryPoint reference\n"
        "trajectory_msgs/JointTrajectoryPoint feedback",
        HEADER, TIME, POINT, DURATION,
    ]
)  # fmt: skip


def stamp(ns: int) -> dict[str, int]:
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def header(ns: int) -> dict[str, Any]:
    return {"stamp": stamp(ns), "frame_id": ""}


def point(*positions: float, after: int = 0) -> dict[str, Any]:
    return {
        "positions": list(positions), "velocities": [], "accelerations": [], "effort": [],
        "time_from_start": stamp(after),
    }  # fmt: skip


def joints(k: int, *names: str, ns: int | None = None) -> dict[str, Any]:
    return {
        "header": header(START + k * 10**7 if ns is None else ns),
        "name": list(names),
        "position": [0.1 * k + i for i in range(len(names))],
        "velocity": [10.0] * len(names),
        "effort": [],
    }


def mcap(path: Path, messages: list[tuple[str, str, str, dict[str, Any], int]]) -> Path:
    """Write (topic, type, definition, message, receive time) to an MCAP file."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        schemas = {kind: writer.register_msgdef(kind, text) for _, kind, text, _, _ in messages}
        for topic, kind, _, message, received in messages:
            writer.write_message(topic, schemas[kind], message, received, received)
        writer.finish()
    return path


def typical(path: Path) -> Path:
    """Write joint states with headers, and commands that are known by their receipt alone."""
    messages: list[tuple[str, str, str, dict[str, Any], int]] = []
    for k in range(20):
        received = START + k * 10**7 + 3_000_000
        messages.append(
            ("/joint_states", "sensor_msgs/msg/JointState", JOINTS,
             joints(k, "elbow", "wrist"), received)
        )  # fmt: skip
        layout = {"dim": [], "data_offset": 0}
        messages.append(
            ("/effort", "std_msgs/msg/Float64MultiArray", ARRAY,
             {"layout": layout, "data": [1.0 * k, -1.0 * k]}, received + 1_000_000)
        )  # fmt: skip
    return mcap(path, messages)


def test_an_mcap_file_keeps_a_clock_for_every_topic(tmp_path: Path) -> None:
    table = read_table(typical(tmp_path / "log.mcap"))
    k = np.arange(20)
    assert table.columns["/joint_states.position.wrist"] == pytest.approx(0.1 * k + 1)
    assert "/joint_states.effort.elbow" not in table.columns
    assert table.clocks["/joint_states.position.wrist"] == "/joint_states.time"
    assert table.columns["/joint_states.time"] == pytest.approx(0.01 * k - 0.003)
    assert table.columns["/joint_states.received"] == pytest.approx(0.01 * k)
    assert table.columns["/effort.time"] == pytest.approx(0.01 * k + 0.001)
    assert table.columns["/effort.data.1"] == pytest.approx(-1.0 * k)
    assert any("/effort: no header" in n for n in table.notes)


def test_a_bag_becomes_a_recording_by_column_rules(tmp_path: Path) -> None:
    columns = {
        "qpos.elbow": "/joint_states.position.elbow",
        "ctrl.elbow": {"from": "/effort.data.0", "unit": "mN m"},
    }
    recording = read_recording(typical(tmp_path / "log.mcap"), columns)
    assert recording.channels["ctrl.elbow"].values[3] == pytest.approx(0.003)
    assert recording.channels["ctrl.elbow"].time[0] - recording.channels["qpos.elbow"].time[
        0
    ] == pytest.approx(0.004)
    with pytest.raises(RecordingError, match=r"no column '/joint_state.position.elbow'.*did you"):
        read_recording(tmp_path / "log.mcap", {"qpos.elbow": "/joint_state.position.elbow"})


def test_trajectories_and_controller_states(tmp_path: Path) -> None:
    trajectory = {
        "header": header(START),
        "joint_names": ["elbow"],
        "points": [point(0.5, after=0), point(0.9, after=250_000_000)],
    }
    state = {
        "header": header(START), "joint_names": ["elbow", "wrist"],
        "reference": point(0.1, 0.2), "feedback": point(0.3, 0.4),
    }  # fmt: skip
    path = mcap(
        tmp_path / "log.mcap",
        [
            ("/go", "trajectory_msgs/msg/JointTrajectory", TRAJECTORY, trajectory, START),
            ("/c", "control_msgs/msg/JointTrajectoryControllerState", STATE, state, START),
        ],
    )
    columns = read_table(path).columns
    assert columns["/go.positions.elbow"].tolist() == [0.5, 0.9]
    assert np.diff(columns["/go.time"]) == pytest.approx(0.25)
    assert columns["/c.reference.positions.wrist"].tolist() == [0.2]
    assert columns["/c.feedback.positions.elbow"].tolist() == [0.3]


def goals(path: Path, plans: list[tuple[float, list[tuple[float, float]]]]) -> Any:
    """Return the table of trajectories: each its start in [s], and time and goal of its points."""
    messages = []
    for start, points in plans:
        ns = START + round(1e9 * start)
        told = [point(goal, after=round(1e9 * after)) for after, goal in points]
        message = {"header": header(ns), "joint_names": ["elbow"], "points": told}
        messages.append(("/go", "trajectory_msgs/msg/JointTrajectory", TRAJECTORY, message, ns))
    return read_table(mcap(path, messages))


def test_a_trajectory_replaces_what_was_to_come_of_the_one_before(tmp_path: Path) -> None:
    """The goal follows the first plan up to 0.25 s and from there the second one alone."""
    first = [(0.1 * k, 1.0 + k) for k in range(6)]
    second = [(0.0, 10.0), (0.1, 11.0), (0.2, 12.0)]
    table = goals(tmp_path / "log.mcap", [(0.0, first), (0.25, second)])
    assert table.columns["/go.time"] == pytest.approx([0.0, 0.1, 0.2, 0.25, 0.35, 0.45])
    assert table.columns["/go.positions.elbow"].tolist() == [1.0, 2.0, 3.0, 10.0, 11.0, 12.0]
    assert "/go: 3 points of trajectories left out, which a later trajectory replaced." in (
        table.notes
    )
    # of two goals at one time the new one counts; a start before the new goals ends the old plan
    table = goals(tmp_path / "log.mcap", [(0.0, first), (0.2, [(0.0, 7.0)]), (0.3, [(0.5, 8.0)])])
    assert table.columns["/go.time"] == pytest.approx([0.0, 0.1, 0.2, 0.8])
    assert table.columns["/go.positions.elbow"].tolist() == [1.0, 2.0, 7.0, 8.0]
    table = goals(tmp_path / "log.mcap", [(0.0, first), (0.25, [(0.5, 8.0)])])
    assert table.columns["/go.positions.elbow"].tolist() == [1.0, 2.0, 3.0, 8.0]


@pytest.mark.parametrize("more", [[], [(0.1, -1.0), (0.2, -2.0)]])
def test_goals_that_are_streamed_ahead_are_kept(
    tmp_path: Path, more: list[tuple[float, float]]
) -> None:
    """A goal every 10 ms for 50 ms later; what a planner adds beyond it is replaced each time."""
    plans = [(0.01 * k, [(0.05, 1.0 * k), *more]) for k in range(20)]
    table = goals(tmp_path / "log.mcap", plans)
    assert table.columns["/go.time"][:20] == pytest.approx(0.05 + 0.01 * np.arange(20))
    assert table.columns["/go.positions.elbow"].tolist() == [
        *np.arange(20.0),
        *(g for _, g in more),
    ]
    assert any("left out" in n for n in table.notes) == bool(more)


def bag(path: Path, received: list[int], name: str = "/joint_states") -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = store.types["sensor_msgs/msg/JointState"]
    head, time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    with BagWriter(path, version=9) as writer:
        connection = writer.add_connection(name, kind.__msgtype__, typestore=store)
        for k, ns in enumerate(received):
            message = kind(
                head(time(ns // 10**9, ns % 10**9), ""), ["elbow"], np.array([0.1 * k]),
                np.array([]), np.array([]),
            )  # fmt: skip
            writer.write(connection, ns, store.serialize_cdr(message, kind.__msgtype__))
    return path


def test_a_ros_2_bag_is_read_as_a_folder_or_by_its_file(tmp_path: Path) -> None:
    folder = bag(tmp_path / "run", [START + k * 10**7 for k in range(10)])
    (table,) = read_tables(folder)
    assert table.columns["/joint_states.position.elbow"] == pytest.approx(0.1 * np.arange(10))
    assert np.diff(table.columns["/joint_states.time"]) == pytest.approx(0.01)
    (inner,) = folder.glob("*.db3")
    again = read_table(inner).columns
    assert again["/joint_states.time"] == pytest.approx(table.columns["/joint_states.time"])
    (folder / "metadata.yaml").unlink()
    with pytest.raises(RecordingError, match=r"without its metadata.yaml.*reindex"):
        read_table(inner)


def test_a_part_of_a_split_bag_is_not_the_whole(tmp_path: Path) -> None:
    folder = bag(tmp_path / "run", [START + k * 10**7 for k in range(10)])
    (inner,) = folder.glob("*.db3")
    (inner.parent / "run_1.db3").write_bytes(inner.read_bytes())
    metadata = folder / "metadata.yaml"
    text = metadata.read_text()
    about = yaml.safe_load(text)
    about["rosbag2_bagfile_information"]["relative_file_paths"].append("run_1.db3")
    metadata.write_text(yaml.safe_dump(about))
    told = r"one part of 2 of a ROS 2 bag.*name the folder, .*run"
    for part in (inner.name, "run_1.db3"):
        with pytest.raises(RecordingError, match=f"{part}: {told}"):
            read_table(folder / part)
    assert len(read_tables(folder)[0].columns["/joint_states.time"]) == 20
    for damaged in ("", "{", text.replace("relative_file_paths", "paths")):
        metadata.write_text(damaged)
        with pytest.raises(RecordingError, match="damaged or truncated bag"):
            read_table(inner)


def test_a_study_names_the_folder_of_a_bag(tmp_path: Path) -> None:
    bag(tmp_path / "run", [START + k * 10**7 for k in range(40)])
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    study = Study.from_dict(
        {
            "model": "arm.xml",
            "recordings": {
                "train": "ru*",
                "holdout": "ru[n]x*",
                "columns": {"qpos.elbow": "/joint_states.position.elbow"},
            },
        },
        tmp_path,
    )
    (recording,) = load_train(study)
    assert recording.name == "run"
    assert recording.channels["qpos.elbow"].values.size == 40


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_truncated_bag_is_named(tmp_path: Path, share: float) -> None:
    path = typical(tmp_path / "log.mcap")
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError, match=r"log.mcap: a damaged or truncated bag.*recover"):
        read_table(path)


def test_a_file_that_is_no_bag(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_text("time,qpos.x\n0,1\n")
    with pytest.raises(RecordingError, match="not an MCAP file"):
        read_table(tmp_path / "log.mcap")


def test_a_bag_of_other_messages_says_what_it_has_and_what_is_read(tmp_path: Path) -> None:
    path = mcap(
        tmp_path / "log.mcap",
        [("/chat", "std_msgs/msg/String", "string data", {"data": "hello"}, START)],
    )
    with pytest.raises(RecordingError, match=r"/chat \(std_msgs/msg/String\).*Read are.*JointS"):
        read_table(path)


def test_a_message_whose_definition_is_missing_is_not_read(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 torque", "control_msgs/msg/Odd"))
    kind = store.types["control_msgs/msg/Odd"]
    with BagWriter(tmp_path / "run", version=8) as writer:
        odd = writer.add_connection("/odd", kind.__msgtype__, typestore=store)
        for k in range(3):
            writer.write(odd, START + k, store.serialize_cdr(kind(1.0), kind.__msgtype__))
    (file,) = (tmp_path / "run").glob("*.db3")
    with contextlib.closing(sqlite3.connect(file)) as data:  # as older recorders leave it
        data.execute("DELETE FROM message_definitions")
        data.commit()
    with pytest.raises(RecordingError, match=r"/odd \(control_msgs/msg/Odd"):
        read_tables(tmp_path / "run")


def test_a_topic_without_time_stamps(tmp_path: Path) -> None:
    layout = {"dim": [], "data_offset": 0}
    message = {"layout": layout, "data": [1.0]}
    path = mcap(
        tmp_path / "log.mcap",
        [("/u", "std_msgs/msg/Float64MultiArray", ARRAY, message, 0) for _ in range(3)],
    )
    with pytest.raises(RecordingError, match=r"topic /u has no time stamps.*receive times"):
        read_table(path)


def test_two_robots_keep_apart(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/JointState"
    messages = []
    for k in range(5):
        for robot in ("/a", "/b"):
            name = f"{robot}/joint_states"
            messages.append((name, kind, JOINTS, joints(k, "elbow"), START + k * 10**7))
    columns = read_table(mcap(tmp_path / "log.mcap", messages)).columns
    assert "/a/joint_states.position.elbow" in columns
    assert "/b/joint_states.position.elbow" in columns
    # on one topic, messages of different joints have clocks of their own; a shared name is refused
    messages = []
    for k in range(6):
        names = ("elbow", "wrist") if k % 2 else ("gripper",)
        messages.append(("/js", kind, JOINTS, joints(k, *names), START + k * 10**7))
    table = read_table(mcap(tmp_path / "log.mcap", messages))
    assert table.clocks["/js.position.gripper"] != table.clocks["/js.position.wrist"]
    messages.append(("/js", kind, JOINTS, joints(9, "elbow"), START + 25 * 10**6))
    with pytest.raises(RecordingError, match=r"two publishers on /js name 'elbow'.*namespaces"):
        read_table(mcap(tmp_path / "log.mcap", messages))


def test_a_publisher_whose_messages_grow_is_one(tmp_path):
    kind, messages = "sensor_msgs/msg/JointState", []
    for k in range(6):
        names = ("elbow",) if k < 2 else ("elbow", "wrist")
        messages.append(("/js", kind, JOINTS, joints(k, *names), START + k * 10**7))
    columns = read_table(mcap(tmp_path / "log.mcap", messages)).columns
    assert len(columns["/js.position.elbow"]) == len(columns["/js.position.wrist"]) == 6
    np.testing.assert_array_equal(np.isnan(columns["/js.position.wrist"]), np.arange(6) < 2)
    assert not np.isnan(columns["/js.position.elbow"]).any()


def test_headers_of_another_clock_are_told(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/JointState"
    messages = [
        ("/js", kind, JOINTS, joints(k, "elbow", ns=10**9 + k * 10**7), START + k * 10**7)
        for k in range(4)
    ]
    table = read_table(mcap(tmp_path / "log.mcap", messages))
    assert table.columns["/js.time"] == pytest.approx(0.01 * np.arange(4))
    assert any("another clock" in n for n in table.notes)


def test_topics_on_another_clock_keep_their_distance(tmp_path: Path) -> None:
    """As from a simulator: headers in its time, receipts in that of the wall, at half its speed."""
    kind = "sensor_msgs/msg/JointState"
    messages = []
    for first, topic in ((10, "/js"), (12, "/goals")):
        for k in range(100):
            ns = first * 10**9 + k * 10**7
            messages.append((topic, kind, JOINTS, joints(k, "elbow", ns=ns), START + 2 * ns))
    hand = 50_000 * 10**9  # its controller counts from when it was switched on
    for k in range(100):
        ns = hand + k * 10**7
        messages.append(("/hand", kind, JOINTS, joints(k, "grip", ns=ns), START + 24 * 10**9 + k))
    table = read_table(mcap(tmp_path / "log.mcap", messages))
    assert table.columns["/js.time"] == pytest.approx(0.01 * np.arange(100))
    assert table.columns["/goals.time"] == pytest.approx(2.0 + 0.01 * np.arange(100))
    assert table.columns["/hand.time"] == pytest.approx(0.01 * np.arange(100))
    notes = " ".join(table.notes)
    assert "another clock, that of /goals; to use those of receipt" in notes
    assert "another clock, that of /js; to use those of receipt" in notes
    assert "another clock; to use those of receipt, name the column /hand.received" in notes


def lerobot(path: Path, episodes: int = 2) -> Path:
    """Write a LeRobot dataset: all episodes in one file, vectors in cells."""
    (path / "meta").mkdir(parents=True)
    (path / "data" / "chunk-000").mkdir(parents=True)
    names = ["elbow.pos", "wrist.pos"]
    features = {
        "observation.state": {"dtype": "float32", "shape": [2], "names": names},
        "action": {"dtype": "float32", "shape": [2], "names": {"motors": names}},
        "observation.images.top": {"dtype": "video", "shape": [3, 2, 2]},
        "timestamp": {"dtype": "float32", "shape": [1]},
        "episode_index": {"dtype": "int64", "shape": [1]},
    }
    (path / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": features}))
    k = np.arange(30)
    state = [[0.1 * i, 1.0 * e] for e in range(episodes) for i in k]
    table = pa.table(
        {
            "observation.state": pa.array(state, pa.list_(pa.float32())),
            "action": pa.array(state, pa.list_(pa.float32(), 2)),
            "timestamp": np.tile(0.02 * k, episodes).astype(np.float32),
            "episode_index": np.repeat(np.arange(episodes), len(k)),
        }
    )
    pq.write_table(table, path / "data" / "chunk-000" / "file-000.parquet")
    return path


def test_a_lerobot_dataset_gives_one_recording_an_episode(tmp_path: Path) -> None:
    rules = {
        "qpos.elbow": {"from": "observation.state.elbow.pos", "unit": "deg"},
        "ctrl.elbow": "action.elbow.pos",
    }
    first, second = read_recordings(lerobot(tmp_path / "pick"), rules)
    assert (first.name, second.name) == ("pick-episode-0", "pick-episode-1")
    assert first.channels["qpos.elbow"].values == pytest.approx(
        np.deg2rad(0.1 * np.arange(30)), rel=1e-6
    )
    assert second.channels["ctrl.elbow"].time[1] == pytest.approx(0.02)
    assert read_tables(tmp_path / "pick")[1].columns["action.wrist.pos"][0] == 1.0
    with pytest.raises(RecordingError, match="2 recordings"):
        read_recording(tmp_path / "pick", rules)


def test_a_folder_that_is_no_log(tmp_path: Path) -> None:
    (tmp_path / "x.txt").write_text("")
    with pytest.raises(RecordingError, match=r"a folder with x.txt; folders that are logs hold me"):
        read_tables(tmp_path)


def test_hdf5_groups_matrices_and_units(tmp_path: Path) -> None:
    t = np.linspace(0, 1, 40)
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["time"] = t
        file["qpos/elbow"] = np.rad2deg(t)
        file["qpos/elbow"].attrs["unit"] = "deg"
        file["robot/torque"] = np.stack([t, 2 * t], axis=1)
        file["about"] = "text"
    recording = read_recording(tmp_path / "log.h5", {"ctrl.elbow": "robot.torque.1"})
    assert recording.channels["qpos.elbow"].values == pytest.approx(t)
    assert recording.channels["ctrl.elbow"].values == pytest.approx(2 * t)
    (tmp_path / "log.h5").write_bytes((tmp_path / "log.h5").read_bytes()[:300])
    with pytest.raises(RecordingError, match="cannot be read as an HDF5 file"):
        read_table(tmp_path / "log.h5")


def test_a_missing_package_names_its_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    path = typical(tmp_path / "log.mcap")
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(RecordingError, match=r"pip install 'bo-sysid\[ros\]'"):
        read_table(path)
