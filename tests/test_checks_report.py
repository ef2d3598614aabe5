"""Motion, channels, wraps, proposals, sensitivities, and the whole check of a study."""

import subprocess
import sys
from dataclasses import replace
from math import pi
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest
import yaml

from bo_sysid.checks.channels import (
    channel_flags,
    coarse_flags,
    sampling_flags,
    shared_flags,
    slow_flags,
)
from bo_sysid.checks.check import check
from bo_sysid.checks.flags import Flag
from bo_sysid.checks.hypothesis import Wire
from bo_sysid.checks.motion import excitation, excitation_flags, range_flags
from bo_sysid.checks.numerics import contact_flags, divergence_flags, far_flags, step_effect
from bo_sysid.checks.proposal import as_yaml, proposed_clocks, proposed_columns
from bo_sysid.checks.rewired import rewired
from bo_sysid.checks.search import SUSPICIOUS
from bo_sysid.checks.sensitivity import (
    Information,
    bounds_flags,
    in_words,
    information,
    with_fitted_starts,
)
from bo_sysid.checks.wiring import find_wiring
from bo_sysid.checks.wraps import find_wraps, unwrapped, wrap_flags
from bo_sysid.cli.check import write
from bo_sysid.effects import Site, survey
from bo_sysid.effects.beside import Beside, Placed
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Channel, RawTable, Recording
from bo_sysid.recording.mapping import to_recording
from bo_sysid.report.check_text import checked_text
from bo_sysid.simulation import Engine, MujocoSimulator, State, cut
from bo_sysid.study import Study

TIME = np.arange(0.0, 8.0, 0.01)
SLIDE = """
<mujoco><option timestep="0.005" gravity="0 0 0"/>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom name="load" size=".1" mass="2"/>
  </body></worldbody>
  <actuator><motor name="m" joint="x" ctrlrange="-1 1"/></actuator></mujoco>
"""
PENDULUM = """
<mujoco><option timestep="0.005"/>
  <worldbody><body><joint name="a" axis="0 1 0" range="-1.5 1.5"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body></worldbody>
  <actuator><motor name="m" joint="a" ctrlrange="-1 1"/></actuator></mujoco>
"""


def test_how_a_joint_moved() -> None:
    log = Recording.from_arrays(TIME, qpos={"a": np.sin(2 * pi * TIME), "b": 1e-4 * TIME**0})
    still = Recording.from_arrays(
        TIME, qpos={"b": 1e-4 * np.random.default_rng(0).standard_normal(len(TIME))}
    )
    model = Model.from_xml(SLIDE.replace('"x"', '"b"')).compile()
    table = excitation([log], Model.from_xml(PENDULUM).compile())
    assert table["range"].iloc[0] == pytest.approx(2.0, rel=1e-3)
    assert table["speed"].iloc[0] == pytest.approx(2 * pi / np.sqrt(2), rel=0.02)
    assert table["reversals"].iloc[0] in (15, 16)
    assert table["low_hz"].iloc[0] <= 1.0 <= table["high_hz"].iloc[0]
    assert table["unit"].iloc[0] == "rad"
    (flag,) = excitation_flags(excitation([still], model))
    assert "mm: nothing can be said about it" in flag.sentence


def test_absurd_values_are_flagged_and_warn_of_nothing(tmp_path: Path) -> None:
    """As a decimal point that was lost, squares of which no float holds."""
    model = Model.from_xml(SLIDE).compile()
    log = Recording.from_arrays(TIME, qpos={"x": 1e200 * np.sin(2 * pi * TIME)})
    table = excitation([log], model)
    assert table["range"].iloc[0] == pytest.approx(2e200, rel=1e-3)
    assert table["fastest"].iloc[0] == pytest.approx(2 * pi * 1e200, rel=1e-2)
    (tmp_path / "slide.xml").write_text(SLIDE)
    pd.DataFrame(
        {"time": TIME, "qpos.x": log.channels["qpos.x"].values, "ctrl.m": np.sin(TIME)}
    ).to_csv(tmp_path / "log.csv", index=False)
    data = {"model": "slide.xml", "recordings": {"train": "log.csv"}}
    assert ("x",) in [f.channels for f in check(Study.from_dict(data, tmp_path)).flags]


def test_a_joint_may_turn_back_in_another_recording() -> None:
    model = Model.from_xml(SLIDE).compile()
    noise = 1e-4 * np.random.default_rng(0).standard_normal(len(TIME))
    out, back = (Recording.from_arrays(TIME, qpos={"x": s * TIME + noise}) for s in (1, -1))
    still = Recording.from_arrays(TIME, qpos={"x": noise})
    assert excitation_flags(excitation([out, back], model)) == []
    for logs in ([out], [out, out], [out, still]):
        (flag,) = excitation_flags(excitation(logs, model))
        assert "never turns back" in flag.sentence


@pytest.mark.parametrize("noise", [1e-4, 2e-3, 1e-2])
def test_speeds_are_those_of_the_joint_and_not_of_its_noise(noise: float) -> None:
    """At 500 Hz noise of .6 degrees made 2.6 rad/s of a joint that moved by 1.26."""
    time = np.arange(0.0, 10.0, 0.002)
    angle = 0.4 * np.sin(2 * pi * 0.5 * time)
    shown = angle + noise * np.random.default_rng(0).standard_normal(len(time))
    log = Recording.from_arrays(time, qpos={"a": shown})
    (row,) = excitation([log], Model.from_xml(PENDULUM).compile()).to_dict("records")
    assert row["speed"] == pytest.approx(0.4 * pi / np.sqrt(2), rel=0.05)
    assert row["fastest"] == pytest.approx(0.4 * pi, rel=0.2)


def test_a_short_log_is_looked_at_or_refused() -> None:
    model, fast = Model.from_xml(SLIDE).compile(), 0.001 * np.arange(8)  # less than the filter
    (speed,) = excitation([Recording.from_arrays(fast, qpos={"x": 3 * fast})], model)["speed"]
    assert speed == pytest.approx(3.0)
    short = Recording.from_arrays(TIME[:5], name="short", qpos={"x": TIME[:5]})
    with pytest.raises(RecordingError, match=r"short: 5 samples of qpos.x .* at least 6 are need"):
        excitation([short], model)


@pytest.mark.parametrize(("angle", "flagged"), [("degree", True), ("radian", False)])
def test_a_range_in_the_wrong_unit_is_named_and_disturbs_nothing(angle: str, flagged: bool) -> None:
    compiler = f'<compiler angle="{angle}"/>'
    model = Model.from_xml(PENDULUM.replace("<worldbody>", compiler + "<worldbody>"))
    plant = Model.from_xml(PENDULUM.replace("<worldbody>", '<compiler angle="radian"/><worldbody>'))
    compiled = plant.compile()
    data, q, u = mujoco.MjData(compiled), [], 0.6 * np.sin(2.1 * TIME) * np.sin(0.9 * TIME)
    for now in u:
        q.append(data.qpos[0])
        data.ctrl[:] = now
        mujoco.mj_step(compiled, data, 2)
    log = Recording.from_arrays(TIME, qpos={"a": np.array(q)}, ctrl={"m": u})
    wiring = find_wiring(model.compile(), [log])
    assert wiring.wires == {}
    flags = range_flags(model.compile(), [log])
    assert bool(flags) is flagged
    assert all('<compiler angle="radian"/>' in f.sentence for f in flags)


def test_saturated_and_frozen_channels() -> None:
    q = np.sin(3 * TIME)
    q[300:400] = q[300]
    u = np.clip(2 * np.sin(3 * TIME), -1.2, 1.2)
    log = Recording.from_arrays(TIME, qpos={"x": q}, ctrl={"m": u})
    flags = channel_flags(Model.from_xml(SLIDE).compile(), [log])
    assert sorted(f.kind for f in flags) == ["frozen", "saturation", "saturation", "saturation"]
    frozen = next(f for f in flags if f.kind == "frozen")
    assert frozen.evidence["seconds"] == pytest.approx(0.99)
    assert any("leaves the model's control range" in f.sentence for f in flags)
    assert sum(f.sentence.endswith("the drive saturates there.") for f in flags) == 2
    short = Recording.from_arrays(TIME[:30], qpos={"x": q[:30]}, ctrl={"m": np.sin(3 * TIME[:30])})
    assert channel_flags(Model.from_xml(SLIDE).compile(), [short]) == []  # one is the largest
    steady = Recording.from_arrays(TIME, qpos={"x": np.round(np.sin(TIME), 2)}, ctrl={"m": q})
    assert channel_flags(Model.from_xml(SLIDE).compile(), [steady]) == []


def test_a_command_of_steps_saturates_only_where_it_was_cut_off() -> None:
    """Each of 32 steps lasts 3 % of the time, the largest as well."""
    steps = np.repeat(np.random.default_rng(3).uniform(-1.0, 1.0, 32), 25)
    kinds = []
    for u in (steps, np.clip(steps, -0.6, 0.6)):
        log = Recording.from_arrays(TIME, qpos={"x": np.sin(TIME)}, ctrl={"m": u})
        flags = channel_flags(Model.from_xml(SLIDE).compile(), [log])
        kinds.append([f.kind for f in flags])
    assert kinds == [[], ["saturation", "saturation"]]
    assert all(f.sentence.endswith("saturates there, or a motion rests there.") for f in flags)


def test_clocks_that_lose_samples() -> None:
    keep = np.ones(len(TIME), bool)
    keep[100:130] = False
    (flag,) = sampling_flags([Recording.from_arrays(TIME[keep], qpos={"x": TIME[keep]})])
    assert "about 30 samples lost" in flag.sentence


def test_clocks_that_are_coarser_than_their_rows() -> None:
    fine = RawTable("log", {"time": np.floor(TIME / 0.04 + 1e-9) * 0.04, "qpos.x": TIME})
    (flag,) = coarse_flags([to_recording(fine, name="a")])
    assert (flag.level, flag.channels) == ("look", ("a",))
    assert "a: Coarse clock 'time': " in flag.sentence


def test_motors_on_one_column_beside_one_that_is_not_used() -> None:
    table = RawTable("log", {"time": TIME, "qpos.x": TIME, "u1": TIME, "u2": -TIME})
    rules = {"ctrl.a": "u1", "ctrl.b": "u1"}
    log = to_recording(table, rules, name="log")
    (flag,) = shared_flags([log, log])
    assert flag.channels == ("ctrl.a", "ctrl.b")
    assert "ctrl.a and ctrl.b are read from one column (log: u1), and u2 is not" in flag.sentence
    assert shared_flags([to_recording(table, {**rules, "aux.x": "u2"}, name="log")]) == []
    assert shared_flags([to_recording(table, {**rules, "ctrl.b": "u2"}, name="log")]) == []


def test_motions_that_are_sampled_rarely_may_have_another_unit_of_time() -> None:
    """A sensor may be slow: a temperature is."""
    slow = Recording.from_arrays(25 * TIME, name="b", qpos={"x": TIME}, sensor={"warm": TIME})
    (flag,) = slow_flags([Recording.from_arrays(TIME, name="a", qpos={"x": TIME}), slow])
    assert flag.channels == ("b",)
    assert "every 0.25 s in b," in flag.sentence
    assert "unit: us" in flag.sentence
    warm = {n.replace("qpos", "sensor"): c for n, c in slow.channels.items()}
    assert slow_flags([Recording("c", warm)]) == []
    fast = Recording.from_arrays(10 * TIME, name="b", qpos={"x": TIME})
    assert slow_flags([fast]) == []
    assert [f.channels for f in slow_flags([slow, fast])] == [("b",)]  # of one name


def test_bounds_that_leave_out_the_model_as_it_is() -> None:
    names = ("mass", "gain", "damping")
    mass, gain, damping = (Parameter(n, (f"geom[a].{n}",), 1.0, 3.0) for n in names)
    (flag,) = bounds_flags([mass, gain, damping], np.array([0.5, 1.0, 3.25]))
    assert flag.channels == ("mass", "damping")
    assert "mass (0.5, and not 1 to 3) and damping (3.25, and not 1 to 3)" in flag.sentence
    assert bounds_flags([mass, gain], np.array([1.0, 3.0])) == []


@pytest.mark.parametrize(
    ("period", "joint"), [(2 * pi, "x"), (360.0, "x"), (4096.0, "x"), (2 * pi, "1")]
)
def test_an_angle_that_wraps(period: float, joint: str) -> None:
    true, name = period * (0.3 * TIME + 0.1 * np.sin(TIME)), f"qpos.{joint}"
    log = Recording.from_arrays(TIME, qpos={joint: true % period})
    wraps = find_wraps([log])
    assert wraps[name].period == pytest.approx(period)
    (right,) = unwrapped([log], wraps)
    assert np.ptp(right.channels[name].values - true) == pytest.approx(0.0, abs=1e-9 * period)
    assert find_wraps([Recording.from_arrays(TIME, qpos={"x": np.sin(TIME)})]) == {}


def test_what_is_corrected_remembers_when_its_log_began() -> None:
    log = Recording.from_arrays(TIME, qpos={"x": 2 * TIME % 2}).between(4.0, 6.0)
    whole = unwrapped([log], find_wraps([log]))
    (right,) = rewired(whole, {"qpos.x": Wire("qpos.x", -1)}, 0.0, "ctrl")
    assert right.channels["qpos.x"].values[0] == -whole[0].channels["qpos.x"].values[0]
    assert [r.origin for r in (*whole, right)] == [0.0, 0.0]


@pytest.mark.parametrize("turn", [1.0, 2 * pi])
def test_a_drop_out_is_no_wrap(turn: float) -> None:
    """While nothing is recorded for 0.1 s, the joint moves by as much as a turn."""
    lost = (TIME > 3.995) & (TIME < 4.095)
    true = 0.2 * np.sin(TIME) + turn * np.clip((TIME - 3.99) / 0.11, 0.0, 1.0)
    log = Recording.from_arrays(TIME[~lost], qpos={"x": true[~lost]})
    assert np.abs(np.diff(log.channels["qpos.x"].values)).max() == pytest.approx(turn, rel=0.1)
    assert find_wraps([log]) == {}


def test_a_turn_that_wraps_beside_a_drop_out_is_found() -> None:
    lost = (TIME > 3.6) & (TIME < 3.9)  # between wraps, 0.6 of a turn
    true = 2.0 * TIME
    log = Recording.from_arrays(TIME[~lost], qpos={"x": (true % 1.0)[~lost]})
    wrap = find_wraps([log])["qpos.x"]
    assert wrap.period == 1.0
    assert wrap.jumps == 15


def test_signs_of_a_quaternion_and_a_gripper_do_not_wrap() -> None:
    q = np.column_stack([np.full_like(TIME, 0.5) + 1e-3 * np.sin(k + TIME) for k in range(4)])
    q[(TIME > 2) & (TIME < 5)] *= -1  # the same attitude
    flips = {f"qpos.root.{3 + k}": Channel(TIME, q[:, k]) for k in range(4)}
    grip = Channel(TIME, np.floor(TIME) % 2)
    log = Recording("log", {**flips, "qpos.grip": grip})
    assert find_wraps([log]) == {}


def test_one_knock_by_one_is_no_wrap() -> None:
    true = 0.2 * np.sin(TIME) + (TIME >= 4.0)
    assert find_wraps([Recording.from_arrays(TIME, qpos={"x": true})]) == {}
    whole = Recording.from_arrays(TIME, qpos={"x": (0.5 * TIME) % 1.0})
    assert find_wraps([whole])["qpos.x"].jumps == 3


@pytest.mark.parametrize(("unit", "fits"), [("m", True), ("", True), ("rad", False)])
def test_an_angle_on_a_slide_is_refused(unit: str, fits: bool) -> None:
    ctrl = {"m": np.zeros(len(TIME))}
    units = {"qpos.x": unit} if unit else {}
    log = Recording.from_arrays(TIME, qpos={"x": np.sin(TIME)}, ctrl=ctrl, units=units)
    model = Model.from_xml(SLIDE)
    if fits:
        assert len(cut(model, [log], horizon=10))
    else:
        with pytest.raises(RecordingError, match=r"qpos.x was read in rad, but the joint slides"):
            cut(model, [log], horizon=10)


def test_a_register_that_was_read_without_its_sign() -> None:
    duty = np.rint(400 * np.sin(5 * TIME))
    log = Recording.from_arrays(TIME, ctrl={"m": duty % 2**16}, qpos={"x": TIME})
    wraps = find_wraps([log])
    assert {n: w.signed for n, w in wraps.items()} == {"ctrl.m": 16}
    (right,) = unwrapped([log], wraps)
    np.testing.assert_array_equal(right.channels["ctrl.m"].values, duty)
    assert proposed_columns({"ctrl.m": {"from": "load"}}, {}, wraps) == {
        "ctrl.m": {"from": "load", "signed": 16}
    }
    (flag,) = wrap_flags(wraps)
    assert "a register of 16 bits that was read without its sign" in flag.sentence
    for plain in (np.abs(duty), duty, np.linspace(0, 65535, len(TIME)).round()):
        assert find_wraps([Recording.from_arrays(TIME, ctrl={"m": plain})]) == {}


def test_a_proposal_continues_the_rules_that_are_there() -> None:
    written = {"qpos.a": {"from": "theta", "unit": "deg", "offset": 0.1}, "qpos.b": {"from": "phi"}}
    wires = {
        "qpos.a": Wire("qpos.b", scale=pi / 180, unit="deg"),
        "qpos.b": Wire("qpos.a", sign=-1, offset=0.3),
        "ctrl.m": Wire("ctrl.m", scale=1 / 255, unit="PWM"),
    }
    columns = proposed_columns(written, wires, {})
    assert columns["qpos.a"] == {"from": "phi", "unit": "deg"}
    assert columns["qpos.b"] == {"from": "theta", "unit": "deg", "sign": -1, "offset": 0.2}
    assert columns["ctrl.m"] == {"scale": pytest.approx(1 / 255, rel=1e-5)}
    clocks = proposed_clocks({"ctrl": {"shift": 0.01}}, "ctrl", -0.004)
    assert proposed_clocks({"ctrl": {"shift": 0.0348}}, "ctrl", -0.0349) == {"ctrl": {"shift": 0}}
    text = as_yaml(columns, clocks)
    assert yaml.safe_load(text) == {"columns": columns, "clocks": {"ctrl": {"shift": 0.006}}}


def test_a_proposal_has_no_keys_at_their_defaults() -> None:
    """As a resolved study has them, with all that was left out in it."""
    data = {
        "model": str(ARM),
        "recordings": {
            "train": "log.csv",
            "columns": {"qpos.a": "theta", "ctrl.m": {"from": "i", "missing": "skip"}},
            "clocks": {"ctrl": {"shift": 0.001}},
        },
    }
    written = Study.from_dict(data, Path()).resolved()["recordings"]
    wires = {n: Wire(n, sign=-1) for n in ("qpos.a", "ctrl.m")}
    assert proposed_columns(written["columns"], wires, {}) == {
        "qpos.a": {"from": "theta", "sign": -1},
        "ctrl.m": {"from": "i", "missing": "skip", "sign": -1},
    }
    assert proposed_clocks(written["clocks"], "ctrl", 0.004) == {"ctrl": {"shift": 0.005}}


@pytest.mark.parametrize("written", [{}, {"qpos": {"shift": 0.1}}])
def test_controls_that_change_between_samples_get_no_shift(written: dict[str, Any]) -> None:
    assert proposed_clocks(written, "ctrl", -0.003, linear=True) == {"ctrl": {"hold": "linear"}}


@pytest.mark.parametrize("own", [{"shift": 0.001}, {"hold": "zero"}])
def test_what_a_study_says_of_its_controls_is_kept(own: dict[str, Any]) -> None:
    (rule,) = proposed_clocks({"ctrl": own}, "ctrl", -0.003, linear=True).values()
    assert rule == {**own, "shift": pytest.approx(own.get("shift", 0.0) - 0.003)}


def test_a_delay_is_proposed_for_controls_with_a_clock_of_their_own_too() -> None:
    written = {"ctrl.a": {"from": "t_a", "shift": 0.01}, "qpos": {"shift": 0.1}}
    assert proposed_clocks(written, "ctrl", 0.02) == {
        "ctrl": {"shift": 0.02},
        "ctrl.a": {"from": "t_a", "shift": 0.03},
    }


def test_a_proposal_states_a_unit_in_place_of_the_wrong_one() -> None:
    """A wire's scale is beside the unit of the rule, which the proposal may replace."""
    data = {
        "model": str(ARM),
        "recordings": {"train": "log.csv", "columns": {"qpos.a": {"unit": "rad"}, "qpos.b": "b"}},
    }
    written = Study.from_dict(data, Path()).resolved()["recordings"]["columns"]
    wires = {n: Wire(n, scale=pi / 180, unit="deg") for n in ("qpos.a", "qpos.b")}
    assert proposed_columns(written, wires, {}) == {
        "qpos.a": {"unit": "deg"},
        "qpos.b": {"from": "b", "unit": "deg"},
    }
    ticks = {"qpos.a": Wire("qpos.a", scale=0.1, unit="ticks")}
    assert proposed_columns({"qpos.a": {"unit": "deg"}}, ticks, {}) == {
        "qpos.a": {"unit": "ticks", "scale": pytest.approx(0.1 * pi / 180, rel=1e-5)}
    }


def test_a_proposal_is_as_exact_as_what_was_found_however_large_what_is_written() -> None:
    """Clocks that began a day apart, and an encoder of many turns, keep all of their digits."""
    shifts = proposed_clocks({"ctrl": {"shift": 86412.345}}, "ctrl", 0.012345)
    assert shifts["ctrl"]["shift"] == pytest.approx(86412.345 + 0.0123, abs=1e-9)
    wires = {"qpos.a": Wire("qpos.a", sign=-1, offset=0.0213456)}
    columns = proposed_columns({"qpos.a": {"offset": 200 * pi}}, wires, {})
    assert columns["qpos.a"]["offset"] == pytest.approx(-200 * pi + 0.02135, abs=1e-9)


def test_a_proposal_keeps_the_size_of_a_jump() -> None:
    written = {"qpos.a": {"from": "theta", "unwrap": 4.096}, "qpos.b": {"unwrap": True}}
    wires = {
        "qpos.a": Wire("qpos.a", sign=-1),
        "qpos.b": Wire("qpos.b", sign=-1),
    }
    columns = proposed_columns(written, wires, {})
    assert columns["qpos.a"] == {"from": "theta", "sign": -1, "unwrap": 4.096}
    assert columns["qpos.b"] == {"sign": -1, "unwrap": True}
    scaled = proposed_columns(written, {"qpos.a": Wire("qpos.a", scale=1e-3, unit="mm")}, {})
    assert scaled["qpos.a"] == {"from": "theta", "unit": "mm", "unwrap": 4.096e-3}


def test_information_about_a_mass_is_that_of_the_formula() -> None:
    """x = x0 + v0 t + F t²/(2 m): what is left of t² without 1 and t tells the mass."""
    model = Model.from_xml(SLIDE)
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    run = Engine(1).rollout(model.compile(), start, np.full((1, 200, 1), 0.8))
    time = 0.005 * np.arange(201)
    log = Recording.from_arrays(time, qpos={"x": run.qpos[0, :, 0]}, ctrl={"m": np.full(201, 0.8)})
    windows = cut(model, [log], horizon=200)
    mass = Parameter("mass", ("geom[load].mass",), 1.0, 3.0)
    simulator = MujocoSimulator(model, (mass,), Engine(1))
    found = information(simulator, np.array([2.0]), windows, {"qpos.x": 1e-3})
    t = time[1:]
    slope = -0.8 * t**2 / (2 * 2.0**2)
    known = np.stack([np.ones_like(t), t], axis=1)
    rest = slope - known @ np.linalg.lstsq(known, slope, rcond=None)[0]
    assert found.fisher[0, 0] == pytest.approx(4.0 * rest @ rest / 1e-6, rel=0.02)


@pytest.mark.parametrize("gear", [0.4, 999.6, 500.0])
def test_a_step_with_fitted_starts_from_the_truth_stays_there_also_beside_a_bound(gear):
    """The prediction is linear in the gear: one step arrives, from wherever it begins."""
    model = Model.from_xml(SLIDE.replace('joint="x"', f'joint="x" gear="{gear}"'))
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    push = 0.8 * np.sin(3 * TIME[:400])
    run = Engine(1).rollout(model.compile(), start, push[None, :399, None])
    log = Recording.from_arrays(
        0.005 * np.arange(400), qpos={"x": run.qpos[0, :, 0]}, ctrl={"m": push}
    )
    windows = cut(model, [log], horizon=100)
    simulator = MujocoSimulator(
        model, (Parameter("gear", ("actuator[m].gear[0]",), 0.0, 1e3),), Engine(1)
    )
    found, sigma = with_fitted_starts(simulator, np.array([gear]), windows, {"qpos.x": 1e-7})
    assert sigma[0] < 1e-3
    assert found[0] == pytest.approx(gear, abs=1e-3)


class _Losing(MujocoSimulator):
    """Diverges in all windows but the first five."""

    def predictions(self, points, windows, starts=None):
        late = np.arange(len(windows)) >= 5
        for found in super().predictions(points, windows, starts):
            yield replace(found, diverged=late)


@pytest.mark.parametrize(("simulates", "used"), [(MujocoSimulator, 50), (_Losing, 5)])
def test_what_fitted_starts_leave_is_judged_by_the_numbers_that_were_fitted(simulates, used):
    """x = x0 + v0 t + F t²/(2 m) in each window: σ is that of the regression on all of them.

    A joint that follows another has no start of its own, nor has a window that diverges.
    """
    follower = """<body><joint name="y" type="slide" axis="1 0 0"/><geom size=".1" mass=".5"/>
      </body></worldbody><equality><joint joint1="y" joint2="x"/></equality>"""
    strong = SLIDE.replace('joint="x"', 'joint="x" gear="1000"')
    model = Model.from_xml(strong.replace("</worldbody>", follower))
    time, t, force = 0.005 * np.arange(601), 0.005 * np.arange(1, 13), 800.0
    x = force * time**2 / (2 * 2.5) + 0.005 * np.random.default_rng(3).standard_normal(601)
    log = Recording.from_arrays(time, qpos={"x": x, "y": x}, ctrl={"m": np.full(601, 0.8)})
    windows = cut(model, [log], horizon=12)
    mass = Parameter("mass", ("geom[load].mass",), 1.0, 3.0)
    simulator = simulates(model, (mass,), Engine(1))
    assert len(windows) == 50
    assert len(simulator.following) == 1
    _, sigma = with_fitted_starts(simulator, np.array([2.0]), windows, {"qpos.x": 1e-3})
    known = np.stack([np.ones_like(t), t, -force * t**2 / (2 * 2.5**2)], axis=1)
    rows = x[1:].reshape(50, 12)[:used] - force * t**2 / (2 * 2.5)
    starts = np.kron(np.eye(used), known[:, :2])
    columns = np.column_stack([starts, np.tile(known[:, 2], used)])
    left = np.linalg.lstsq(columns, rows.ravel(), rcond=None)[1][0]
    variance = left / (columns.shape[0] - columns.shape[1])
    expected = np.sqrt(variance * np.linalg.inv(columns.T @ columns)[-1, -1])
    assert sigma[0] == pytest.approx(expected, rel=0.04)


def test_weak_combinations_are_put_into_words() -> None:
    parameters = tuple(Parameter(n, ("joint[x].damping",), 0.0, 1.0) for n in "abc")
    both = np.array([1.0, 1.0, 0.0])
    fisher = 1e6 * np.outer(both, both) + 1e6 * np.diag([0.0, 0.0, 1.0])
    found = Information(parameters, fisher)
    ((sigma, names),) = found.weakest()
    assert sigma == pytest.approx(12**-0.5)
    assert in_words(names) in ("a rising while b falls", "b rising while a falls")
    assert found.table()["determined"].tolist() == ["weakly", "weakly", "yes"]


@pytest.mark.parametrize("count", [2, 16, 20])
def test_a_combination_of_many_parameters_names_them_all(count: int) -> None:
    """As mass, stiffness, damping and drive that scale alike: each has 1/√count of it."""
    names = [f"p{k}" for k in range(count)]
    parameters = tuple(Parameter(n, ("joint[x].damping",), 0.0, 1.0) for n in names)
    fisher = 1e6 * (np.eye(count) - np.ones((count, count)) / count)
    ((sigma, shares),) = Information(parameters, fisher).weakest()
    assert sigma == pytest.approx(12**-0.5)
    assert shares == pytest.approx(dict.fromkeys(names, count**-0.5))
    assert in_words(shares) == f"{', '.join(names[:-1])} and {names[-1]} rising together"


@pytest.mark.parametrize(("told", "verdict"), [(0.0, "not"), (1e-3, "not"), (10.0, "weakly")])
def test_a_parameter_of_which_nothing_is_told_is_not_determined(told: float, verdict: str) -> None:
    parameter = Parameter("a", ("joint[x].damping",), 0.0, 1.0)
    table = Information((parameter,), np.array([[told]])).table()
    assert table["of_range"].iloc[0] == pytest.approx((12 + told) ** -0.5)
    assert table["determined"].tolist() == [verdict]


ARM = Path(__file__).parent.parent / "studies" / "diagnosis" / "two_link_arm.xml"


def test_the_proposal_of_a_check_makes_the_next_one_clean(tmp_path: Path) -> None:
    model = Model.from_file(ARM)
    time = np.arange(0.0, 10.0, 0.004)
    rng = np.random.default_rng(4)
    tones = [
        sum(np.sin(2 * pi * f * time + p) for f, p in rng.uniform(0.2, 2, (5, 2))) for _ in "ab"
    ]
    ctrl = np.stack([0.7 * tones[0], 0.3 * tones[1]], axis=1)
    start = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    run = Engine(1).rollout(model.compile(), start, np.repeat(ctrl, 2, axis=0)[None])
    qpos = run.qpos[0, :-1:2] + 1e-4 * rng.standard_normal((len(time), 2))
    frame = pd.DataFrame(
        {
            "time": time, "qpos.shoulder": -qpos[:, 0], "qpos.elbow": qpos[:, 1],
            "time.ctrl": time - 0.03, "ctrl.shoulder": ctrl[:, 0], "ctrl.elbow": ctrl[:, 1],
        }
    )  # fmt: skip
    frame.to_csv(tmp_path / "log.csv", index=False)
    data = {
        "model": str(ARM),
        "recordings": {"train": "log.csv"},
        "parameters": [{"address": "geom[forearm].mass", "low": 0.4, "high": 0.8}],
    }
    found = check(Study.from_dict(data, tmp_path))
    assert {f.kind for f in found.flags if f.level == "wrong"} == {"sign", "clock"}
    data["recordings"] |= yaml.safe_load(found.proposal)
    again = check(Study.from_dict(data, tmp_path))
    assert again.proposal == ""
    assert [f for f in again.flags if f.level == "wrong"] == []
    assert again.parameters["determined"].tolist() == ["yes"]


@pytest.mark.parametrize(("stiffness", "explained"), [(20.0, False), (0.0, True)])
def test_forces_that_are_not_explained_are_said(
    tmp_path: Path, stiffness: float, explained: bool
) -> None:
    """A spring that the model lacks takes a part of what the motor gives."""
    plant = SLIDE.replace('axis="1 0 0"', f'axis="1 0 0" stiffness="{stiffness}"')
    ctrl = sum(np.sin(w * TIME + p) for w, p in ((4.0, 0.0), (6.5, 1.0), (9.0, 2.0)))
    rest = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    run = Engine(1).rollout(
        Model.from_xml(plant).compile(), rest, np.repeat(ctrl, 2)[None, :, None]
    )
    q = run.qpos[0, :-1:2, 0] + 1e-5 * np.random.default_rng(0).standard_normal(len(TIME))
    log = Recording.from_arrays(TIME, qpos={"x": q}, ctrl={"m": ctrl})
    log.to_frame().to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "slide.xml").write_text(SLIDE)
    found = check(
        Study.from_dict({"model": "slide.xml", "recordings": {"train": "log.csv"}}, tmp_path)
    )
    told = found.summary.channels.set_index("channel")["unit"]
    assert (told["qpos.x"], told["ctrl.m"]) == ("m", "N")  # the log states none
    text = checked_text(found)
    share = float(found.wiring.balance["after"][0])
    assert found.proposal == ""
    assert (share <= SUSPICIOUS) == explained
    assert ("nothing to correct" in text) == explained
    assert (f"{100 * share:.0f} % of the forces at x are not explained" in text) == (not explained)


@pytest.mark.parametrize(
    ("model", "told"),
    [
        ({"file": "slide.xml", "unrecorded": {"x": None}}, "log: no position was recorded"),
        ("slide.xml", r"did you mean 'qvel.x'\? To hold the joint still instead: model"),
    ],
)
def test_a_log_without_positions_is_refused(tmp_path: Path, model: object, told: str) -> None:
    speeds = Recording.from_arrays(TIME, qvel={"x": np.cos(TIME)}, ctrl={"m": np.sin(TIME)})
    speeds.to_frame().to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "slide.xml").write_text(SLIDE)
    study = Study.from_dict({"model": model, "recordings": {"train": "log.csv"}}, tmp_path)
    with pytest.raises(RecordingError, match=rf"{told}(?s:.*)sum it up over time"):
        check(study)


def test_a_joint_beside_one_that_was_not_recorded_is_not_said_to_lack_physics(
    tmp_path: Path,
) -> None:
    """A belt that its motor drives: the force of the belt follows from neither alone."""
    belt = """
    <mujoco><option timestep="0.002"/><worldbody>
      <body><joint name="drive" damping="3e-3" armature="2e-4"/><geom size=".01" mass=".01"/></body>
      <body><joint name="pulley" armature="1e-4"/><geom size=".01" mass=".01"/></body>
    </worldbody>
    <tendon><fixed name="belt" stiffness=".9" damping="1e-3" springlength="0">
      <joint joint="drive" coef="1"/><joint joint="pulley" coef="-1"/></fixed></tendon>
    <actuator><motor name="m" joint="drive"/></actuator></mujoco>"""
    compiled = Model.from_xml(belt).compile()
    ctrl = 0.02 * np.sin(3 * TIME) + 0.01 * np.sin(7.7 * TIME)
    rest = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    run = Engine(1).rollout(compiled, rest, np.repeat(ctrl, 5)[None, :, None])
    pulley = run.qpos[0, :-1:5, 1] + 1e-5 * np.random.default_rng(0).standard_normal(len(TIME))
    log = Recording.from_arrays(TIME, qpos={"pulley": pulley}, ctrl={"m": ctrl})
    log.to_frame().to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "belt.xml").write_text(belt)
    model = {"file": "belt.xml", "unrecorded": {"drive": None}}
    found = check(Study.from_dict({"model": model, "recordings": {"train": "log.csv"}}, tmp_path))
    use = found.summary.channels.set_index("channel")["use"]
    assert (use["qpos.drive"], use["qvel.drive"]) == ("moves unmeasured", "moves unmeasured")
    assert (use["qpos.pulley"], use["qvel.pulley"]) == ("in the model", "estimated from qpos")
    (flag,) = (f for f in found.flags if f.kind == "balance" and f.level == "look")
    assert flag.channels == ("pulley",)
    assert "What drive did was not recorded" in flag.sentence


def test_predictions_of_a_check_have_the_forces_beside_the_model(tmp_path: Path) -> None:
    """Forwards alone, damping that differs between the directions is damping of half of that."""
    damped = SLIDE.replace('axis="1 0 0"', 'axis="1 0 0" damping="10"')
    compiled = Model.from_xml(damped).compile()
    ctrl = 1.0 + 0.8 * np.sin(5 * TIME)
    rest = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    run = Engine(1).rollout(compiled, rest, np.repeat(ctrl, 2)[None, :, None])
    assert np.diff(run.qpos[0, :, 0]).min() >= 0
    q = run.qpos[0, :-1:2, 0] + 1e-5 * np.random.default_rng(0).standard_normal(len(TIME))
    log = Recording.from_arrays(TIME, qpos={"x": q}, ctrl={"m": ctrl})
    log.to_frame().to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "damped.xml").write_text(damped)
    (tmp_path / "plain.xml").write_text(SLIDE)
    effect = Placed("asymmetric_damping", Site("joint", "x"), (20.0,))
    Beside(survey(Model.from_xml(SLIDE).compile(), [log]), (effect,)).write(tmp_path / "x.json")
    models = ({"file": "damped.xml"}, {"file": "plain.xml", "beside": ["x.json"]}, "plain.xml")
    data = {
        "recordings": {"train": "log.csv"},
        "parameters": [{"address": "geom[load].mass", "low": 1.0, "high": 3.0}],
    }
    true, beside, without = (check(Study.from_dict({**data, "model": m}, tmp_path)) for m in models)
    sigma, same, other = (float(c.parameters["sigma"][0]) for c in (true, beside, without))
    assert same == pytest.approx(sigma, rel=0.05)
    assert abs(other - sigma) > 0.3 * sigma
    assert any("stand beside the model at x" in f.sentence for f in beside.flags)


def test_checks_do_not_import_torch() -> None:
    code = "import sys, bo_sysid.checks.check, bo_sysid.starter.init; print('torch' in sys.modules)"
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"


def test_a_model_that_is_far_off_is_said_to_be() -> None:
    table = pd.DataFrame({"channel": ["qpos.a", "qpos.b"], "change": 0.0, "left": [1e-3, 0.3]})
    noise = {"qpos.a": 1e-3, "qpos.b": 1e-3}
    (flag,) = far_flags(table, noise)
    assert flag.channels == ("qpos.b",)
    assert "300 standard deviations" in flag.sentence
    assert far_flags(table[:1], noise) == []


def test_a_joint_that_a_recording_lacks_stands_where_the_model_puts_it() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom name="stop" size=".1" pos="1 0 0"/>
        <body><joint name="x" type="slide" axis="1 0 0"/><geom name="load" size=".1"/></body>
        </worldbody></mujoco>"""
    )
    at_stop = Recording.from_arrays(TIME, qpos={"x": np.full(len(TIME), 0.95)})
    without = Recording.from_arrays(TIME, aux={"other": np.zeros(len(TIME))})
    (flag,) = contact_flags(model, [at_stop, without])
    assert flag.evidence == {"share": 0.5}  # and not all of it


@pytest.mark.parametrize(("parent", "level"), [("base", "look"), ("", "note")])
def test_geoms_that_overlap_at_a_joint_are_to_be_looked_at(parent: str, level: str) -> None:
    """MuJoCo filters contact between parent and child, but not where the parent stands still."""
    turret = (
        '<body name="turret"><joint name="turn" axis="0 0 1"/><geom name="drum" size=".1"/></body>'
    )
    base = f'<body name="base"><geom name="foot" size=".1"/>{turret if parent else ""}</body>'
    far = '<body><joint name="lift" axis="0 1 0"/><geom size=".01" pos="3 0 0"/>%s</body>'
    arms = base if parent else base + far % turret
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{arms}</worldbody></mujoco>")
    still = dict.fromkeys(("turn",) if parent else ("turn", "lift"), np.zeros(len(TIME)))
    (flag,) = contact_flags(model, [Recording.from_arrays(TIME, qpos=still)])
    assert (flag.level, flag.channels, flag.evidence) == (level, ("drum", "foot"), {"share": 1.0})
    assert ('<exclude body1="base" body2="turret"/>' in flag.sentence) == (level == "look")


@pytest.mark.parametrize(("share", "level"), [(0.5, "look"), (0.1, "note")])
def test_moving_bodies_that_touch_often_are_to_be_looked_at(share: float, level: str) -> None:
    """A gimbal's outer frame and its camera, which the inner frame joins."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="outer"><joint name="yaw" axis="0 0 1"/>
        <geom name="arm" type="box" size=".02 .2 .02" pos="0 0 -.1"/>
        <body name="inner"><joint name="roll"/><geom size=".001" mass="1"/>
        <body name="camera"><joint name="pitch" axis="0 1 0"/><geom name="lens" size=".02"
         pos="0 0 .1"/></body></body></body></worldbody></mujoco>"""
    )
    turned = {"yaw": 0 * TIME, "roll": 0 * TIME}
    turned["pitch"] = np.where(np.arange(len(TIME)) < share * len(TIME), np.pi, 0.0)
    (flag,) = contact_flags(model, [Recording.from_arrays(TIME, qpos=turned)])
    assert (flag.level, flag.channels) == (level, ("arm", "lens"))
    assert flag.evidence["share"] == pytest.approx(share, abs=0.02)
    assert ('<exclude body1="' in flag.sentence) == (level == "look")


def test_the_file_of_a_check_has_all_notes(tmp_path: Path) -> None:
    """On the screen stand the first twelve; the rest has to be somewhere."""
    wave = np.sin(2 * TIME)
    log = Recording.from_arrays(TIME, qpos={"x": wave}, ctrl={"m": wave})
    log.to_frame().to_csv(tmp_path / "a.csv", index=False)
    (tmp_path / "slide.xml").write_text(SLIDE)
    study = Study.from_dict({"model": "slide.xml", "recordings": {"train": "a.csv"}}, tmp_path)
    found = check(study)
    notes = tuple(f"Note {k}." for k in range(20))
    flags = tuple(Flag("note", "sampling", ("qpos.x",), f"Remark {k}.", {}) for k in range(20))
    found = replace(found, summary=replace(found.summary, notes=notes), flags=flags)
    shown = checked_text(found)
    assert "Note 11." in shown
    assert "Note 12." not in shown
    assert "- and 8 more" in shown
    write(found, tmp_path / "checked")
    written = (tmp_path / "checked" / "check.txt").read_text()
    assert all(f"- {n}" in written for n in (*notes, *(f.sentence for f in flags)))
    assert "more" not in written


@pytest.mark.parametrize(("kp", "share"), [(2.0, 0.0), (8000.0, 1.0)])
def test_a_model_that_diverges_determines_nothing_and_is_told(kp: float, share: float) -> None:
    """A servo of 8000 N m/rad on a rod of 1.5 g m² is stiffer than Euler's 10 ms can follow."""
    model = Model.from_xml(
        f"""<mujoco><option timestep="0.01" integrator="Euler"/><worldbody><body>
        <joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".05"/></body></worldbody>
        <actuator><position name="servo" joint="hinge" kp="{kp}"/></actuator></mujoco>"""
    )
    time = np.arange(0.0, 6.0, 0.01)
    both = {"qpos": {"hinge": np.sin(3 * time)}, "ctrl": {"servo": np.sin(3 * time)}}
    log = Recording.from_arrays(time, **both)
    coarse, fine = (cut(model, [log], horizon=30, timestep=dt) for dt in (0.01, 0.005))
    damping = Parameter("damping", ("joint[hinge].damping",), 0.0, 0.1)
    simulator = MujocoSimulator(model, (damping,), Engine(1))
    noise, point = {"qpos.hinge": 1e-3}, np.array([0.05])
    determined = information(simulator, point, coarse, noise).table()["determined"].tolist()
    assert determined == (["not"] if share else ["yes"])
    flags = divergence_flags(step_effect(simulator, point, coarse, fine), 0.01)
    assert [f.evidence["share"] for f in flags] == ([share] if share else [])
