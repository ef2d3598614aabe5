import numpy as np
import pytest

from bo_sysid.errors import RecordingError
from bo_sysid.recording import ClockRule, ColumnRule, RawTable
from bo_sysid.recording.mapping import to_recording
from bo_sysid.recording.units import _ALIASES, UNITS, unit

TIME = np.arange(50) * 0.01
WAVE = np.sin(2 * TIME)


def read(columns=None, clocks=None, strict=False, **arrays):
    table = {"time": TIME, "qpos.a": WAVE} | {k.replace("__", "."): v for k, v in arrays.items()}
    return to_recording(RawTable("log.csv", table), columns, clocks, strict=strict)


def test_names_of_the_convention_map_by_themselves():
    recording = read(ctrl__m=WAVE, other=WAVE)
    assert set(recording.channels) == {"qpos.a", "ctrl.m"}
    assert recording.channels["ctrl.m"].hold == "zero"
    assert recording.channels["qpos.a"].hold == "none"
    np.testing.assert_array_equal(recording.channels["qpos.a"].values, WAVE)
    assert "Columns not used: other." in recording.notes
    assert "Held between samples (zero order): ctrl.m." in recording.notes


@pytest.mark.parametrize(
    ("channel", "written", "si", "factor"),
    [
        ("qpos.b", "deg", "rad", np.pi / 180),
        ("qpos.b", "mm", "m", 1e-3),
        ("qpos.b", "turns", "rad", 2 * np.pi),
        ("qvel.b", "rpm", "rad/s", 2 * np.pi / 60),
        ("qvel.b", "deg/s", "rad/s", np.pi / 180),
        ("aux.b", "mA", "A", 1e-3),
        ("aux.b", "mV", "V", 1e-3),
        ("ctrl.b", "N*mm", "N m", 1e-3),
        ("ctrl.b", "mNm", "N m", 1e-3),
        ("ctrl.b", "%", "", 1e-2),
        ("sensor.b", "g0", "m/s²", 9.80665),
    ],
)
def test_units_are_converted_to_si(channel, written, si, factor):
    recording = read({channel: {"from": "raw", "unit": written}}, raw=WAVE)
    assert recording.channels[channel].unit == si
    np.testing.assert_allclose(recording.channels[channel].values, factor * WAVE, rtol=1e-14)
    assert any("raw" in note and written in note for note in recording.notes)


def stated(channel, written, columns=None):
    """Read a channel from a file that states its unit."""
    table = {"time": TIME, "qpos.a": WAVE, channel: WAVE}
    recording = to_recording(RawTable("log.h5", table, units={channel: written}), columns)
    return recording.channels[channel], " ".join(recording.notes)


@pytest.mark.parametrize("alias", _ALIASES)
def test_another_name_of_a_unit_means_the_same_in_a_rule_and_in_the_file(alias):
    short = unit(alias, "here")
    channel, notes = stated("sensor.b", alias)
    assert channel.unit == short.si
    np.testing.assert_allclose(channel.values, short.factor * WAVE, rtol=1e-14)
    assert (f"converted from {alias}" in notes) == (short.factor != 1)
    ruled = read({"sensor.b": {"from": "raw", "unit": alias}}, raw=WAVE).channels["sensor.b"]
    np.testing.assert_array_equal(channel.values, ruled.values)


def test_degrees_and_turns_a_minute_that_the_file_states_are_converted():
    position, notes = stated("qpos.b", "degrees")
    np.testing.assert_allclose(position.values, np.deg2rad(WAVE), rtol=1e-14)
    assert "converted from degrees to rad" in notes
    speed, _ = stated("qvel.b", "RPM")
    np.testing.assert_allclose(speed.values, WAVE * 2 * np.pi / 60, rtol=1e-14)


def test_a_unit_that_nobody_knows_is_kept_as_the_file_says_it():
    channel, _ = stated("aux.b", "furlong")
    assert channel.unit == "furlong"
    np.testing.assert_array_equal(channel.values, WAVE)


def test_gram_is_no_unit_of_a_sensor():
    with pytest.raises(RecordingError, match=r"unit 'g' measures mass, which no .* g0"):
        read({"sensor.acc": {"from": "acc", "unit": "g"}}, acc=WAVE)
    found = read({"sensor.acc": {"from": "acc", "unit": "g0"}}, acc=WAVE)
    np.testing.assert_allclose(found.channels["sensor.acc"].values, 9.80665 * WAVE)


def test_a_unit_of_the_file_that_does_not_fit_is_refused():
    with pytest.raises(
        RecordingError,
        match=r"log.h5: qpos.b, column 'qpos.b', as the file says: unit 'deg/s' measures angular "
        r"velocity, but qpos must be angle or length; did you mean 'deg'",
    ):
        stated("qpos.b", "deg/s")
    with pytest.raises(RecordingError, match="as the file says: unit 'ticks' needs `scale`"):
        stated("qpos.b", "ticks")
    scaled, _ = stated("qpos.b", "ticks", {"qpos.b": {"scale": 0.25}})
    np.testing.assert_array_equal(scaled.values, WAVE / 4)
    ruled, _ = stated("qpos.b", "deg/s", {"qpos.b": {"unit": "deg"}})
    np.testing.assert_allclose(ruled.values, np.deg2rad(WAVE), rtol=1e-14)


def test_every_unit_is_its_own_name_and_its_si_unit_has_factor_one():
    for name, entry in UNITS.items():
        assert unit(name, "here") is entry
        if entry.si:
            assert UNITS[entry.si].factor == 1


def test_rule_order_is_unit_scale_unwrap_sign_offset():
    turns = 3.0 * TIME / TIME[-1]  # three turns, read modulo one by a 4096-tick encoder
    ticks = np.floor(turns % 1.0 * 4096)
    rule = {"from": "enc", "unit": "ticks", "scale": 2 * np.pi / 4096, "unwrap": True, "sign": -1}
    recording = read({"qpos.b": rule | {"offset": 0.5}}, enc=ticks)
    np.testing.assert_allclose(
        recording.channels["qpos.b"].values, 0.5 - 2 * np.pi * turns, atol=2 * np.pi / 4096
    )
    note = next(n for n in recording.notes if n.startswith("qpos.b"))
    for word in ("'enc'", "scaled", "unwrapped", "sign reversed", "offset by 0.5"):
        assert word in note


def test_an_encoder_that_counts_from_the_base_is_less_what_carries_it():
    """In a chain each is less what the one before it shows."""
    own, wrist = 0.3 * np.cos(TIME), 0.1 * TIME
    rules = {
        "qpos.a": {"offset": 0.5}, "qpos.b": {"from": "two", "less": "qpos.a"},
        "qpos.c": {"from": "three", "less": "qpos.b"},
    }  # fmt: skip
    made = read(rules, two=WAVE + 0.5 + own, three=WAVE + 0.5 + own + wrist)
    np.testing.assert_allclose(made.channels["qpos.b"].values, own, atol=1e-12)
    np.testing.assert_allclose(made.channels["qpos.c"].values, wrist, atol=1e-12)
    assert "qpos.b is what its column shows less qpos.a." in made.notes


def test_a_register_keeps_its_sign():
    true = np.tile([-32768.0, -3.0, 0.0, 7.0, 32767.0], 10)
    rule = {"from": "load", "signed": 16, "scale": 0.5}
    recording = read({"ctrl.m": rule}, load=true % 2**16)
    np.testing.assert_array_equal(recording.channels["ctrl.m"].values, true / 2)
    assert "read as a signed number of 16 bits" in " ".join(recording.notes)


def test_unwrap_leaves_a_move_of_less_than_half_a_turn():
    angle = np.where(np.arange(50) % 10 < 5, 0.0, 3.0)
    recording = read({"qpos.b": {"from": "enc", "unwrap": True}}, enc=angle)
    np.testing.assert_array_equal(recording.channels["qpos.b"].values, angle)


def test_unwrap_takes_the_jump_of_a_geared_encoder():
    truth = 4.0 * TIME
    period = 2 * np.pi / 6
    recording = read({"qpos.b": {"from": "enc", "unwrap": period}}, enc=truth % period)
    np.testing.assert_allclose(recording.channels["qpos.b"].values, truth, atol=1e-12)


def test_the_time_column_is_named_and_converted():
    table = RawTable("log.csv", {"t": 1000 * TIME, "qpos.a": WAVE})
    recording = to_recording(table, {"time": {"from": "t", "unit": "ms"}})
    np.testing.assert_allclose(recording.channels["qpos.a"].time, TIME, atol=1e-15)
    assert "Time stamps in column 't' converted from ms to s." in recording.notes


@pytest.mark.parametrize("column", ["t", "time"])
@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_stamps_that_are_seconds_apart_ask_for_their_unit(factor, unit, column):
    table = RawTable("log.csv", {column: factor * TIME, "qpos.a": WAVE})
    words = f"log.csv: .*'{column}' are .* s apart.*unit: {unit}}}"
    with pytest.raises(RecordingError, match=words):
        to_recording(table, {} if column == "time" else {"time": {"from": "t"}})
    recording = to_recording(table, {"time": {"from": column, "unit": unit}})
    np.testing.assert_allclose(recording.channels["qpos.a"].time, TIME, atol=1e-12)


def test_slow_commands_and_stated_seconds_are_taken_as_they_are():
    slow = 100 * TIME
    commanded = read(None, {"ctrl": {"from": "slow"}}, ctrl__m=WAVE, slow=slow)
    np.testing.assert_array_equal(commanded.channels["ctrl.m"].time, slow)
    stated = read({"time": {"from": "time", "unit": "s"}}, time=slow)
    np.testing.assert_array_equal(stated.channels["qpos.a"].time, slow)


def test_a_kind_or_a_channel_can_have_a_clock_of_its_own():
    late = TIME + 0.003
    arrays = {"ctrl__m": WAVE, "ctrl__n": WAVE, "t_cmd": late, "t_n": 1000 * (TIME + 0.004)}
    clocks = {"ctrl": {"from": "t_cmd", "hold": "zero"}, "ctrl.n": {"from": "t_n", "unit": "ms"}}
    channels = read(None, clocks, **arrays).channels
    np.testing.assert_array_equal(channels["ctrl.m"].time, late)
    np.testing.assert_allclose(channels["ctrl.n"].time, TIME + 0.004, atol=1e-15)
    np.testing.assert_array_equal(channels["qpos.a"].time, TIME)


def test_the_recordings_time_can_be_named_where_a_channel_has_stamps_of_its_own():
    arrays = {"ctrl__m": WAVE, "time__ctrl": TIME + 0.1}
    own = read(None, None, **arrays).channels["ctrl.m"]
    np.testing.assert_array_equal(own.time, TIME + 0.1)
    common = read(None, {"ctrl": "time"}, **arrays).channels["ctrl.m"]
    np.testing.assert_array_equal(common.time, TIME)


@pytest.mark.parametrize("clock", [{"unit": "ms"}, {"from": "time", "unit": "ms"}])
def test_the_unit_of_a_clock_is_used_also_where_it_is_the_time_of_the_recording(clock):
    arrays = {"time": 1000 * TIME, "ctrl__m": WAVE}
    recording = read({"ctrl.m": {"clock": "seconds"}}, {"qpos": clock}, seconds=TIME, **arrays)
    np.testing.assert_allclose(recording.channels["qpos.a"].time, TIME, atol=1e-15)
    np.testing.assert_array_equal(recording.channels["ctrl.m"].time, TIME)
    assert "Time stamps in column 'time' converted from ms to s." in recording.notes
    own = read(None, {"ctrl": {"unit": "ms"}}, ctrl__m=WAVE, time__ctrl=1000 * TIME)
    np.testing.assert_allclose(own.channels["ctrl.m"].time, TIME, atol=1e-15)
    np.testing.assert_array_equal(own.channels["qpos.a"].time, TIME)


def test_the_unit_of_a_clock_goes_with_its_column():
    clocks = {"ctrl": {"from": "t_ms", "unit": "ms"}}
    columns = {"ctrl.m": {"clock": "t_ms"}, "ctrl.n": {"clock": "t_s"}}
    channels = read(
        columns, clocks, ctrl__m=WAVE, ctrl__n=WAVE, t_ms=1000 * TIME, t_s=TIME
    ).channels
    np.testing.assert_allclose(channels["ctrl.m"].time, TIME, atol=1e-15)
    np.testing.assert_array_equal(channels["ctrl.n"].time, TIME)


@pytest.mark.parametrize(
    ("columns", "clocks", "late"),
    [
        ({}, {"ctrl": "t"}, 0.0),
        ({}, {"ctrl": {"from": "t", "shift": 0.004}}, 0.004),
        ({"ctrl.m": {"clock": "t"}}, {}, 0.0),
        ({"ctrl.m": {"clock": "t"}}, {"ctrl": {"shift": 0.004}}, 0.004),
    ],
)
def test_what_is_said_of_the_time_holds_for_clocks_in_its_column(columns, clocks, late):
    time = {"from": "t", "unit": "ms", "scale": 0.5, "offset": -3.0}
    arrays = {"t": 2000 * (TIME + 3.0), "ctrl__m": WAVE}
    channels = read({"time": time, **columns}, clocks, **arrays).channels
    np.testing.assert_allclose(channels["qpos.a"].time, TIME, atol=1e-12)
    np.testing.assert_allclose(channels["ctrl.m"].time, TIME + late, atol=1e-12)


@pytest.mark.parametrize(
    ("begin", "unit", "factor"),
    [
        (0, "ms", 1),
        (0, "us", 1_000),
        (0, "ns", 1_000_000),
        (1_700_000_000, "ms", 1),
        (1_700_000_000, "us", 1_000),
    ],
)
def test_instants_in_two_units_are_the_same_instants(begin, unit, factor):
    ms = 1000 * begin + 10 * np.arange(50)
    time = np.array([float(f"{k / 1000:.3f}") for k in ms])  # as text says them
    clocks = {"qvel": {"from": "t", "unit": unit}}
    channels = read(None, clocks, time=time, t=factor * ms, qvel__a=WAVE).channels
    np.testing.assert_array_equal(channels["qvel.a"].time, time)


def test_a_column_called_time_of_a_kind_is_its_clock_and_may_be_shorter():
    clock = np.append(TIME[:20] * 2, np.full(30, np.nan))
    values = np.append(WAVE[:20], np.full(30, np.nan))
    channel = read(time__ctrl=clock, ctrl__m=values).channels["ctrl.m"]
    np.testing.assert_array_equal(channel.time, TIME[:20] * 2)
    np.testing.assert_array_equal(channel.values, WAVE[:20])


def test_a_hold_can_be_stated_for_an_input():
    recording = read({"aux.s": {"from": "s", "hold": "zero"}}, s=WAVE)
    assert recording.channels["aux.s"].hold == "zero"


def test_an_input_that_was_sampled_is_interpolated_and_a_note_says_so():
    recording = read({"aux.duty": {"from": "s", "hold": "linear"}}, s=WAVE)
    duty = recording.channels["aux.duty"]
    between = 0.5 * (duty.time[3] + duty.time[4])
    assert duty.at(np.array([between]))[0] == pytest.approx(0.5 * (WAVE[3] + WAVE[4]))
    assert "Interpolated between samples: aux.duty." in recording.notes
    with pytest.raises(RecordingError, match=r"sensor.s: hold is 'linear', which is for inputs"):
        read({"sensor.s": {"from": "s", "hold": "linear"}}, s=WAVE)
    with pytest.raises(RecordingError, match=r"qpos.b: hold is 'zero', which is for inputs"):
        read({"qpos.b": {"from": "s", "hold": "zero"}}, s=WAVE)
    with pytest.raises(RecordingError, match=r"ctrl.m: hold is 'none', and inputs .* zero or lin"):
        read({"ctrl.m": {"from": "s", "hold": "none"}}, s=WAVE)


def test_empty_cells_of_a_sampled_input_are_interpolated_across():
    values = np.where(np.arange(WAVE.size) == 5, np.nan, WAVE)
    rule = {"from": "s", "hold": "linear", "missing": "skip"}
    recording = read({"aux.duty": rule}, s=values)
    duty = recording.channels["aux.duty"]
    assert duty.at(TIME[5:6])[0] == pytest.approx(0.5 * (WAVE[4] + WAVE[6]))
    assert any("what lies between is interpolated" in note for note in recording.notes)


def test_rules_can_be_given_as_values():
    rule = ColumnRule("s", unit="deg", sign=-1)
    clocks = {"sensor": ClockRule("t2")}
    channel = read({"sensor.s": rule}, clocks, s=WAVE, t2=TIME + 1).channels["sensor.s"]
    np.testing.assert_allclose(channel.values, -np.pi / 180 * WAVE)
    assert channel.time[0] == 1.0


def test_a_rule_of_none_values_is_the_default_rule():
    rule = {"from": None, "unit": None, "hold": None, "clock": None}
    assert ColumnRule.parse("qpos.a", rule) == ColumnRule()
    assert read(None, {"qpos": {"from": "time", "hold": None}}).channels["qpos.a"].time[1] == 0.01


@pytest.mark.parametrize(
    ("columns", "match"),
    [
        ({"qpos.b": {"from": "tetha"}}, "no column 'tetha', which qpos.b.*did you mean 'theta'"),
        ({"qpos.b": {"from": "theta", "unit": "degg"}}, "qpos.b: unknown unit 'degg'.*'deg'"),
        ({"qpos.b": {"from": "theta", "unit": "rpm"}}, "'rpm' measures angular velocity.*angle"),
        ({"time": {"from": "theta", "unit": "mm"}}, "columns: time: unit 'mm' measures length"),
        ({"qpos.b": {"from": "theta", "unit": "ticks"}}, "needs `scale`.*4096"),
        (
            {"qpos.b": {"from": "theta", "sine": -1}},
            "unknown key 'sine'; did you mean 'signed' or 'sign'",
        ),
        ({"qpos.b": {"from": "theta", "less": "qpos.aa"}}, "'qpos.aa' is not in .*mean 'qpos.a'"),
        ({"qpos.b": {"from": "theta", "less": "qvel.a"}}, "another channel of the kind qpos"),
        ({"qpos.b": {"from": "theta", "less": "qpos.b"}}, "another channel of the kind qpos"),
        ({"time": {"from": "theta", "less": "qpos.a"}}, "time stamps have none"),
        ({"qpos.b": {"from": "theta", "sign": -2}}, "sign is -2; it must be 1 or -1"),
        ({"qpos.b": {"from": "theta", "sign": "-1"}}, "sign is '-1'; it must be a number"),
        ({"qpos.b": {"from": 3}}, "from is 3; it must be text"),
        ({"qpos.b": {"from": "theta", "scale": 0}}, "scale is 0.0; it must be finite, not 0"),
        ({"qpos.b": {"from": "theta", "offset": np.inf}}, "offset is inf; it must be finite"),
        ({"qpos.b": {"from": "theta", "unwrap": -1}}, "unwrap is -1"),
        ({"qpos.b": {"from": "theta", "signed": 12}}, "signed is 12"),
        ({"qpos.b": {"from": "theta", "hold": "zeros"}}, "hold is 'zeros'; did you mean 'zero'"),
        ({"qpos.b": {"from": "theta", "missing": "skipp"}}, "did you mean 'skip'"),
        ({"pos.b": {"from": "theta"}}, "columns: pos.b.*did you mean 'qpos'"),
        ({"qpos": {"from": "theta"}}, "columns: qpos: a channel is called"),
        ({"qpos.left b": {"from": "theta"}}, "no white space: rename the joint .* to 'left_b'"),
    ],
)
def test_a_wrong_rule_is_refused_with_the_nearest_right_one(columns, match):
    with pytest.raises(RecordingError, match=match):
        read(columns, theta=WAVE)


@pytest.mark.parametrize(
    ("clocks", "match"),
    [
        ({"ctl": {"from": "t2"}}, "clocks: ctl.*did you mean 'ctrl'"),
        ({"ctrl": {"from": "t3"}}, "no column 't3' with time stamps.*'t2'"),
        ({"ctrl.n": {"from": "t2"}}, "'ctrl.n' fits no channel; did you mean 'ctrl.m'"),
        ({"ctrl": {"from": "t2", "unit": "mm"}}, "unit 'mm' measures length"),
        ({"ctrl": {"fron": "t2"}}, "unknown key 'fron'; did you mean 'from'"),
        ({"ctrl": {"from": "t2", "hold": "zeero"}}, "hold is 'zeero'; did you mean 'zero'"),
    ],
)
def test_a_wrong_clock_is_refused_with_the_nearest_right_one(clocks, match):
    with pytest.raises(RecordingError, match=match):
        read(None, clocks, ctrl__m=WAVE, t2=TIME)


def test_a_counter_of_microseconds_is_unwrapped():
    start = 2.0**32 - 200_000  # it wraps after 0.2 s
    counter = (start + 1e6 * TIME) % 2.0**32
    rule = {"from": "micros", "unit": "us", "unwrap": 2**32 * 1e-6, "offset": -start * 1e-6}
    table = RawTable("log.csv", {"micros": counter, "qpos.a": WAVE})
    recording = to_recording(table, {"time": rule})
    np.testing.assert_allclose(recording.channels["qpos.a"].time, TIME, atol=1e-9)
    assert "Time stamps in column 'micros' unwrapped (1 jumps of 4294.97)." in recording.notes
    with pytest.raises(RecordingError, match="time runs backwards in row 20"):
        to_recording(table, {"time": {**rule, "unwrap": False}})
    gone = np.where(np.arange(50) == 30, np.nan, counter)  # an empty cell is none that ends a log
    with pytest.raises(RecordingError, match="row 30 is empty"):
        to_recording(RawTable("log.csv", {"micros": gone, "qpos.a": WAVE}), {"time": rule})


def test_a_register_that_counts_from_below_zero_is_signed():
    counter = (np.arange(50) - 25) % 2.0**16
    rule = {"from": "ticks", "scale": 0.01, "signed": 16, "offset": 0.25}
    table = RawTable("log.csv", {"ticks": counter, "qpos.a": WAVE})
    time = to_recording(table, {"time": rule}).channels["qpos.a"].time
    np.testing.assert_allclose(time, TIME, atol=1e-12)


@pytest.mark.parametrize(
    ("rule", "told"),
    [
        ({"sign": -1}, "columns: time: sign is -1, but time stamps have none; they take from"),
        ({"missing": "skip"}, "columns: time: missing is 'skip', but"),
        ({"hold": "zero"}, "columns: time: hold is 'zero', but"),
        ({"clock": "t2"}, "columns: time: clock is 't2', but"),
        ({"unwrap": True}, "columns: time: unwrap is true, .* must be the size of the jump in s"),
        ({"rate": 50, "from": "t2"}, "columns: time: rate is 50, .*leave everything else out, or"),
        ({"rate": -50.0}, r"columns: time: rate is -50.0; it must be positive, in Hz"),
    ],
)
def test_what_says_nothing_of_a_clock_is_refused(rule, told):
    with pytest.raises(RecordingError, match=told):
        read({"time": rule})


def test_rows_without_stamps_are_counted_at_a_stated_rate():
    table = RawTable("log.npz", {"qpos.a": WAVE, "ctrl.m": WAVE[:-1], "gains": np.ones(3)})
    with pytest.raises(RecordingError, match=r"without stamps: columns: \{time: \{rate: 500\}\}"):
        to_recording(table)
    recording = to_recording(table, {"time": {"rate": 250}}, {"ctrl": {"shift": 0.01}})
    instants = np.arange(50) * 0.004
    np.testing.assert_allclose(recording.channels["qpos.a"].time, instants)
    np.testing.assert_allclose(recording.channels["ctrl.m"].time, instants[:-1] + 0.01)
    late = RawTable("log.csv", {"time": TIME + 7, "qpos.a": WAVE})  # its own stamps are left alone
    counted = to_recording(late, {"time": {"rate": 250}})
    np.testing.assert_allclose(counted.channels["qpos.a"].time, instants)
    assert counted.notes[-1] == "Columns not used: time."
    with pytest.raises(RecordingError, match=r"qpos.a: rate is 250, .* as columns: \{time: \{rate"):
        to_recording(late, {"qpos.a": {"rate": 250}})


def test_without_a_time_column_the_message_shows_how_to_name_it():
    with pytest.raises(RecordingError, match=r"no column 'time'.*'stamp'.*columns: \{time: \{from"):
        to_recording(RawTable("log.csv", {"stamp": TIME, "qpos.a": WAVE}))


def test_without_a_measured_channel_the_message_shows_the_columns():
    with pytest.raises(RecordingError, match=r"no column is a measured.*'theta'.*columns: \{qpos"):
        to_recording(RawTable("log.csv", {"time": TIME, "theta": WAVE, "ctrl.m": WAVE}))


def test_a_shift_moves_the_stamps_of_a_kind():
    table = RawTable(
        "log", {"time": np.arange(5.0), "qpos.a": np.arange(5.0), "ctrl.m": np.ones(5)}
    )
    recording = to_recording(table, clocks={"ctrl": {"shift": 0.25}})
    np.testing.assert_array_equal(recording.channels["ctrl.m"].time, np.arange(5.0) + 0.25)
    np.testing.assert_array_equal(recording.channels["qpos.a"].time, np.arange(5.0))
    assert any("shifted by 250 ms" in note for note in recording.notes)


@pytest.mark.parametrize("begin", [5.7, 354.3, 359.9])
def test_logs_of_one_encoder_begin_nearest_to_zero(begin):
    """An encoder of 0 to 360 degrees that begins on either side of zero."""
    angle = begin + 20 * np.sin(TIME)
    rule = {"qpos.b": {"from": "enc", "unit": "deg", "unwrap": True}}
    read_back = np.degrees(read(rule, enc=angle % 360.0).channels["qpos.b"].values)
    np.testing.assert_allclose(read_back, angle - 360 * round(begin / 360), atol=1e-9)


def test_an_encoder_whose_first_reading_is_missing_begins_nearest_to_zero():
    angle = 354.3 + np.zeros_like(TIME)
    angle[0] = np.nan
    rule = {"qpos.b": {"from": "enc", "unit": "deg", "unwrap": True, "missing": "skip"}}
    read_back = np.degrees(read(rule, enc=angle).channels["qpos.b"].values)
    np.testing.assert_allclose(read_back, -5.7, atol=1e-9)


def test_what_an_offset_takes_to_zero_is_not_moved_by_a_turn():
    angle = 200 + 170 * np.sin(TIME / TIME[-1])
    rule = {"qpos.b": {"from": "enc", "unit": "deg", "unwrap": True, "offset": -np.pi}}
    read_back = np.degrees(read(rule, enc=angle % 360.0).channels["qpos.b"].values)
    np.testing.assert_allclose(read_back, angle - 180, atol=1e-9)


def test_a_column_that_a_rule_reads_is_no_other_channel():
    rules = {"time": "time [ms]", "qpos.b": {"from": "qpos.b [deg]", "unit": "deg"}}
    table = RawTable("log.csv", {"time [ms]": TIME, "qpos.b [deg]": WAVE, "qpos.c_raw": WAVE})
    recording = to_recording(table, rules, no_channels=["qpos.c_raw"])
    assert set(recording.channels) == {"qpos.b"}
    np.testing.assert_allclose(recording.channels["qpos.b"].values, np.pi / 180 * WAVE, rtol=1e-14)
    assert "Columns not used: qpos.c_raw." in recording.notes
    with pytest.raises(RecordingError, match=r"channel 'qpos.b \[deg\]' must be named"):
        to_recording(table, {"time": "time [ms]"})  # nothing says which joint that is
