"""`init`: the units, rates and clocks of columns."""

from dataclasses import replace
from math import pi
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
from starter_logs import BOOM, HAND, TIMES, WAVE, WHEEL, held_up, tones

from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.simulation import Engine, State
from bo_sysid.starter import columns as starter_columns
from bo_sysid.starter.columns import derivatives, describe
from bo_sysid.starter.guess import guess_rules, read
from bo_sysid.starter.init import init
from bo_sysid.starter.reading import clock_rule
from bo_sysid.study import Study


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
    ("column", "factor"),
    [
        ("i [mA]", 1e-3),
        ("tau_mNm", 1e-3),
        ("i [A]", 1.0),
        ("cmd_front_gf", 9.80665e-3),
        ("valve_pct", 0.01),
    ],
)
def test_a_control_is_read_in_the_unit_that_its_column_carries(column: str, factor: float) -> None:
    table = RawTable("log", {"t [ms]": 1e-3 * TIMES, "angle [deg]": 30 * WAVE, column: 50 * WAVE})
    rules = guess_rules(Model.from_xml(WHEEL.format(limits="")), table)
    channels = read(table, rules).channels
    np.testing.assert_allclose(channels["ctrl.wheel"].values, 50 * factor * WAVE)
    np.testing.assert_allclose(channels["qpos.wheel"].values, np.deg2rad(30 * WAVE))
    np.testing.assert_allclose(channels["qpos.wheel"].time, 1e-6 * TIMES)


def test_percent_stay_where_the_model_takes_percent() -> None:
    table = RawTable("log", {"time": TIMES, "angle": WAVE, "valve_pct": 98 * WAVE})
    for bound, factor in ((1, 0.01), (100, 1.0)):
        wheel = WHEEL.format(limits="").replace("<motor ", f'<motor ctrlrange="-{bound} {bound}" ')
        rules = guess_rules(Model.from_xml(wheel), table)
        control = read(table, rules).channels["ctrl.wheel"]
        np.testing.assert_allclose(control.values, 98 * factor * WAVE)


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


def test_a_current_whose_constant_friction_hides_lacks_its_scale(tmp_path: Path) -> None:
    """Whatever one ampere gives, a rotor and friction that the model lacks explain the motion."""
    model = """<mujoco><option timestep=".002"/><worldbody><body><joint name="rail" type="slide"
        axis="1 0 0" damping="{}"/><geom size=".02" mass=".2"/></body></worldbody>
        <actuator><motor name="drive" joint="rail"/></actuator></mujoco>"""
    (tmp_path / "rail.xml").write_text(model.format(1))
    time = np.arange(0.0, 8.0, 0.01)
    force = 1.5 * np.sign(tones(time, 3))
    compiled = mujoco.MjModel.from_xml_string(model.format(20))
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    run = Engine(1).rollout(compiled, start, np.repeat(force, 5)[None, :, None])
    place = run.qpos[0, :-1:5, 0] + 1e-5 * np.random.default_rng(0).standard_normal(len(time))
    log = tmp_path / "log.csv"
    pd.DataFrame({"time": time, "rail_mm": 1e3 * place, "i_drive_mA": force / 0.05 * 1e3}).to_csv(
        log, index=False
    )
    guess = init(tmp_path / "rail.xml", [log], tmp_path / "rail.yaml").rules.guesses["ctrl.drive"]
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


def test_the_clock_is_the_column_that_is_called_time_or_never_falls() -> None:
    time = np.arange(200) * 0.01
    loop = 0.001 + 1e-5 * np.sin(7 * time)
    for name in ("time", "stamp_time"):
        table = RawTable("log", {"loop_time": loop, name: time})
        columns = [replace(c, kind="time") for c in describe(table)]
        assert clock_rule(table, columns)[0].get("from", "time") == name
