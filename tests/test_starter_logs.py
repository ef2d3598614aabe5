"""`init`: logs that are fast, gappy, or no logs that can be read."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bo_sysid.errors import RecordingError, UserError
from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable, read_tables
from bo_sysid.starter.columns import describe
from bo_sysid.starter.guess import guess_rules, read
from bo_sysid.starter.init import init
from bo_sysid.starter.supply import with_supply
from bo_sysid.starter.write import _outwards
from bo_sysid.study import Study
from bo_sysid.study.inputs import read_train

WHEEL = """
<mujoco><worldbody><body><joint name="wheel"/><geom size=".1"/></body></worldbody>
  <actuator><motor name="wheel" joint="wheel"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("interval", "unit", "sure"),
    [
        (250e-6, "us", False),
        (250e-6, "ms", False),
        (1e-3, "us", True),
        (1e-3, "ms", True),
        (1e-3, "ns", True),
        (1e-3, "s", True),
        (0.02, "ms", True),
        (0.02, "us", True),
        (0.02, "s", True),
        (0.1, "ms", False),
        (0.1, "s", False),
    ],
)
def test_the_unit_of_a_clock_that_names_none_is_told_by_its_steps(
    interval: float, unit: str, sure: bool
) -> None:
    """A step of 250 may be 250 µs of a fast log, or 250 ms of a slow one: the first, marked."""
    ticks = interval / {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit] * np.arange(400.0)
    wave = np.sin(0.05 * np.arange(400.0))
    table = RawTable("log", {"time": ticks, "wheel_pos": wave, "wheel_torque": wave**2})
    rules = guess_rules(Model.from_xml(WHEEL), table)
    stamps = read(table, rules).channels["qpos.wheel"].time
    np.testing.assert_allclose(np.diff(stamps), interval, rtol=1e-6)
    guess = rules.guesses.get("time")
    assert (guess is None or guess.confidence >= 0.55) == sure
    if not sure:
        assert f"of {1e3 * interval:g} ms in {unit}, but" in guess.reason


@pytest.mark.parametrize(
    ("name", "stated", "seconds"),
    [
        ("time [s]", "", 1.0), ("time_s", "", 1.0), ("t_sec", "", 1.0), ("seconds", "", 1.0),
        ("time", "s", 1.0), ("millis", "", 1e-3), ("micros", "", 1e-6), ("time [min]", "", 60.0),
        ("stamp", "ms", 1e-3),
    ],
)  # fmt: skip
@pytest.mark.parametrize("interval", [1e-4, 0.2, 1.0])
def test_the_unit_that_a_clock_states_stands_whatever_its_steps(
    name: str, stated: str, seconds: float, interval: float
) -> None:
    time = interval * np.arange(400.0)
    wave = np.sin(0.05 * np.arange(400.0))
    log = {name: time / seconds, "wheel_pos": wave, "wheel_torque": wave**2}
    table = RawTable("log", log, units={name: stated} if stated else {})
    rules = guess_rules(Model.from_xml(WHEEL), table)
    np.testing.assert_allclose(read(table, rules).channels["qpos.wheel"].time, time)
    assert "time" not in rules.guesses


def test_a_clock_that_only_its_steps_tell_is_said_to_be_one_by_them(tmp_path: Path) -> None:
    """Where the name tells it, nothing of its steps is written."""
    time = 0.01 * np.arange(400.0)
    wave = np.sin(3 * time)
    (tmp_path / "wheel.xml").write_text(WHEEL)
    for name, reason in (("column1", "it alone rises in equal steps"), ("stamp", "")):
        log = pd.DataFrame({name: time, "wheel_pos": wave, "wheel_torque": wave**2})
        log.to_csv(tmp_path / f"{name}.csv", index=False)
        to = tmp_path / f"{name}.yaml"
        text = init(tmp_path / "wheel.xml", [tmp_path / f"{name}.csv"], to).path.read_text()
        (line,) = (x for x in text.splitlines() if x.strip().startswith("time:"))
        assert line.partition("#")[2].endswith(reason)
        assert ("#" in line) == bool(reason)


def test_what_columns_are_called_stays_in_comments(tmp_path: Path) -> None:
    """Lines of their names would be lines of the study."""
    time = 0.01 * np.arange(400.0)
    log = {"time": time, "wheel\npos": np.sin(3 * time), "torque": np.cos(3 * time)}
    log |= {f"x{k}\nsearch: {{budget: 7}}\n#": np.sin(k * time) for k in (5, 6)}
    pd.DataFrame(log).to_parquet(tmp_path / "log.parquet")
    (tmp_path / "wheel.xml").write_text(WHEEL)
    started = init(tmp_path / "wheel.xml", [tmp_path / "log.parquet"], tmp_path / "study.yaml")
    study = Study.load(started.path)
    assert study.recordings.columns["qpos.wheel"].source == "wheel\npos"
    assert study.search.budget == 100
    assert "search: {budget: 7}" in started.path.read_text()  # as a comment


@pytest.mark.parametrize(
    ("low", "high"), [(1000.1, 1000.34), (-0.6180, 1.4142), (-123456.0, 98765.0), (0.5, 0.5)]
)
def test_proposed_limits_hold_what_was_recorded_and_little_more(low: float, high: float) -> None:
    ends = [float(x) for x in _outwards(low, high)]
    assert ends[0] <= low
    assert ends[1] >= high
    assert ends[1] - ends[0] <= 1.03 * (high - low) + 3e-6


def test_a_merged_log_with_empty_cells_is_read_with_its_gaps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Controls at a quarter of the rate, and a sensor at half of it, leave cells empty."""
    by_names = "bo_sysid.starter.init.by_behaviour"  # the motion is not this model's
    monkeypatch.setattr(by_names, lambda model, tables, rules: rules)
    (tmp_path / "wheel.xml").write_text(
        WHEEL.replace("</mujoco>", '<sensor><jointvel name="s" joint="wheel"/></sensor></mujoco>')
    )
    time = 0.01 * np.arange(400)
    log = pd.DataFrame(
        {"time": time, "wheel_pos": np.sin(time), "wheel_torque": np.cos(3 * time),
         "sensor.s": np.cos(time)}
    )  # fmt: skip
    told, half = np.arange(400) % 4 == 0, np.arange(400) % 2 == 0
    log["wheel_torque"] = log["wheel_torque"].where(told)
    log["sensor.s"] = log["sensor.s"].where(half)
    logs = [tmp_path / "log.csv", tmp_path / "held_out.csv"]
    for path in logs:
        log.to_csv(path, index=False)
    started = init(tmp_path / "wheel.xml", logs, tmp_path / "wheel.yaml")
    (recording,) = read_train(Study.load(started.path))
    np.testing.assert_allclose(recording.channels["qpos.wheel"].time, time)
    np.testing.assert_allclose(recording.channels["sensor.s"].time, time[half])
    np.testing.assert_allclose(recording.channels["ctrl.wheel"].values, np.cos(3 * time[told]))
    text = started.path.read_text()
    assert "300 of 400 cells are empty" in text
    assert "sensor.s: {missing: skip}  # sure: the name; 200 of 400 cells are empty" in text


def test_a_log_that_is_named_twice_is_not_held_out_from_itself(tmp_path: Path) -> None:
    (tmp_path / "wheel.xml").write_text(WHEEL)
    (tmp_path / "log.csv").write_text("time,wheel_pos,wheel_torque\n0,0,1\n1,1,1\n2,3,1\n")
    (tmp_path / "logs").mkdir()
    twice = [tmp_path / "log.csv", tmp_path / "logs" / ".." / "log.csv"]
    with pytest.raises(UserError, match=r"log\.csv: named twice"):
        init(tmp_path / "wheel.xml", twice, tmp_path / "wheel.yaml")
    assert not (tmp_path / "wheel.yaml").exists()


def test_logs_before_the_model_are_told_apart_from_it(tmp_path: Path) -> None:
    for name in ("a.csv", "wheel.xml"):
        (tmp_path / name).write_text("")
    with pytest.raises(UserError, match=r"a\.csv: the model comes first.*init \S*wheel\.xml \S*a"):
        init(tmp_path / "a.csv", [tmp_path / "wheel.xml"], tmp_path / "wheel.yaml")


def test_a_clock_of_text_is_named_with_what_could_be_read(tmp_path: Path) -> None:
    rows = [f"12h00m00.{10 * k:03d}s,{np.sin(k)},{np.cos(k)}" for k in range(50)]
    (tmp_path / "log.csv").write_text("\n".join(["time,wheel_pos,wheel_torque", *rows]))
    (table,) = read_tables(tmp_path / "log.csv")
    with pytest.raises(RecordingError, match=r"column 'time' .* text, as '12h00m00.*2024-05-01 12"):
        describe(table)


def test_the_rate_of_a_log_without_a_clock_goes_into_the_study(tmp_path: Path) -> None:
    model = tmp_path / "wheel.xml"
    model.write_text(WHEEL)
    time = np.arange(0.0, 4.0, 0.008)
    log = pd.DataFrame({"wheel_pos": np.sin(time), "wheel_torque": np.cos(time)})
    log.to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(RecordingError, match=r"no column looks like a clock .*: --rate 500"):
        init(model, [tmp_path / "log.csv"], tmp_path / "wheel.yaml")
    with pytest.raises(UserError, match="--rate is -125; it must be a positive number of rows"):
        init(model, [tmp_path / "log.csv"], tmp_path / "wheel.yaml", rate=-125)
    init(model, [tmp_path / "log.csv"], tmp_path / "wheel.yaml", rate=125)
    (recording,) = read_train(Study.load(tmp_path / "wheel.yaml"))
    np.testing.assert_allclose(recording.channels["qpos.wheel"].time[:375], time[:375])
    np.testing.assert_allclose(recording.channels["ctrl.wheel"].values[:375], np.cos(time[:375]))


def test_a_log_of_one_row_is_refused_without_warnings(tmp_path: Path) -> None:
    """Warnings are errors here."""
    (tmp_path / "wheel.xml").write_text(WHEEL)
    (tmp_path / "log.csv").write_text("time,qpos.wheel,qvel.wheel,ctrl.wheel\n0,0.1,0.2,0.3\n")
    with pytest.raises(RecordingError, match="at least 2 are needed"):
        init(tmp_path / "wheel.xml", [tmp_path / "log.csv"], tmp_path / "wheel.yaml")


@pytest.mark.parametrize(
    ("called", "ends", "unit"),
    [("vbus", 18.0, "V"), ("battery_mV", 18e3, "mV"), ("vbus", -1.0, ""), ("temp", 18.0, "")],
)
def test_a_column_that_is_called_like_a_supply_is_its_voltage(
    called: str, ends: float, unit: str
) -> None:
    """Unless it is no voltage of one; a supply that sags takes torque, which nothing else tells."""
    time = 0.01 * np.arange(400.0)
    wave, volts = np.sin(time), np.linspace(abs(ends) * 4 / 3, ends, 400)
    table = RawTable(
        "log", {"time": time, "wheel_pos": wave, "wheel_torque": wave**2, called: volts}
    )
    rules = with_supply([table], guess_rules(Model.from_xml(WHEEL), table))
    assert ("aux.voltage" in rules.columns) is bool(unit)
    assert (called in rules.unused) is not bool(unit)
    if unit:
        shown = read(table, rules).channels["aux.voltage"]
        assert shown.unit == "V"
        assert (shown.values[-1], shown.hold) == (pytest.approx(18.0), "zero")


def test_a_clock_that_never_rises_is_named() -> None:
    table = RawTable("log", {"stamp": np.full(50, 7.0), "wheel_pos": np.sin(np.arange(50.0))})
    with pytest.raises(RecordingError, match="'stamp' is called like one and never rises"):
        describe(table)
