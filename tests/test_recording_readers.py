"""One conformance suite over every registered reader, then what each must refuse."""

import gzip
import json
import subprocess
import sys
from datetime import UTC, datetime

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

from bo_sysid.errors import RecordingError
from bo_sysid.recording import (
    READERS,
    read_recording,
    read_table,
    read_tables,
    write_recording,
)
from bo_sysid.recording.value import Recording

RNG = np.random.default_rng(0)
COLUMNS = {
    "time": np.cumsum(RNG.uniform(0.0099, 0.0101, 40)),
    "qpos.a": RNG.normal(size=40) * 1e-7,
    "qpos.b": RNG.normal(size=40) * 1e7,
    "ctrl.m": np.round(RNG.normal(size=40), 2),
}


def save_csv(path, separator=","):
    pd.DataFrame(COLUMNS).to_csv(path, index=False, sep=separator)


def save_hdf5(path):
    with h5py.File(path, "w") as file:
        for name, values in COLUMNS.items():
            file[name.replace(".", "/")] = values


def save_json(path):
    rows = pd.DataFrame(COLUMNS).to_dict("records")
    path.write_text(json.dumps({"rate": 100, "entries": rows}))


def save_parquet(path):
    pd.DataFrame(COLUMNS).to_parquet(path)


SAVE = {  # by ending: a writer of the format's own library
    ".csv": save_csv,
    ".csv.gz": save_csv,
    ".txt": lambda path: np.savetxt(
        path, np.stack(list(COLUMNS.values()), axis=1), header=" ".join(COLUMNS), fmt="%.17g"
    ),
    ".tsv": lambda path: save_csv(path, "\t"),
    ".parquet": save_parquet,
    ".pq": save_parquet,
    ".h5": save_hdf5,
    ".hdf5": save_hdf5,
    ".json": save_json,
    ".npz": lambda path: np.savez(path, **COLUMNS),
    ".mat": lambda path: scipy.io.savemat(
        path,
        {
            "time": COLUMNS["time"],
            "qpos": {"a": COLUMNS["qpos.a"], "b": COLUMNS["qpos.b"]},
            "ctrl": {"m": COLUMNS["ctrl.m"]},
        },
    ),
}


BAGS = {".mcap", ".db3", ".bag"}
"""Endings of files with messages, which tests/test_recording_bags.py writes."""


def test_every_format_has_an_example():
    assert set(READERS) == set(SAVE) | BAGS


@pytest.mark.parametrize("ending", SAVE)
def test_every_reader_returns_the_very_numbers_of_the_formats_own_library(ending, tmp_path):
    path = tmp_path / f"arm-3{ending}"
    SAVE[ending](path)
    recording = read_recording(path, strict=True)
    assert recording.name == "arm-3"
    assert set(recording.channels) == {"qpos.a", "qpos.b", "ctrl.m"}
    for name, channel in recording.channels.items():
        np.testing.assert_array_equal(channel.time, COLUMNS["time"])
        np.testing.assert_array_equal(channel.values, COLUMNS[name])
        assert str(path) in channel.source


@pytest.mark.parametrize("ending", SAVE)
def test_every_reader_applies_rules(ending, tmp_path):
    path = tmp_path / f"log{ending}"
    SAVE[ending](path)
    rules = {"qpos.elbow": {"from": "qpos.a", "unit": "deg", "sign": -1}}
    recording = read_recording(path, rules, {"qpos": {"from": "time"}})
    np.testing.assert_allclose(
        recording.channels["qpos.elbow"].values, -np.pi / 180 * COLUMNS["qpos.a"], rtol=1e-14
    )


@pytest.mark.parametrize("ending", READERS)
def test_every_reader_refuses_an_empty_file(ending, tmp_path):
    path = tmp_path / f"log{ending}"
    path.touch()
    with pytest.raises(RecordingError, match=r"log.*: the file is empty"):
        read_recording(path)


LIES = [
    (ending, content)
    for ending in READERS
    for content in ("noise", "text", "gzip", "parquet", "npz", "mat", "half")
    if content not in (ending[1:], "parquet" if ending == ".pq" else "")
    and not (content == "half" and ending in (".csv", ".tsv", ".txt"))  # half a text is a text
    and not (content == "half" and ending in BAGS)
]


@pytest.mark.parametrize(("ending", "content"), LIES)
def test_every_reader_refuses_what_its_ending_does_not_say(ending, content, tmp_path):
    path, other = tmp_path / f"log{ending}", tmp_path / f"other.{content}"
    if content == "noise":
        other.write_bytes(bytes(np.random.default_rng(1).integers(0, 256, 5000, dtype=np.uint8)))
    elif content == "text":
        other.write_text("once upon a time\nthere was a robot that logged prose\n")
    elif content == "gzip":
        other.write_bytes(gzip.compress(b"PAR1 once upon a time"))
    elif content == "half":
        SAVE[ending](path)
        other.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        SAVE[f".{content}"](other)
    path.write_bytes(other.read_bytes())
    with pytest.raises(RecordingError, match="log"):
        read_recording(path)


def test_an_unknown_ending_names_the_nearest(tmp_path):
    path = tmp_path / "log.parket"
    path.touch()
    with pytest.raises(RecordingError, match=r"end in '.parket'; did you mean '.parquet'"):
        read_recording(path)


def test_a_missing_file_names_the_nearest(tmp_path):
    (tmp_path / "swing-1.csv").touch()
    with pytest.raises(RecordingError, match=r"no such file; did you mean 'swing-1.csv'"):
        read_recording(tmp_path / "swng-1.csv")
    with pytest.raises(RecordingError, match=r"no such file; did you mean 'swing-1.csv'"):
        read_recording(tmp_path / "swing-1.cvs")


def test_a_pattern_without_a_match_says_what_there_is(tmp_path):
    logs = tmp_path / "logs"
    with pytest.raises(RecordingError, match=rf"no such file; there is no folder {logs}$"):
        read_recording(logs / "*.csv")
    logs.mkdir()
    with pytest.raises(RecordingError, match=rf"no such file; the folder {logs} is empty$"):
        read_recording(logs / "*.csv")
    (logs / "monday.parquet").touch()
    with pytest.raises(RecordingError, match=r"no such file; valid: 'monday.parquet'$"):
        read_recording(logs / "*.csv")


def test_a_folder_is_no_file(tmp_path):
    (tmp_path / "log.csv").mkdir()
    with pytest.raises(RecordingError, match="a folder with nothing; folders that are logs"):
        read_recording(tmp_path / "log.csv")


def test_matlab_7_3_says_what_to_do(tmp_path):
    path = tmp_path / "log.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n")
    with pytest.raises(RecordingError, match=r"MATLAB 7.3.*'-v7'"):
        read_recording(path)


def test_python_objects_are_not_unpickled(tmp_path):
    path = tmp_path / "log.npz"
    np.savez(path, time=np.arange(3.0), **{"qpos.a": np.array([1, None, 2], dtype=object)})
    with pytest.raises(RecordingError, match="no Python objects"):
        read_recording(path)


def test_matrices_become_channels_with_an_index(tmp_path):
    states = np.random.default_rng(2).normal(size=(30, 7))
    np.savez(
        tmp_path / "log.npz",
        time=np.arange(30) * 0.01,
        **{"qpos.root": states, "wide": states.T, "image": np.zeros((30, 4, 4))},
    )
    rules = {"sensor.s": {"from": "wide.2"}}
    recording = read_recording(tmp_path / "log.npz", rules)
    np.testing.assert_array_equal(recording.channels["qpos.root.6"].values, states[:, 6])
    np.testing.assert_array_equal(recording.channels["sensor.s"].values, states[:, 2])
    assert "Array 'image' has 3 dimensions and was not read." in recording.notes


@pytest.mark.parametrize("ending", [".parquet", ".csv"])
@pytest.mark.parametrize("zone", [None, "UTC"])
def test_time_stamps_of_a_date_become_seconds(ending, zone, tmp_path):
    seconds = 1.7e9 + np.arange(20) * 0.25
    dates = pd.to_datetime(seconds, unit="s").tz_localize(zone)
    path = tmp_path / f"log{ending}"
    frame = pd.DataFrame({"time": dates, "qpos.a": np.arange(20.0)})
    frame.to_parquet(path) if ending == ".parquet" else frame.to_csv(path, index=False)
    recording = read_recording(path)
    np.testing.assert_allclose(recording.channels["qpos.a"].time, seconds, atol=1e-6)
    assert "Dates in column 'time' converted to seconds since 1970." in recording.notes
    with pytest.raises(RecordingError, match=r"'time' are dates.* in s; unit is 'ms', leave it"):
        read_recording(path, {"time": {"unit": "ms"}})


def test_times_of_day_are_durations_and_go_on_past_midnight(tmp_path):
    seconds = 86_399.0 + 0.02 * np.arange(200)
    stamps = pd.to_datetime(seconds, unit="s").round("ms").strftime("%H:%M:%S.%f")
    lines = (f"{t},{k}" for k, t in enumerate(stamps))
    (tmp_path / "log.csv").write_text("time,qpos.a\n" + "\n".join(lines))
    recording = read_recording(tmp_path / "log.csv")
    np.testing.assert_allclose(recording.channels["qpos.a"].time, seconds, atol=1e-6)


@pytest.mark.parametrize("resolution", ["ns", "us", "ms"])
def test_durations_become_seconds(resolution, tmp_path):
    seconds = 3.0 + np.arange(20) * 0.25
    spans = pd.Series((1e9 * seconds).astype("timedelta64[ns]")).astype(
        f"timedelta64[{resolution}]"
    )
    delays = spans.where(np.arange(20) % 4 != 1)
    frame = pd.DataFrame({"time": spans, "qpos.a": np.arange(20.0), "aux.delay": delays})
    frame.to_parquet(tmp_path / "log.parquet")
    rules = {"aux.delay": {"missing": "skip"}}
    recording = read_recording(tmp_path / "log.parquet", rules)
    np.testing.assert_allclose(recording.channels["qpos.a"].time, seconds, atol=1e-9)
    delay = recording.channels["aux.delay"]
    np.testing.assert_allclose(delay.values, seconds[np.arange(20) % 4 != 1], atol=1e-9)
    np.testing.assert_allclose(delay.time, delay.values, atol=1e-9)
    assert "Durations in column 'time' converted to seconds." in recording.notes
    rules["time"] = {"unit": "ns"}
    with pytest.raises(RecordingError, match=r"'time' are durations.* in s; unit is 'ns'"):
        read_recording(tmp_path / "log.parquet", rules)


def test_lists_of_several_lengths_are_left_out_of_parquet(tmp_path):
    states = [np.array([0.1 * k, 2.0]) if k != 3 else None for k in range(20)]
    frame = pd.DataFrame(COLUMNS).head(20)
    frame["hits"] = [list(range(k % 3)) for k in range(20)]
    frame["state"] = states
    frame.to_parquet(tmp_path / "log.parquet")
    rules = {"aux.s": {"from": "state.0", "missing": "skip"}}
    recording = read_recording(tmp_path / "log.parquet", rules)
    assert "Column 'hits' left out: its lists have 0 to 2 numbers." in recording.notes
    expected = [0.1 * k for k in range(20) if k != 3]
    np.testing.assert_allclose(recording.channels["aux.s"].values, expected)


@pytest.mark.parametrize("listed", [pa.list_, pa.large_list])
def test_vectors_in_parquet_become_columns_with_an_index(tmp_path, listed):
    state = RNG.normal(size=(40, 2))
    columns = {"time": COLUMNS["time"], "state": pa.array(list(state), listed(pa.float64()))}
    pq.write_table(pa.table(columns), tmp_path / "log.parquet")
    rules = {f"qpos.{n}": {"from": f"state.{i}"} for i, n in enumerate("ab")}
    channels = read_recording(tmp_path / "log.parquet", rules).channels
    np.testing.assert_array_equal(channels["qpos.b"].values, state[:, 1])


def test_columns_of_one_name_are_refused_in_parquet(tmp_path):
    columns = [pa.array(v) for v in COLUMNS.values()]
    names = ["time", "qpos.a", "qpos.a", "ctrl.m"]
    pq.write_table(pa.Table.from_arrays(columns, names), tmp_path / "log.parquet")
    with pytest.raises(RecordingError, match=r"several columns are named 'qpos.a'; each needs"):
        read_recording(tmp_path / "log.parquet")


@pytest.mark.parametrize("wrong", ["null", "3.5"])
def test_an_entry_that_is_no_record_names_its_row(wrong, tmp_path):
    rows = [f'{{"time": {k}, "qpos.a": {k}}}' for k in range(5)]
    for text in ('{{"entries": [{}]}}', "[{}]"):
        for k in (0, 3) if wrong == "null" else (3,):
            entries = [*rows[:k], wrong, *rows[k:]]
            (tmp_path / "log.json").write_text(text.format(", ".join(entries)))
            with pytest.raises(RecordingError, match=rf"row {k}: {wrong} is no record"):
                read_recording(tmp_path / "log.json")


def test_dates_beyond_the_nanoseconds_of_64_bits_do_no_harm(tmp_path):
    never = pa.array([datetime(9999, 1, 1)] * 3, pa.timestamp("us"))
    table = {"time": [0.0, 0.1, 0.2], "qpos.a": [1.0, 2.0, 3.0], "aux.expires": never}
    pq.write_table(pa.table(table), tmp_path / "log.parquet")
    expires = read_recording(tmp_path / "log.parquet").channels["aux.expires"]
    assert expires.values[0] == (datetime(9999, 1, 1) - datetime(1970, 1, 1)).total_seconds()


def test_a_date_that_is_missing_names_its_row(tmp_path):
    dates = pd.to_datetime([0.0, None, 2.0], unit="s")
    pd.DataFrame({"time": dates, "qpos.a": [1.0, 2, 3]}).to_parquet(tmp_path / "log.parquet")
    with pytest.raises(RecordingError, match=r"column 'time': row 1 is empty"):
        read_recording(tmp_path / "log.parquet")


def test_a_column_that_turns_from_whole_to_broken_numbers_late_is_read(tmp_path):
    values = np.zeros(200_000)
    values[-1] = 0.5
    lines = (f"{k / 1000},{int(v) if v == 0 else v},{k}" for k, v in enumerate(values))
    path = tmp_path / "log.csv"
    path.write_text("time,ctrl.m,qpos.a\n" + "\n".join(lines))
    np.testing.assert_array_equal(read_recording(path).channels["ctrl.m"].values, values)


GOOD = "time,qpos.a,ctrl.m\n0.0,1.0,1\n0.1,2.0,2\n0.2,4.0,3\n"


@pytest.mark.parametrize(
    "text",
    [
        GOOD.replace(",", ";"),
        GOOD.replace(",", "\t"),
        GOOD.replace(",", "   "),
        GOOD.replace(",", ", "),
        GOOD.replace("\n", "\r\n"),
        GOOD.replace("\n", "\r"),
        GOOD.rstrip(),
        GOOD + "\n\n",
        "\ufeff" + GOOD,
        "\n" + GOOD,
        "# " + GOOD,
        "# logged by hand\n# twice, yes\n" + GOOD,
        GOOD.replace("\n", ",\n"),
        GOOD.replace("\n", ",\n").replace("ctrl.m,", "ctrl.m", 1),
        GOOD.replace("time", '"time"'),
        "sep=;\n" + GOOD.replace(",", ";"),
        '"sep=,"\r\n' + GOOD,
        GOOD.replace(",", "\t").encode("utf-16"),
        b"\xfe\xff" + GOOD.encode("utf-16-be"),
    ],
    ids=range(19),
)
def test_the_ways_to_write_a_csv_file(text, tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    channels = read_recording(path).channels
    assert channels["qpos.a"].values.tolist() == [1, 2, 4]
    assert channels["ctrl.m"].time.tolist() == [0, 0.1, 0.2]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_between_other_separators_are_read_and_said(separator, tmp_path):
    path = tmp_path / "log.csv"
    rows = ["0,0 -1,5 1 a true 2026-01-02", "0,1 2,25e1  b  ", "0,2 ,5 -3  false 2026-01-03"]
    lines = ["time qpos.a ctrl.m note on day", *rows]
    path.write_text("\n".join(line.replace(" ", separator) for line in lines))
    rules = {"ctrl.m": {"missing": "skip"}}
    log = read_recording(path, rules)
    assert log.channels["qpos.a"].values.tolist() == [-1.5, 22.5, 0.5]
    assert log.channels["qpos.a"].time.tolist() == [0, 0.1, 0.2]
    assert log.channels["ctrl.m"].values.tolist() == [1, -3]
    assert "Decimal commas read as points in columns 'time', 'qpos.a'." in log.notes


def test_a_bad_cell_among_decimal_commas_is_named(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time;qpos.a\n0,0;1,5\n0,1;oops\n0,2;4,5\n")
    with pytest.raises(RecordingError, match=r"column 'qpos.a', row 1: 'oops' is not a number"):
        read_recording(path)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (GOOD.replace("4.0", "oops"), r"column 'qpos.a', row 2: 'oops' is not a number"),
        (GOOD.replace("4.0", "4_0"), r"column 'qpos.a', row 2: '4_0' is not a number"),
        (GOOD.replace(",", ";").replace("4.0", "4,0"), "write decimals with a point"),
        (GOOD.replace("4.0", ""), r"column 'qpos.a': row 2 is empty"),
        (GOOD.replace("4.0", "nan"), r"column 'qpos.a': row 2 is empty \(NaN\)"),
        (GOOD.replace("4.0", "1e999"), r"column 'qpos.a': row 2 is inf"),
        (GOOD + "0.3,5\n", r"row 3: Expected 3 columns, got 2"),
        (GOOD + "0.3,5,6,7\n", r"row 3: Expected 3 columns, got 4"),
        (GOOD.replace("ctrl.m", "qpos.a"), "names column 1 'qpos.a'.*name of its own"),
        (GOOD.split("\n", 1)[1], "the first line must name the columns"),
        ("time,qpos.a\n", "names its columns but holds no samples"),
        ("  \n\n", "the first line must name the columns"),
        (GOOD.replace("\n", ",7\n").replace("ctrl.m,7", "ctrl.m,"), "last column has values"),
        (GOOD.encode("utf-16")[:-1], "not UTF-8, UTF-16 or Windows"),
        (GOOD.encode("utf-16-le"), "not text"),
        (GOOD.replace("ctrl.m", "ctrl.\u0081").encode("latin1"), "not UTF-8, UTF-16 or Windows"),
    ],
)
def test_a_wrong_csv_file_says_where(text, match, tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(RecordingError, match=match) as error:
        read_recording(path)
    assert str(path) in str(error.value)


def test_a_file_as_windows_writes_it_in_western_languages_is_read(tmp_path):
    text = GOOD.replace("ctrl.m", "ctrl.Kühlung")
    (tmp_path / "log.csv").write_bytes(text.encode("cp1252"))
    recording = read_recording(tmp_path / "log.csv")
    assert "ctrl.Kühlung" in recording.channels
    assert recording.notes[0] == "Read as Windows-1252 text, for it is not UTF-8."
    assert not any("Windows" in n for n in read_table_of(tmp_path, text).notes)


def read_table_of(folder, text):
    (folder / "other.csv").write_text(text, encoding="utf-8")
    return read_recording(folder / "other.csv")


def several_clocks():
    rng = np.random.default_rng(3)
    make = Recording.from_arrays
    fast = make(np.cumsum(rng.uniform(0.01, 0.02, 90)), qpos={"a": rng.normal(size=90)})
    slow = make(
        rng.uniform() + np.arange(30) * 0.03,
        ctrl={"m": rng.normal(size=30), "n": rng.normal(size=30)},
        sensor={"s": rng.normal(size=30)},
        units={"ctrl.m": "N m"},
    )
    lone = make(np.arange(7) * 0.12 + 0.1, sensor={"t": rng.normal(size=7)})
    return Recording(
        "three clocks", {**fast.channels, **slow.channels, **lone.channels}, ("Made up.",)
    )


def one_clock():
    rng = np.random.default_rng(4)
    time = np.cumsum(rng.uniform(0.9e-3, 1.1e-3, 100)) + 1.7e9
    return Recording.from_arrays(time, qpos={"root": rng.normal(size=(100, 7))}, name="one clock")


@pytest.mark.parametrize("ending", [".parquet", ".csv", ".csv.gz"])
@pytest.mark.parametrize("make", [one_clock, several_clocks])
def test_what_is_written_is_read_back_bit_for_bit(make, ending, tmp_path):
    recording = make()
    path = write_recording(recording, tmp_path / "deep" / f"log{ending}")
    back = read_recording(path)
    assert set(back.channels) == set(recording.channels)
    for name, channel in recording.channels.items():
        np.testing.assert_array_equal(back.channels[name].time, channel.time)
        np.testing.assert_array_equal(back.channels[name].values, channel.values)
        assert back.channels[name].hold == channel.hold
        if ending == ".parquet":
            assert back.channels[name].unit == channel.unit
    if ending == ".parquet":
        assert back.name == recording.name
        assert back.notes[: len(recording.notes)] == recording.notes
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_reading_and_writing_again_and_again_adds_nothing(tmp_path):
    recording = read_recording(write_recording(several_clocks(), tmp_path / "0.parquet"))
    again = read_recording(write_recording(recording, tmp_path / "1.parquet"))
    assert again.notes == recording.notes


def test_parquet_keeps_an_unusual_hold_and_csv_refuses_it(tmp_path):
    time, values = np.arange(5.0), np.arange(5.0)
    recording = Recording.from_arrays(time, qpos={"a": values}, ctrl={"m": values})
    held = read_recording(
        write_recording(recording, tmp_path / "a.parquet"), {"qpos.b": {"from": "ctrl.m"}}
    )
    assert held.channels["qpos.b"].hold == "zero"
    with pytest.raises(RecordingError, match=r"'qpos.b' has hold 'zero'.*write Parquet"):
        write_recording(held, tmp_path / "b.csv")
    assert not (tmp_path / "b.csv").exists()
    sampled = read_recording(
        tmp_path / "a.parquet", {"aux.i": {"from": "ctrl.m", "hold": "linear"}}
    )
    again = read_recording(write_recording(sampled, tmp_path / "c.parquet"))
    assert again.channels["aux.i"].hold == "linear"
    with pytest.raises(RecordingError, match=r"'aux.i' has hold 'linear'.*write Parquet"):
        write_recording(sampled, tmp_path / "c.csv")


def test_an_unknown_ending_writes_nothing(tmp_path):
    with pytest.raises(RecordingError, match=r"no writer for files that end in '.npz'"):
        write_recording(one_clock(), tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    path = write_recording(one_clock(), tmp_path / "a.csv")
    before = path.read_bytes()
    monkeypatch.setattr(pd.DataFrame, "to_csv", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_recording(several_clocks(), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


def test_importing_recordings_is_light():
    heavy = ("torch", "mujoco", "scipy.io", "pooch", "matplotlib")
    code = f"import sys, bo_sysid.recording; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    assert done.stdout.strip() == "[]"


def test_a_recording_without_a_name_takes_that_of_its_file(tmp_path):
    time = np.linspace(0.0, 1.0, 11)
    for name in ("first", "second"):
        nameless = Recording.from_arrays(time, qpos={"x": time})
        write_recording(nameless, tmp_path / f"{name}.parquet")
        assert read_recording(tmp_path / f"{name}.parquet").name == name
    named = Recording.from_arrays(time, qpos={"x": time}, name="swing")
    assert read_recording(write_recording(named, tmp_path / "a.parquet")).name == "swing"


@pytest.mark.parametrize("separator", [";", "\t"])
@pytest.mark.parametrize("point", [".", ","])
def test_names_may_hold_commas_between_other_separators(separator, point, tmp_path):
    header = separator.join(["time", "q [rad, of the link, not the motor]"])
    rows = [separator.join([f"0{point}{k}", f"{k}{point}5"]) for k in range(1, 9)]
    (tmp_path / "log.csv").write_text("\n".join([header, *rows]))
    rules = {"qpos.a": "q [rad, of the link, not the motor]"}
    channel = read_recording(tmp_path / "log.csv", rules).channels["qpos.a"]
    np.testing.assert_allclose(channel.time, np.arange(1, 9) / 10)
    np.testing.assert_allclose(channel.values, np.arange(1, 9) + 0.5)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_a_name_in_quotes_may_hold_a_separator_and_quotes(separator, tmp_path):
    """As pandas and spreadsheets write a column that is called "torque, elbow"."""
    frame = pd.DataFrame({"time": [0.0, 0.1], f'the "left"{separator} torque': [1.0, 2.0]})
    frame.to_csv(tmp_path / "log.csv", index=False, sep=separator)
    (table,) = read_tables(tmp_path / "log.csv")
    assert list(table.columns) == list(frame)


@pytest.mark.parametrize(
    "text",
    [
        "time;qpos.a;ctrl.m;mode\n[ms];[deg];[Nm];\n0;90;1,5;2\n4;180;2,5;2\n",
        "time  qpos.a ctrl.m mode\n  ms  deg    Nm -\n 0   90  1.5 2\n 4   180 2.5 2\n",
    ],
)
def test_a_line_of_units_below_the_header_is_read(text, tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(text)
    log = read_recording(path)
    assert log.channels["qpos.a"].values == pytest.approx([np.pi / 2, np.pi])
    assert log.channels["qpos.a"].time == pytest.approx([0, 0.004])
    assert log.channels["ctrl.m"].values.tolist() == [1.5, 2.5]
    assert "Units were read from the line below the header." in log.notes


def test_a_line_of_words_below_the_header_is_no_line_of_units(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("time,qpos.a,qpos.b\ns,angle,other\n0,1,2\n1,2,3\n")
    with pytest.raises(RecordingError, match="row 0: 'angle' is not a number"):
        read_recording(path)


@pytest.mark.parametrize("shape", [(3, 6), (6, 3)])
def test_time_is_the_axis_that_is_as_long_as_the_clock(shape, tmp_path):
    samples = np.arange(18.0).reshape(3, 6)
    matrix = samples if shape == (3, 6) else samples.T
    np.savez(tmp_path / "log.npz", time=np.arange(3.0), q=matrix)
    rules = {f"qpos.j{i}": {"from": f"q.{i}"} for i in range(6)}
    recording = read_recording(tmp_path / "log.npz", rules)
    for i in range(6):
        np.testing.assert_array_equal(recording.channels[f"qpos.j{i}"].values, samples[:, i])


def test_a_short_vector_is_no_clock(tmp_path):
    samples = np.arange(80.0).reshape(40, 2)  # one command fewer than stamps
    np.savez(tmp_path / "log.npz", time=np.arange(41.0), gains=np.ones(2), u=samples)
    np.testing.assert_array_equal(read_table(tmp_path / "log.npz").columns["u.1"], samples[:, 1])


def test_vectors_and_objects_in_json_become_columns(tmp_path):
    rows = [{"time": k, "q": [k, 2 * k], "u": {"elbow": 3 * k}} for k in range(3)]
    (tmp_path / "log.json").write_text(json.dumps(rows))
    columns = read_table(tmp_path / "log.json").columns
    assert {n: c.tolist() for n, c in columns.items()} == {
        "time": [0, 1, 2], "q.0": [0, 1, 2], "q.1": [0, 2, 4], "u.elbow": [0, 3, 6],
    }  # fmt: skip
    (tmp_path / "log.json").write_text(json.dumps({"time": [0, 1], "q": [[1, 2], [3, None]]}))
    columns = read_table(tmp_path / "log.json").columns
    np.testing.assert_array_equal(columns["q.1"], [2, np.nan])


def test_json_that_holds_no_numbers_of_a_machine_is_refused(tmp_path):
    (tmp_path / "deep.json").write_text(100_000 * "[")
    with pytest.raises(RecordingError, match="nested too deeply"):
        read_table(tmp_path / "deep.json")
    (tmp_path / "long.json").write_text(f'{{"time": [0, 1], "q": [1, -1{400 * "0"}]}}')
    np.testing.assert_array_equal(read_table(tmp_path / "long.json").columns["q"], [1, -np.inf])


def test_a_header_that_is_no_list_of_names_is_refused(tmp_path):
    (tmp_path / "log.csv").write_text(f"time,{200_000 * 'q'}\n0,1\n")
    with pytest.raises(RecordingError, match="header is no list of names"):
        read_table(tmp_path / "log.csv")


def test_the_index_that_pandas_writes_is_a_column(tmp_path):
    frame = pd.DataFrame({"time": [0.0, 0.1, 0.2], "qpos.a": [1.0, 2.0, 3.0]})
    frame.to_csv(tmp_path / "log.csv")
    np.testing.assert_array_equal(read_table(tmp_path / "log.csv").columns["index"], range(3))
    assert set(read_recording(tmp_path / "log.csv").channels) == {"qpos.a"}


def test_what_init_left_open_is_to_be_filled_in(tmp_path):
    np.savez(tmp_path / "log.npz", time=np.arange(3.0), enc=np.arange(3.0))
    with pytest.raises(RecordingError, match=r"qpos.a: fill in the column .* there are time, enc"):
        read_recording(tmp_path / "log.npz", {"qpos.a": {"from": "FILL IN"}})


@pytest.mark.parametrize("ending", [".json", ".parquet", ".csv"])
def test_dates_that_are_text_are_time_stamps_in_every_format(ending, tmp_path):
    """As loggers write them in JSON, and Python's in its own way, with a comma."""
    sent = [f"2024-03-31T03:59:50{',' if ending == '.csv' else '.'}{k:02d}0" for k in range(50)]
    stamped = [t if ending == ".csv" else f"{t}+02:00" for t in sent]
    q, path = np.sin(np.arange(50) / 20).tolist(), tmp_path / f"log{ending}"
    if ending == ".json":
        path.write_bytes(
            b"\xef\xbb\xbf"  # a mark of UTF-8 that programs of Windows begin with
            + json.dumps(
                [{"time": t, "qpos.a": x} for t, x in zip(stamped, q, strict=True)]
            ).encode()
        )
    elif ending == ".parquet":
        pq.write_table(pa.table({"time": stamped, "qpos.a": q}), path)
    else:
        rows = [f"{t};{x}".replace(".", ",") for t, x in zip(stamped, q, strict=True)]
        path.write_text("\n".join(["time;qpos.a", *rows]))
    recording = read_recording(path)
    hour = 3 if ending == ".csv" else 1
    begin = datetime(2024, 3, 31, hour, 59, 50, tzinfo=UTC).timestamp()
    np.testing.assert_allclose(
        recording.channels["qpos.a"].time, begin + np.arange(50) / 100, rtol=0, atol=1e-6
    )
    np.testing.assert_allclose(recording.channels["qpos.a"].values, q)
    assert "Dates in column 'time' converted to seconds since 1970." in recording.notes


def test_text_that_is_no_date_stays_text(tmp_path):
    rows = [{"time": f"2024-02-{30 + k}T00:00:00Z", "qpos.a": k} for k in range(2)]
    (tmp_path / "log.json").write_text(json.dumps(rows))
    with pytest.raises(RecordingError, match=r"'time', row 0: '2024-02-30T00:00:00Z' is not a num"):
        read_recording(tmp_path / "log.json")


@pytest.mark.parametrize("cell", ["NA", "#N/A", "n/a", "-nan(ind)", "1.#QNAN", "<NA>", "None", ""])
def test_what_programs_write_for_no_value_is_an_empty_cell(cell, tmp_path):
    rows = [f"{k / 100},{k % 7}" for k in range(50)]
    rows[20] = f"0.2,{cell}"
    (tmp_path / "log.csv").write_text("\n".join(["time,qpos.a", *rows]))
    with pytest.raises(RecordingError, match=r"row 20 is empty .*say `missing: skip`"):
        read_recording(tmp_path / "log.csv")
    recording = read_recording(tmp_path / "log.csv", {"qpos.a": {"missing": "skip"}})
    expected = [k % 7 for k in range(50) if k != 20]
    np.testing.assert_array_equal(recording.channels["qpos.a"].values, expected)


def test_a_last_line_that_breaks_off_is_left_out_and_no_other(tmp_path):
    """A logger was killed while it wrote."""
    rows = [f"{k / 100},{k % 7},{k}" for k in range(50)]
    text = "\n".join(["time,qpos.a,ctrl.m", *rows])
    (tmp_path / "log.csv").write_text(text.removesuffix(",49"))
    recording = read_recording(tmp_path / "log.csv")
    np.testing.assert_array_equal(recording.channels["qpos.a"].time, np.arange(49) / 100)
    assert "The last line breaks off after 2 of 3 cells and was left out." in recording.notes
    for broken in (text.replace("0.2,6,20", "0.2,6"), text.removesuffix(",49") + "\n"):
        (tmp_path / "log.csv").write_text(broken)
        with pytest.raises(RecordingError, match=r"row (20|49): Expected 3 columns, got 2"):
            read_recording(tmp_path / "log.csv")
    (tmp_path / "log.csv").write_text("time,qpos.a\n0.1")
    with pytest.raises(RecordingError, match="names its columns but holds no samples"):
        read_recording(tmp_path / "log.csv")


def test_a_quote_that_is_not_closed_takes_no_line_into_its_cell(tmp_path):
    lines = ["time,qpos.a,note", *(f'{k / 100},{k},"fine"' for k in range(40))]
    (tmp_path / "log.csv").write_text("\n".join([*lines, "", '0.5,7,"a ""b"""\n']))
    assert len(read_recording(tmp_path / "log.csv").channels["qpos.a"].time) == 41
    lines[30:32] = [line.removesuffix('"') for line in lines[30:32]]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    with pytest.raises(RecordingError, match="row 30: a quote that is not closed"):
        read_recording(tmp_path / "log.csv")


def test_pictures_in_an_hdf5_file_are_not_loaded(tmp_path):
    """Of a terabyte; an array with axes of length one is no picture."""
    path = tmp_path / "log.h5"
    save_hdf5(path)
    with h5py.File(path, "a") as file:
        file.create_dataset("camera/top", (10**6, 1000, 1000), np.uint8, chunks=(1, 1000, 1000))
        file["state"] = np.stack([COLUMNS["qpos.a"]] * 2, axis=1)[:, None]
    recording = read_recording(path, {"qpos.c": "state.1"})
    np.testing.assert_array_equal(recording.channels["qpos.c"].values, COLUMNS["qpos.a"])
    assert "Array 'camera.top' has 3 dimensions and was not read." in recording.notes
