import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

from bo_sysid.errors import RecordingError
from bo_sysid.recording import Channel, Recording, kind_of, stated_for

TIME = np.array([0.0, 0.1, 0.3, 0.4])
VALUES = np.array([1.0, -2.0, 3.0, 0.5])


def test_a_channel_is_frozen_and_keeps_its_own_copy():
    values = VALUES.copy()
    channel = Channel(TIME, values)
    values[0] = 99.0
    assert channel.values[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        channel.values[0] = 2.0


@pytest.mark.parametrize(
    ("time", "values", "match"),
    [
        (TIME[:1], VALUES[:1], "1 samples; at least 2"),
        (TIME[::-1], VALUES, "must increase; row 1"),
        (np.array([0, 1, 1, 2.0]), VALUES, "must increase; row 2"),
        (TIME, np.array([1, np.nan, 2, 3]), "value in row 1 is nan"),
        (np.array([0, 1, np.inf, 3]), VALUES, "time stamp in row 2 is inf"),
    ],
)
def test_a_channel_is_validated_when_made(time, values, match):
    with pytest.raises(RecordingError, match=f"log.csv: q.*{match}"):
        Channel(time, values, source="log.csv: q")


def test_the_value_held_is_that_of_the_last_stamp():
    at = Channel(TIME, VALUES, hold="zero").at(np.array([-1.0, 0.0, 0.0999, 0.1, 0.35, 9.0]))
    np.testing.assert_array_equal(at, [1.0, 1.0, 1.0, -2.0, 3.0, 0.5])


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("qposs.a", "did you mean 'qpos'"),
        ("qpos", "<kind>.<name>; the name is missing, as in 'qpos.elbow'"),
        ("qpos.left elbow", "no white space: rename the joint in the model .* to 'left_elbow'$"),
        ("ctrl.m 1.3", "rename the actuator in the model .* to 'm_1'$"),
        ("aux.bus voltage", "no white space: write 'bus_voltage'$"),
    ],
)
def test_channel_names_follow_the_convention(name, match):
    with pytest.raises(RecordingError, match=match):
        Recording("r", {name: Channel(TIME, VALUES)})


def test_a_channel_has_what_is_stated_by_its_name_before_that_of_its_kind():
    assert [kind_of(c) for c in ("qpos.root.3", "aux.a.b", "time")] == ["qpos", "aux", "time"]
    stated = {"qpos.elbow": 0.0, "qpos": 2.0, "elbow": 3.0}
    channels = ("qpos.elbow", "qpos.elbow.0", "qpos.wrist", "qvel.elbow")
    assert [stated_for(c, stated, "nothing") for c in channels] == [0.0, 2.0, 2.0, "nothing"]


def test_a_recording_needs_a_channel():
    with pytest.raises(RecordingError, match="at least one channel"):
        Recording("r", {})


def test_parts_and_frames_of_a_sampled_input_keep_what_lies_between():
    time = np.arange(0.0, 1.0, 0.1)
    channels = {
        "qpos.a": Channel(time, np.sin(time)),
        "aux.i": Channel(time[::3], time[::3] ** 2, hold="linear"),
    }
    recording = Recording("r", channels)
    part = recording.between(0.4, 0.8)
    assert part.channels["aux.i"].hold == "linear"
    at = np.array([0.4, 0.5, 0.7])
    np.testing.assert_allclose(part.channels["aux.i"].at(at), channels["aux.i"].at(at))
    np.testing.assert_allclose(recording.to_frame()["aux.i"], channels["aux.i"].at(time))


def test_from_arrays_indexes_coordinates_and_holds_controls():
    recording = Recording.from_arrays(
        TIME,
        qpos={"root": np.arange(28.0).reshape(4, 7), "arm": VALUES},
        ctrl={"arm": VALUES},
        units={"qpos.arm": "rad", "qpos.root": "m"},
    )
    assert recording.channels["qpos.root.6"].values.tolist() == [6, 13, 20, 27]
    assert recording.channels["qpos.root.6"].unit == "m"
    assert recording.channels["qpos.arm"].unit == "rad"
    assert recording.channels["ctrl.arm"].hold == "zero"
    assert list(recording.of_kind("ctrl")) == ["arm"]
    with pytest.raises(RecordingError, match="unknown kind 'qpoz'; did you mean 'qpos'"):
        Recording.from_arrays(TIME, qpoz={"a": VALUES})


@pytest.mark.parametrize("resolution", ["ns", "us", "ms"])
@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
def test_dates_and_durations_are_time_stamps_in_seconds(resolution, zone):
    seconds = 1.7e9 + np.arange(5) * 0.25
    dates = pd.to_datetime(seconds, unit="s").as_unit(resolution)
    local = dates if zone is None else dates.tz_localize("UTC").tz_convert(zone)
    for time, expected in ((local, seconds), (dates - dates[0], seconds - seconds[0])):
        frame = pd.DataFrame({"time": time, "qpos.a": np.arange(5.0)})
        columns = [time, pd.Series(time)] if zone else [time, pd.Series(time), time.to_numpy()]
        recordings = [Recording.from_arrays(t, qpos={"a": np.arange(5.0)}) for t in columns]
        for recording in (Recording.from_frame(frame), *recordings):
            np.testing.assert_allclose(recording.channels["qpos.a"].time, expected, rtol=1e-15)


def test_samples_that_are_no_numbers_are_refused_by_name():
    time = np.arange(2.0)
    with pytest.raises(RecordingError, match=r"arm: qpos.a: samples must be numbers; .*'up'"):
        Recording.from_arrays(time, name="arm", qpos={"a": ["up", "down"]})
    frame = pd.DataFrame({"time": time, "qpos.a": ["up", "down"]})
    with pytest.raises(RecordingError, match=r"arm: qpos.a: samples must be numbers; .*'up'"):
        Recording.from_frame(frame, name="arm")
    with pytest.raises(RecordingError, match=r"qpos.a: samples must be numbers; they are datetime"):
        Recording.from_arrays(time, qpos={"a": pd.to_datetime(time, unit="s").to_numpy()})
    with pytest.raises(RecordingError, match=r"time: samples must be numbers; .*'noon'"):
        Recording.from_arrays(["noon", "night"], qpos={"a": time})


def test_samples_without_a_name_are_refused():
    code = (  # of its own, since types are checked in tests
        "from bo_sysid import Recording\n"
        "from bo_sysid.errors import RecordingError\n"
        "try:\n    Recording.from_arrays([0, 1], qpos=[0, 1])\n"
        "except RecordingError as error:\n    print(error)"
    )
    done = subprocess.run(  # noqa: S603 - our own code
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "qpos is list; it must be a mapping from names to samples" in done.stdout


def test_frames_there_and_back():
    frame = pd.DataFrame({"time": TIME, "qpos.a": VALUES, "ctrl.m": VALUES})
    pd.testing.assert_frame_equal(Recording.from_frame(frame).to_frame(), frame)
    with pytest.raises(RecordingError, match="no column 'time'; did you mean 'timee'"):
        Recording.from_frame(frame.rename(columns={"time": "timee"}))


def test_a_frame_of_several_clocks_goes_there_and_back():
    slow, late = Channel(TIME[::2] + 0.05, VALUES[::2]), Channel(TIME[1:], VALUES[1:], hold="zero")
    made = Recording("r", {"qpos.a": Channel(TIME, VALUES), "qvel.a": slow, "ctrl.m": late})
    back = Recording.from_frame(made.to_frame())
    for name in ("qpos.a", "qvel.a"):
        np.testing.assert_array_equal(back.channels[name].time, made.channels[name].time)
        np.testing.assert_array_equal(back.channels[name].values, made.channels[name].values)
    with pytest.raises(RecordingError, match=r"arm: qpos.a: no row has a number"):
        Recording.from_frame(pd.DataFrame({"time": TIME, "qpos.a": np.nan}), name="arm")


def test_a_frame_of_several_clocks_invents_no_measurement():
    slow = Channel(TIME[::2] + 0.05, VALUES[::2], hold="zero")
    frame = Recording("r", {"qpos.a": Channel(TIME, VALUES), "ctrl.m": slow}).to_frame()
    assert frame["qpos.a"].isna().sum() == 2
    assert frame.loc[frame["time"] == 0.3, "ctrl.m"].item() == 1.0


def test_a_part_keeps_the_control_that_was_held_when_it_began():
    recording = Recording(
        "r",
        {
            "qpos.a": Channel(TIME, VALUES),
            "ctrl.m": Channel(np.array([0.05, 0.35]), np.array([7.0, 8.0]), hold="zero"),
        },
    )
    part = recording.between(0.1, 0.4)
    assert part.channels["qpos.a"].time.tolist() == [0.1, 0.3]
    assert part.channels["ctrl.m"].at(np.array([0.1])).item() == 7.0
    assert part.span == (0.1, 0.3)
    assert part.between(0.1, 0.4).origin == part.origin == recording.origin == 0.0
    assert recording.span == (0.0, 0.4)
    with pytest.raises(RecordingError, match=r"'qpos.a' has fewer than 2 samples"):
        recording.between(0.31, 0.39)


@pytest.mark.parametrize(("start", "stop"), [(0.0, 0.2), (0.15, 0.3), (0.29, 0.5)])
def test_a_command_that_does_not_change_within_a_part_is_still_held(start, stop):
    command = Channel(np.array([0.1, 0.28]), np.array([7.0, 8.0]), hold="zero")
    time = np.arange(60) * 0.01
    recording = Recording("r", {"qpos.a": Channel(time, time), "ctrl.m": command})
    part = recording.between(start, stop)
    inside = part.channels["qpos.a"].time
    np.testing.assert_array_equal(part.channels["ctrl.m"].at(inside), command.at(inside))


def test_notes_are_added_to_a_copy():
    recording = Recording("r", {"qpos.a": Channel(TIME, VALUES)}, ("One.",))
    assert recording.with_notes(["Two."]).notes == ("One.", "Two.")
    assert recording.notes == ("One.",)
