import numpy as np
import pytest

from bo_sysid.errors import RecordingError
from bo_sysid.recording import RawTable, sensor_noise
from bo_sysid.recording.mapping import to_recording

TIME = np.arange(50) * 0.01
WAVE = np.sin(2 * TIME)


def read(time=TIME, columns=None, strict=False, **arrays):
    table = {"time": time, "qpos.a": np.sin(2 * np.nan_to_num(time, posinf=0.0))}
    table |= {k.replace("__", "."): v for k, v in arrays.items()}
    return to_recording(RawTable("log.csv", table), columns, strict=strict)


def with_value(row, value, array=WAVE):
    changed = array.copy()
    changed[row] = value
    return changed


def test_a_clean_log_passes_strict_and_says_nothing():
    assert read(strict=True).notes == ()


def test_duplicate_stamps_keep_the_first_sample():
    time = with_value(7, TIME[6], TIME)
    recording = read(time, ctrl__m=np.arange(50.0))
    channel = recording.channels["ctrl.m"]
    assert channel.values.tolist() == [v for v in range(50) if v != 7]
    assert np.all(np.diff(channel.time) > 0)
    assert any("1 duplicate stamp" in n and "rows 7" in n for n in recording.notes)


def test_a_clock_that_is_coarser_than_its_rows_is_told():
    coarse = np.floor(TIME / 0.04 + 1e-9) * 0.04  # four rows a stamp
    recording = read(coarse, qpos__a=TIME)
    (note,) = (n for n in recording.notes if n.startswith("Coarse clock"))
    assert note.startswith("Coarse clock 'time': 37 of 50 samples of qpos.a have the stamp of one")
    again = read(coarse, qpos__a=coarse)  # a sensor that is read more often than it measures
    assert not any("Coarse" in n for n in again.notes)
    with pytest.raises(RecordingError, match=r"refused because of --strict\. Coarse clock 'time'"):
        read(coarse, qpos__a=TIME, strict=True)


def test_gaps_are_kept_and_nothing_is_invented():
    time = np.delete(TIME, [10, 11, 30])
    recording = read(time)
    np.testing.assert_array_equal(recording.channels["qpos.a"].time, time)
    assert any("2 gaps" in n and "about 3 samples missing" in n for n in recording.notes)


def test_jitter_is_kept_and_said():
    rng = np.random.default_rng(0)
    time = np.cumsum(0.01 + 0.001 * rng.uniform(-1, 1, 200))
    recording = read(time)
    np.testing.assert_array_equal(recording.channels["qpos.a"].time, time)
    assert any("jitter" in n for n in recording.notes)


def test_rows_of_commands_in_a_merged_log_are_no_gaps_between_measurements():
    """A log with a row for each message: positions every 10 ms, commands every 20 ms."""
    stamps = np.sort(np.concatenate([TIME, TIME[::2] + 0.003]))
    is_position = np.isin(stamps, TIME)
    columns = {name: {"missing": "skip"} for name in ("qpos.a", "ctrl.m")}
    positions = np.where(is_position, np.sin(stamps), np.nan)
    recording = read(
        stamps,
        columns,
        qpos__a=positions,
        ctrl__m=np.where(is_position, np.nan, stamps),
    )
    assert not any("gap" in n or "jitter" in n for n in recording.notes)
    positions[np.flatnonzero(is_position)[20:22]] = np.nan
    recording = read(stamps, columns, qpos__a=positions, ctrl__m=np.where(is_position, np.nan, 1.0))
    assert any("1 gap longer" in n and "about 2 samples missing" in n for n in recording.notes)


@pytest.mark.parametrize(
    ("time", "match"),
    [
        (with_value(7, TIME[6], TIME), "duplicate stamp"),
        (np.delete(TIME, 10), "1 gap"),
        (np.cumsum(0.01 + 0.002 * np.sin(np.arange(50) ** 2)), "jitter"),
    ],
)
def test_strict_refuses_what_is_otherwise_used(time, match):
    assert read(time).channels["qpos.a"].values.size >= 49
    with pytest.raises(RecordingError, match=rf"log.csv: refused because of --strict.*{match}"):
        read(time, strict=True)


def test_a_paused_command_is_no_gap_in_a_measurement():
    clock = np.array([0.0, 0.1, 0.1, 0.45])
    recording = read(strict=True, time__ctrl=clock, ctrl__m=np.arange(4.0))
    assert recording.channels["ctrl.m"].values.tolist() == [0, 1, 3]


def test_a_channel_that_never_moves_is_noted_and_refused_by_strict():
    assert "Never moves: qpos.b; nothing can be said about it." in read(qpos__b=0 * WAVE).notes
    with pytest.raises(RecordingError, match=r"--strict.*Never moves: qpos.b"):
        read(strict=True, qpos__b=0 * WAVE)


@pytest.mark.parametrize("more", [{}, {"qvel__a": WAVE}, {"ctrl__m": WAVE}])
def test_positions_that_never_move_are_an_error(more):
    with pytest.raises(RecordingError, match=r"qpos.a never moves \(all 50 samples are 2\)"):
        read(qpos__a=0 * WAVE + 2, **more)


def test_time_running_backwards_names_the_row():
    with pytest.raises(
        RecordingError, match=r"column 'time': time runs backwards in row 20, from 0.19 s to 0.05 s"
    ):
        read(with_value(20, 0.05, TIME))


@pytest.mark.parametrize(("bad", "shown"), [(np.nan, "empty"), (np.inf, "inf"), (-np.inf, "-inf")])
def test_a_value_that_is_not_finite_names_file_column_and_row(bad, shown):
    with pytest.raises(
        RecordingError, match=rf"log.csv: qpos.b, column 'qpos.b': row 9 is {shown}"
    ):
        read(qpos__b=with_value(9, bad))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_stamp_that_is_not_finite_names_the_row(bad):
    with pytest.raises(RecordingError, match="column 'time': row 9 is"):
        read(with_value(9, bad, TIME), qpos__a=WAVE)


def test_empty_cells_are_skipped_only_when_a_rule_says_so():
    sparse = np.where(np.arange(50) % 5 == 0, WAVE, np.nan)
    with pytest.raises(RecordingError, match=r"row 1 is empty.*`missing: skip`"):
        read(ctrl__m=sparse, qpos__b=WAVE)
    recording = read(columns={"ctrl.m": {"missing": "skip"}}, ctrl__m=sparse)
    np.testing.assert_array_equal(recording.channels["ctrl.m"].values, WAVE[::5])
    np.testing.assert_array_equal(recording.channels["ctrl.m"].time, TIME[::5])
    assert any("40 empty cells skipped; the value before it is held" in n for n in recording.notes)


def test_skipping_empty_cells_does_not_skip_infinite_ones():
    with pytest.raises(RecordingError, match="row 3 is inf"):
        read(columns={"qpos.b": {"missing": "skip"}}, qpos__b=with_value(3, np.inf))


def test_states_may_have_one_stamp_more_than_controls():
    recording = read(ctrl__m=WAVE[:-1])
    assert recording.channels["ctrl.m"].time.size == 49
    assert any("one sample fewer than time stamps" in n for n in recording.notes)


@pytest.mark.parametrize("size", [48, 51, 1])
def test_lengths_that_do_not_match_are_an_error(size):
    with pytest.raises(RecordingError, match=rf"{size} samples, but its clock, column 'time', has"):
        read(ctrl__m=np.resize(WAVE, size))


def test_a_measured_channel_may_not_be_shorter():
    with pytest.raises(RecordingError, match="49 samples, but its clock"):
        read(qpos__b=WAVE[:-1])


def test_a_value_without_a_stamp_is_an_error():
    clock = with_value(slice(40, None), np.nan, TIME)
    with pytest.raises(RecordingError, match=r"row 40 has a value but no time stamp.*'time.ctrl'"):
        read(time__ctrl=clock, ctrl__m=WAVE)


def test_one_stamp_over_and_over_is_an_error():
    with pytest.raises(RecordingError, match="50 rows hold 1 different time stamps"):
        read(np.zeros(50), qpos__a=WAVE)


def test_a_merged_log_with_a_row_for_each_channel_loses_nothing():
    """Row 2k holds the position; row 2k + 1, with the same stamp, at times a control."""
    stamps, sent = np.repeat(TIME, 2), np.arange(0, 50, 2)
    position, control = np.full(100, np.nan), np.full(100, np.nan)
    position[::2], control[2 * sent + 1] = WAVE, 7.0 + sent
    skip = {"qpos.a": {"missing": "skip"}, "ctrl.m": {"missing": "skip"}}
    recording = read(stamps, skip, strict=True, qpos__a=position, ctrl__m=control)
    a, m = recording.channels["qpos.a"], recording.channels["ctrl.m"]
    np.testing.assert_array_equal(a.values, WAVE)
    np.testing.assert_array_equal(a.time, TIME)
    np.testing.assert_array_equal(m.values, 7.0 + sent)
    np.testing.assert_array_equal(m.time, TIME[sent])
    notes = " ".join(recording.notes)
    assert "ctrl.m: 25 empty cells skipped" in notes
    assert "qpos.a" not in notes
    assert "duplicate" not in notes


def test_of_two_values_at_one_stamp_the_first_that_is_not_empty_is_kept_and_said():
    stamps = np.repeat(TIME, 3)
    control = np.tile([np.nan, 1.0, 2.0], 50)
    recording = read(stamps, {"ctrl.m": {"missing": "skip"}}, ctrl__m=control)
    assert recording.channels["ctrl.m"].values.tolist() == [1.0] * 50
    assert any("100 duplicate stamps" in n and "rows 1, 2, 4" in n for n in recording.notes)
    control[1] = np.inf
    with pytest.raises(RecordingError, match="row 1 is inf"):
        read(stamps, {"ctrl.m": {"missing": "skip"}}, ctrl__m=control)


@pytest.mark.parametrize("rows", [2, 5, 10])
def test_a_sensor_that_is_slower_than_its_log_has_one_sample_for_each_value(rows):
    """A camera of 50 Hz in a log of 500 Hz: noise of 1e-3 was taken for 3e-6."""
    rng, time = np.random.default_rng(0), np.arange(4000) * 0.002
    seen = np.sin(3 * time) + 1e-3 * rng.standard_normal(len(time))
    held = seen[np.arange(len(time)) // rows * rows]
    recording = read(time, qpos__a=held)
    channel = recording.channels["qpos.a"]
    np.testing.assert_array_equal(channel.time, time[::rows])
    np.testing.assert_array_equal(channel.values, seen[::rows])
    assert sensor_noise(recording)["qpos.a"] == pytest.approx(1e-3, rel=0.1)
    assert any(f"each value stands in about {rows} rows" in n for n in recording.notes)


@pytest.mark.parametrize("rate", [0.05, 0.3])
def test_what_an_encoder_shows_step_by_step_is_read_anew_in_every_row(rate):
    time = np.arange(4000) * 0.002
    for angle in (rate * time, np.sin(rate * time), np.where(time < 4, 0.0, np.sin(3 * time))):
        recording = read(time, qpos__a=np.round(angle / 1e-3) * 1e-3)
        assert len(recording.channels["qpos.a"].time) == len(time)


def test_registers_hold_what_their_bits_can():
    raw = np.arange(50.0)
    with pytest.raises(RecordingError, match=r"signed: 8 is for the raw .* 255; 49.5 is none"):
        read(columns={"qpos.b": {"from": "x", "signed": 8}}, x=with_value(3, 49.5, raw))
    with pytest.raises(RecordingError, match="65536 is none"):
        read(columns={"qpos.b": {"from": "x", "signed": 16}}, x=with_value(3, 65536, raw))


def test_a_counter_that_paused_for_more_than_half_its_range_went_forwards():
    time = np.append(np.arange(1000) * 0.01, 50.0 + np.arange(1000) * 0.01)  # a pause of 40 s
    clock = {"time": {"from": "count", "unwrap": 65.536}}
    log = RawTable("log.csv", {"count": time % 65.536, "qpos.a": np.sin(time)})
    recording = to_recording(log, clock)
    np.testing.assert_allclose(recording.channels["qpos.a"].time, time, atol=1e-9)
