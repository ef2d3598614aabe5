"""`identify` on studies of small machines whose parameters are known."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import pytest
from diagnosis_helpers import ARM, record

from bo_sysid.belief.bootstrap import resample
from bo_sysid.belief.stopping import StopRule
from bo_sysid.deviation import Evaluation
from bo_sysid.deviation.forecast import Residual
from bo_sysid.errors import RecordingError, StudyError
from bo_sysid.identify import identify
from bo_sysid.identify.discretisation import step_notes, step_shift
from bo_sysid.identify.errors import compared, remarks, side_by_side, traces
from bo_sysid.identify.problem import make_problem
from bo_sysid.identify.search import (
    History,
    Rules,
    search,
    update_belief,
)
from bo_sysid.parameters import COLUMNS
from bo_sysid.recording import Channel, Recording
from bo_sysid.runs import Run
from bo_sysid.study import Study

CART = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom name="cart" type="box" size=".1 .1 .1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="rail"/></actuator>
  <sensor><actuatorfrc name="force" actuator="motor"/></sensor>
</mujoco>
"""


def cart_study(folder: Path, samples: int = 400, **changes: object) -> Study:
    """A cart of 1 kg under random forces, its speed recorded with noise."""
    rng = np.random.default_rng(4)
    force = rng.choice([-10.0, 10.0], samples)
    speed = np.concatenate([[0.0], np.cumsum(force[:-1]) * 0.01])
    place = np.cumsum(speed) * 0.01
    Recording.from_arrays(
        np.arange(samples) * 0.01,
        qpos={"rail": place},
        qvel={"rail": speed + 0.02 * rng.normal(size=samples)},
        ctrl={"motor": force},
    ).to_frame().to_parquet(folder / "cart.parquet")
    (folder / "cart.xml").write_text(CART)
    mass = {"name": "mass", "address": "geom[cart].mass", "low": 0.5, "high": 1.5, "steps": 11}
    data = {
        "model": "cart.xml",
        "recordings": {"train": ["cart.parquet"]},
        "parameters": [mass],
        "search": {"budget": 20, "stop": {"entropy": 0}, "refine": True},
    }
    return Study.from_dict({**data, **changes}, folder, trust_code=True)


def test_the_noise_that_a_study_states_is_what_counts(tmp_path: Path) -> None:
    stated = {"train": ["cart.parquet"], "noise": {"qpos": 0.25}}
    study = cart_study(tmp_path, recordings=stated, search={"budget": 3})
    assert identify(study).noise == {"qpos.rail": 0.25}


@pytest.mark.parametrize("ordered", [True, False])
def test_a_category_has_nothing_beside_or_beyond_it(tmp_path: Path, ordered: bool) -> None:
    mass = {"name": "mass", "address": "geom[cart].mass", "low": 1.0, "high": 2.0, "steps": 5}
    study = cart_study(tmp_path, parameters=[{**mass, "ordered": ordered}], search={"budget": 5})
    row = identify(study).parameters.iloc[0]
    assert row["value"] == row["low95"] == 1.0
    assert row["high95"] == (1.125 if ordered else 1.0)
    assert row["at_bound"] == ordered


def test_zooming_leaves_the_interval_as_wide_as_the_recordings_do(tmp_path: Path) -> None:
    study = cart_study(tmp_path)
    found = identify(study)
    # the arg-min of every bootstrap over a set so fine that it does not matter
    problem = make_problem(study, threads=1)
    fine = np.linspace(0.8, 1.2, 401)
    blocks = problem.deviation.blocks
    drawn = resample(np.zeros(len(blocks.weight), int), 4000, np.random.default_rng(0))
    told = problem.deviation(fine[:, None]).contributions @ (drawn * blocks.weight).T
    low, high = np.quantile(fine[told.argmin(axis=0)], [0.025, 0.975])
    row = found.parameters.iloc[0]
    assert row["low95"] == pytest.approx(low, abs=0.02)
    assert row["high95"] == pytest.approx(high, abs=0.02)
    assert row["low95"] < 1.0 < row["high95"]
    assert found.identifiability["of_range"][0] == pytest.approx(row["high95"] - row["low95"])
    assert found.unsure == ()
    assert len(found.evaluations) == found.evaluations["mass"].nunique() <= 20


PENDULUM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="{damping}"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="{mass}"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""


def pendulum_study(folder: Path, **search: object) -> Study:
    """A driven pendulum of .63 kg with damping .083 N m s/rad, 12 s at 100 Hz."""
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(damping=0.083, mass=0.63))
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(0), []
    for _ in range(1200):
        data.ctrl[0] = 0.6 * np.sin(3 * data.time) + 0.3 * np.sin(7.1 * data.time)
        rows.append([data.time, data.qpos[0], data.qvel[0], data.ctrl[0]])
        mujoco.mj_step(model, data, 5)
    time, angle, speed, torque = np.array(rows).T
    Recording.from_arrays(
        time,
        qpos={"hinge": angle + 1e-3 * rng.standard_normal(len(time))},
        qvel={"hinge": speed + 1e-2 * rng.standard_normal(len(time))},
        ctrl={"motor": torque},
    ).to_frame().to_parquet(folder / "log.parquet")
    (folder / "pendulum.xml").write_text(PENDULUM.format(damping=0.05, mass=0.5))
    mass = {"name": "mass", "address": "geom[rod].mass", "low": 0.2, "high": 1.0}
    damping = {"name": "damping", "address": "joint[hinge].damping", "low": 0.0, "high": 0.2}
    data = {
        "model": "pendulum.xml",
        "recordings": {"train": ["log.parquet"], "noise": {"qpos": 1e-3, "qvel": 1e-2}},
        "parameters": [{**mass, "steps": 9}, {**damping, "steps": 9}],
        "deviation": {"horizon": 10},
        "search": {"budget": 60, "refine": True, **search},
    }
    return Study.from_dict(data, folder)


@pytest.mark.parametrize(("candidates", "seed"), [("grid", 0), ("grid", 1), ({"sobol": 300}, 0)])
def test_the_interval_is_that_of_the_recordings_for_two_parameters(
    tmp_path: Path, candidates: object, seed: int
) -> None:
    """Beside the arg-min of every bootstrap over a set so fine that it does not matter."""
    study = pendulum_study(tmp_path, candidates=candidates, seed=seed)
    found = identify(study).parameters
    problem = make_problem(study, threads=1)
    axes = np.linspace(0.618, 0.642, 25), np.linspace(0.079, 0.088, 19)
    fine = np.stack([a.ravel() for a in np.meshgrid(*axes, indexing="ij")], axis=1)
    blocks = problem.deviation.blocks
    drawn = resample(np.zeros(len(blocks.weight), int), 4000, np.random.default_rng(0))
    sums = problem.deviation(fine).contributions @ (drawn * blocks.weight).T
    low, high = np.quantile(fine[sums.argmin(axis=0)], [0.025, 0.975], axis=0)
    # a candidate stands for its cell, a tenth of the interval and more beside it
    assert (abs(found["low95"] - low) < 0.5 * (high - low)).all()
    assert (abs(found["high95"] - high) < 0.5 * (high - low)).all()


@pytest.mark.parametrize("steps", [6, 11])
def test_zooming_ends_where_the_recordings_tell_no_more(tmp_path: Path, steps: int) -> None:
    search = {"budget": 200, "stop": {"entropy": 0}, "refine": True}
    mass = {"name": "mass", "address": "geom[cart].mass", "low": 0.5, "high": 1.5, "steps": steps}
    found = identify(cart_study(tmp_path, search=search, parameters=[mass]))
    row = found.parameters.iloc[0]
    width = row["high95"] - row["low95"]
    finest = np.diff(np.sort(found.candidates.points[:, 0])).min()
    assert 0.005 * width < finest < 0.1 * width
    assert len(found.evaluations) < 100


def test_what_was_simulated_is_kept_before_the_next_belief_is_made(tmp_path: Path) -> None:
    problem = make_problem(cart_study(tmp_path), threads=1)
    rules = Rules("argmin-entropy", StopRule(10, 0.0, 1))
    simulated: list[int] = []
    kept: list[int] = []

    def evaluate(row: int) -> Evaluation:
        simulated.append(row)
        return problem.deviation(problem.candidates.points[[row]])

    def watched_update(*known: Any) -> Any:
        assert kept == simulated  # a kill from here on loses nothing
        return update_belief(*known)

    def keep(history: History) -> None:
        kept[:] = history.rows.tolist()

    search(
        problem.candidates,
        evaluate,
        rules,
        History.empty(len(problem.deviation.blocks.weight)),
        keep,
        watched_update,
    )
    assert len(simulated) > 5  # the first four are the design


def test_what_only_the_holdout_recorded_is_left_out_and_said(tmp_path: Path) -> None:
    study = cart_study(
        tmp_path,
        recordings={"train": ["cart.parquet"], "holdout": ["check.parquet"]},
        search={"budget": 4},
    )
    frame = pd.read_parquet(tmp_path / "cart.parquet")
    frame.assign(**{"sensor.force": frame["ctrl.motor"]}).to_parquet(tmp_path / "check.parquet")
    found = identify(study)
    assert {*found.errors["channel"]} == {"qpos.rail", "qvel.rail"}
    parts = found.errors.pivot_table("identified", "channel", "recordings")
    np.testing.assert_allclose(parts["holdout"], parts["train"])  # of the same motion
    assert "check: sensor.force is not compared: no training recording has it" in found.notes


@pytest.mark.parametrize(
    ("nominal", "identified", "errors"),
    [
        ([0, 0, 0, 0], [0, 0, 0, 0], (np.sqrt((1 + 4 + 9 + 16) / 4), 2.0)),
        ([0, 0, 1, 1], [0, 0, 0, 0], (np.sqrt((1 + 4) / 2), 2.0)),  # not 2.7 of all four
        ([0, 0, 1, 1], [1, 0, 0, 0], (2.0, 2.0)),
        ([1, 1, 1, 1], [0, 1, 0, 0], (np.nan, 2.0)),  # the other's own windows
        ([0, 0, 1, 1], [1, 1, 0, 0], (np.nan, np.nan)),
    ],
)
def test_two_models_are_compared_on_windows_in_which_neither_diverged(
    nominal: list[int], identified: list[int], errors: tuple[float, float]
) -> None:
    left = np.array([1.0, 2.0, 3.0, 4.0])[:, None, None], np.full((4, 1, 1), 2.0)
    lost = np.array([nominal, identified], bool)
    for values, flags in zip(left, lost, strict=True):
        values[flags] = 1e9  # finite, and without meaning
    table = side_by_side(*[Residual(("qpos.a",), v, f) for v, f in zip(left, lost, strict=True)])
    found = table.iloc[0]
    np.testing.assert_allclose([found["nominal"], found["identified"]], errors)
    assert found["nominal_diverged"] == np.mean(nominal)
    assert found["identified_diverged"] == np.mean(identified)


def test_a_model_that_diverges_is_not_compared_by_what_it_survived(tmp_path: Path) -> None:
    """A mass left at next to nothing diverges under force; coasting it is as good as any."""
    study = cart_study(tmp_path, search={"budget": 3})
    (tmp_path / "cart.xml").write_text(CART.replace('mass="1"', 'mass="1e-12"'))
    rng, samples = np.random.default_rng(4), 401
    force = np.where(np.arange(samples) % 4 == 1, rng.choice([-10.0, 10.0], samples), 0.0)
    speed = np.concatenate([[0.0], np.cumsum(force[:-1]) * 0.01])
    Recording.from_arrays(
        np.arange(samples) * 0.01,
        qpos={"rail": np.cumsum(speed) * 0.01},
        qvel={"rail": speed + 0.02 * rng.normal(size=samples)},
        ctrl={"motor": force},
    ).to_frame().to_parquet(tmp_path / "cart.parquet")
    found = identify(study).errors
    np.testing.assert_allclose(found["nominal_diverged"], 0.25, atol=0.01)
    assert (found["identified_diverged"] == 0).all()
    np.testing.assert_allclose(found["nominal"], found["identified"], rtol=1e-9)
    told = dict(zip(found["channel"], found["unit"], strict=True))
    assert told == {"qpos.rail": "m", "qvel.rail": "m/s"}
    speeds = found.loc[found["channel"] == "qvel.rail", "nominal"]  # of the start and of the end
    np.testing.assert_allclose(speeds, 0.02 * np.sqrt(2), rtol=0.2)


def test_what_has_no_error_is_said() -> None:
    values = np.full((4, 1, 2), 2.0)
    values[..., 1] = np.nan
    lost = np.array([[1, 1, 1, 1], [0, 0, 0, 0], [0, 0, 1, 1], [1, 1, 0, 0]], bool)
    every, none, late, early = (Residual(("qpos.a", "qpos.b"), values, d) for d in lost)

    def said(nominal: Residual, identified: Residual) -> list[str]:
        table = side_by_side(nominal, identified).assign(recordings="train", kind="fit")
        return [note.removeprefix("train, fit: ") for note in remarks(table)]

    silent = "qpos.b was recorded in no window that is compared"
    half = "model diverges in 50.0% of the windows, which count for neither"
    assert said(none, none) == [silent]
    assert said(every, none) == ["the nominal model diverges in every window", silent]
    assert said(none, late) == [f"the identified {half}", silent]
    assert said(early, late) == [
        f"the nominal {half}", f"the identified {half}",
        "there is no window in which neither diverges",
    ]  # fmt: skip


def test_windows_without_velocities_are_as_long_where_a_sensor_is_faster(tmp_path: Path) -> None:
    """They are counted in instants at which anything was recorded, ten times as many here."""
    study = cart_study(tmp_path)
    log = pd.read_parquet(tmp_path / "cart.parquet").drop(columns="qvel.rail")
    whole = Recording.from_frame(log, name="cart")
    time = np.arange(4000) * 0.001
    force = Channel(time, whole.channels["ctrl.motor"].at(time), "N", "", "zero")
    fast = replace(whole, channels={**whole.channels, "sensor.force": force})
    lengths = {}
    for name, recording in (("slow", whole), ("fast", fast)):
        windows = make_problem(study, [recording], threads=1).deviation.windows
        lengths[name] = windows.step[:, -1].max() * windows.timestep
    assert lengths["slow"] == pytest.approx(0.15)
    assert lengths["fast"] == pytest.approx(0.15, abs=0.011)


def test_starts_are_fitted_where_velocities_have_other_instants(tmp_path: Path) -> None:
    """Between two samples a start's velocity is one of noisy positions, and mass was 55 % off."""
    study = pendulum_study(tmp_path)
    log = Recording.from_frame(pd.read_parquet(tmp_path / "log.parquet"), name="log")
    assert not make_problem(study, [log], threads=1).deviation.fitted_starts
    rate = log.channels["qvel.hinge"]
    time = rate.time[:-1] + 0.005
    apart = Channel(time, np.interp(time, rate.time, rate.values), rate.unit)
    mixed = replace(log, channels={**log.channels, "qvel.hinge": apart})
    mixed.to_frame().to_parquet(tmp_path / "log.parquet")
    data = study.resolved()
    data["recordings"]["columns"] = {n: {"missing": "skip"} for n in mixed.channels}
    data["deviation"]["horizon"] = 1
    result = identify(Study.from_dict(data, tmp_path))
    assert any("100 % of the positions were recorded without a velocity" in n for n in result.notes)
    found = result.parameters
    truth = np.array([0.63, 0.083])
    assert ((found["low95"] < truth) & (truth < found["high95"])).all(), found


def test_forecasts_begin_as_well_where_one_joint_is_slower_than_others(tmp_path: Path) -> None:
    """With one sample of the elbow its speed follows from how the shoulder's noise bends."""
    mass = {"name": "mass", "address": "geom[forearm].mass", "low": 0.4, "high": 0.8, "steps": 3}
    data = {"model": str(ARM), "recordings": {"train": ["arm.parquet"]}, "parameters": [mass]}
    study = Study.from_dict(data, tmp_path)
    whole = record(duration=4.0, sampling=0.004)
    elbow = whole.channels["qpos.elbow"]
    every_third = replace(elbow, time=elbow.time[::3], values=elbow.values[::3])
    slow = replace(whole, channels={**whole.channels, "qpos.elbow": every_third})
    rms = {}
    for name, recording in (("whole", whole), ("slow", slow)):
        problem = make_problem(study, [recording], threads=1)
        table = compared(problem, problem.nominal, {"train": [recording]})
        table = table[table["kind"] == "forecast"].set_index("channel")
        rms[name] = table.loc["qpos.elbow", "nominal"]
    assert rms["slow"] < 1.5 * rms["whole"], rms


@pytest.mark.parametrize("whole", [0, 1])
def test_a_recording_without_positions_or_velocities_is_told_by_name(
    tmp_path: Path, whole: int
) -> None:
    files = ["cart.parquet", "blind.parquet"]
    recordings = {"train": [files[1 - whole], files[whole]]}
    study = cart_study(tmp_path, recordings=recordings)
    log = pd.read_parquet(tmp_path / "cart.parquet").drop(columns="qvel.rail")
    log.to_parquet(tmp_path / "cart.parquet")
    force = {"sensor.force": log["ctrl.motor"]}
    log.drop(columns="qpos.rail").assign(**force).to_parquet(tmp_path / "blind.parquet")
    with pytest.raises(RecordingError, match=r"blind.*: no channel 'qpos.rail'"):
        make_problem(study, threads=1)


def test_a_horizon_that_leaves_one_window_is_told_before_the_search(tmp_path: Path) -> None:
    study = cart_study(tmp_path, samples=101, deviation={"horizon": 60})
    with pytest.raises(StudyError, match=r"deviation.horizon: .* 60 .*one window.* 37 or less"):
        make_problem(study, threads=1)
    study = cart_study(tmp_path, samples=101, deviation={"horizon": 37})
    assert len(make_problem(study, threads=1).deviation.windows) == 2


def test_a_channel_between_the_windows_is_not_said_to_rest(tmp_path: Path) -> None:
    """Positions at half the rate of speeds: where one begins a window, it ends before the next."""
    asked = {"columns": {"qpos.rail": {"missing": "skip"}}, "train": ["cart.parquet"]}
    study = cart_study(tmp_path, recordings=asked, search={"budget": 3})
    log = pd.read_parquet(tmp_path / "cart.parquet")
    log.loc[log.index % 2 == 1, "qpos.rail"] = np.nan
    log.to_parquet(tmp_path / "cart.parquet")
    (note,) = (n for n in identify(study).notes if n.startswith("qpos.rail is not compared"))
    assert note.endswith("no window of 1 instants has a sample of it; use a longer horizon")


@pytest.mark.parametrize(("rates", "least"), [(True, 2), (False, 3)])
def test_fitted_starts_that_leave_nothing_to_tell_are_refused(
    tmp_path: Path, rates: bool, least: int
) -> None:
    """A start of the cart is two numbers: a window of no more of them fits with any mass."""
    for horizon in (least - 1, least):
        asked = {"starts": "fitted", "horizon": horizon}
        study = cart_study(tmp_path, deviation=asked)
        if not rates:
            log = pd.read_parquet(tmp_path / "cart.parquet").drop(columns="qvel.rail")
            log.to_parquet(tmp_path / "cart.parquet")
        if horizon == least:
            assert make_problem(study, threads=1).horizon == least
            continue
        with pytest.raises(StudyError, match=rf"deviation.horizon: .* 2 numbers.* {least} or more"):
            make_problem(study, threads=1)


def test_a_horizon_beyond_what_is_set_aside_is_told_before_the_search(tmp_path: Path) -> None:
    study = cart_study(tmp_path, samples=101, deviation={"horizon": 30})
    with pytest.raises(StudyError, match=r"deviation.horizon: windows of 30 .*has about 25"):
        identify(study)
    fits = cart_study(tmp_path, samples=101, deviation={"horizon": 25}, search={"budget": 3})
    assert "holdout" in set(identify(fits).errors["recordings"])


def test_no_column_of_the_tables_has_the_name_of_a_parameter(tmp_path: Path) -> None:
    study = cart_study(tmp_path, search={"budget": 3})
    with Run.open(tmp_path / "run", {"name": "s"}, "identify") as run:
        found = identify(study, run)
        tables = [run.read_frame("evaluations.parquet"), run.read_frame("belief.parquet")]
    for table in (*tables, found.belief, found.evaluations):
        assert set(table.columns) - set(COLUMNS) == {"mass"}


def test_another_law_or_input_is_another_problem(tmp_path: Path) -> None:
    """A run would else go on with evaluations of both."""
    law = {"motor": {"law": "law.py:push", "uses": ["aux.load"]}}
    (tmp_path / "law.py").touch()
    study = cart_study(tmp_path, samples=60, actuators=law)
    log = pd.read_parquet(tmp_path / "cart.parquet").drop(columns="ctrl.motor")

    def fingerprint(offset: float, load: float, delay: float) -> str:
        text = f"def push(given):\n    return given.signals['aux.load'] + {offset}\n"
        (tmp_path / "law.py").write_text(text)
        moved = log.assign(**{"aux.load": load, "time": log["time"] * (1 + delay)})
        moved.to_parquet(tmp_path / "cart.parquet")
        return make_problem(study, threads=1).fingerprint

    first = fingerprint(0.0, 0.0, 0.0)
    assert fingerprint(0.0, 0.0, 0.0) == first
    others = [fingerprint(1.0, 0.0, 0.0), fingerprint(0.0, 1.0, 0.0), fingerprint(0.0, 0.0, 0.01)]
    assert len({first, *others}) == 4


def test_another_mesh_of_the_same_name_is_another_problem(tmp_path: Path) -> None:
    study = cart_study(tmp_path, samples=60)
    mesh = '<asset><mesh name="hull" file="hull.obj"/></asset><worldbody>'
    xml = CART.replace("<worldbody>", mesh, 1)
    xml = xml.replace("</body>", '<geom type="mesh" mesh="hull" mass="0.1"/></body>', 1)
    (tmp_path / "cart.xml").write_text(xml)

    def fingerprint(width: float) -> str:
        corners = [(0, 0, 0), (width, 0, 0), (0, 1, 0), (0, 0, 1)]
        faces = ["f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + faces
        (tmp_path / "hull.obj").write_text("\n".join(lines))
        os.utime(tmp_path / "hull.obj", (0, 100 * width))  # MuJoCo keeps meshes by file and time
        return make_problem(study, threads=1).fingerprint

    first = fingerprint(1.0)
    assert fingerprint(1.0) == first
    assert fingerprint(1.1) != first


def damped_study(folder: Path, timestep: float) -> Study:
    """A pendulum recorded at a fine step, and modelled at a coarse one by Euler's method."""
    text = """
    <mujoco>
      <option timestep="{}" integrator="Euler"><flag eulerdamp="disable"/></option>
      <worldbody><body>
        <joint name="hinge" axis="0 1 0" damping=".02"/>
        <geom name="bob" type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/>
      </body></worldbody>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(text.format(1e-4))
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = 1.0
    for k in range(60_000):
        if k % 100 == 0:
            rows.append((data.time, *data.qpos, *data.qvel))
        mujoco.mj_step(model, data)
    time, qpos, qvel = np.array(rows).T
    recording = Recording.from_arrays(time, qpos={"hinge": qpos}, qvel={"hinge": qvel})
    recording.to_frame().to_parquet(folder / "swing.parquet")
    (folder / "swing.xml").write_text(text.format(timestep))
    damping = {"address": "joint[hinge].damping", "low": 0.0, "high": 0.04, "steps": 401}
    data_ = {
        "model": "swing.xml",
        "recordings": {"train": ["swing.parquet"], "noise": {"qpos": 1e-3, "qvel": 1e-2}},
        "deviation": {"horizon": 20},
        "parameters": [{"name": "damping", **damping}],
    }
    return Study.from_dict(data_, folder)


@pytest.mark.parametrize("timestep", [0.01, 0.0005])
def test_what_the_time_step_does_to_a_parameter_is_told(tmp_path: Path, timestep: float) -> None:
    """Explicit Euler feeds energy in; the damping that makes up for it is found in its place."""
    problem = make_problem(damped_study(tmp_path, timestep), threads=1)
    deviations = problem.deviation(problem.candidates.points).deviation
    best = problem.candidates.points[deviations.argmin()]
    (shift,) = step_shift(problem, best)
    assert shift == pytest.approx(best[0] - 0.02, abs=2e-4, rel=0.1)
    found = pd.DataFrame({"name": ["damping"], "unit": [""], "low95": best - 5e-4,
                          "high95": best + 5e-4})  # fmt: skip
    notes = step_notes(problem, best, found)
    assert (len(notes) == 1) == (timestep == 0.01)
    assert all("time step of 10 ms moves damping by about +" in n for n in notes)


def test_traces_of_a_quaternion_follow_the_sign_that_was_recorded(tmp_path: Path) -> None:
    """A box that turns half a round about x, in a log that keeps w positive."""
    xml = """<mujoco><option timestep=".01" gravity="0 0 0"/><worldbody>
    <body><freejoint name="root"/><geom name="box" type="box" size=".1 .06 .03" mass="1"/></body>
    </worldbody></mujoco>"""
    (tmp_path / "box.xml").write_text(xml)
    time = np.arange(0.0, 4.0, 0.01)
    turned, rates = np.zeros((len(time), 7)), np.zeros((len(time), 6))
    turned[:, 3], turned[:, 4], rates[:, 3] = np.cos(time), np.sin(time), 2.0
    turned[turned[:, 3] < 0] *= -1
    log = Recording.from_arrays(time, qpos={"root": turned}, qvel={"root": rates})
    log.to_frame().to_parquet(tmp_path / "box.parquet")
    data = {
        "model": "box.xml",
        "recordings": {"train": ["box.parquet"]},
        "deviation": {"horizon": 20},
        "parameters": [{"address": "geom[box].mass", "low": 0.5, "high": 2.0, "steps": 3}],
    }
    problem = make_problem(Study.from_dict(data, tmp_path), threads=1)
    table = traces(problem, problem.nominal, [log])
    own = table[table["channel"].isin(["qpos.root.3", "qpos.root.4"])]
    assert (own["recorded"].diff().abs() > 0.5).any()
    for model in ("nominal", "identified"):
        np.testing.assert_allclose(own[model], own["recorded"], atol=1e-6)
