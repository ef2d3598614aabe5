"""Which windows are compared."""

import mujoco
import numpy as np

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import most_informative, windows_of
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.recording.alignment import instants_in

STEP, SIGMA, DURATION, STROKE = 0.002, 1e-7, 30.0, 2.0
HORIZON = 150
XML = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" frictionloss="4"/>
      <geom type="box" size=".1 .1 .1" mass="10"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="x"/></actuator>
</mujoco>
"""


def strokes(magnets: float = 1.5, knocked_at: float | None = None) -> Evidence:
    """A cart with friction goes to and fro over magnets; few windows hold a turn.

    It is knocked once, for 50 ms, where a time is given.
    """
    plant = mujoco.MjModel.from_xml_string(XML)
    plant.opt.timestep = STEP / 20
    data, time = mujoco.MjData(plant), np.arange(0, DURATION, STEP)
    phase = time / STROKE % 2
    goal = 0.3 * np.where(phase < 1, phase, 2 - phase)
    x, u = np.empty((len(time), 1)), np.empty((len(time), 1))
    for k in range(len(time)):
        x[k] = data.qpos
        u[k] = data.ctrl[:] = 400 * (goal[k] - data.qpos) - 60 * data.qvel
        knocked = knocked_at is not None and 0 <= time[k] - knocked_at < 0.05
        data.qfrc_applied[:] = magnets * np.sin(60 * data.qpos) + 30 * knocked
        mujoco.mj_step(plant, data, 20)
    x += SIGMA * np.random.default_rng(0).normal(size=x.shape)
    recording = Recording.from_arrays(time, qpos={"x": x[:, 0]}, ctrl={"motor": u[:, 0]})
    return make_evidence(
        Model.from_xml(XML), [recording], effects=[CATALOGUE["link_mass"]],
        noise={"qpos": SIGMA}, threads=1,
    )  # fmt: skip


def test_far_from_the_recordings_no_window_is_dropped_for_its_time_step() -> None:
    problem = windows_of(strokes(), HORIZON, STEP, everything=True)
    prepared = prepare(problem)
    assert len(prepared.start) == len(problem.windows)
    left = prepared.problem.residual(prepared.linear.hypothesis, prepared.start)
    assert np.sqrt((left**2).mean()) > 100  # sigma, of the magnets that the model lacks
    size = np.sqrt((prepared.problem.correction**2).mean(axis=1))
    assert size.max() > 4 * np.median(size) + 0.5  # some turn, most do not


def test_a_window_that_leaves_most_is_searched_beside_evenly_spread_ones() -> None:
    hit = 17.33
    problem = windows_of(strokes(0.05, hit), 100, STEP, everything=True)
    prepared = prepare(problem)
    nominal = Search.on(prepared, [], 1, None).nominal
    some = most_informative(prepared, nominal)
    began = np.array(some.problem.windows.time)
    length = 100 * STEP
    assert ((began <= hit) & (hit < began + length)).any()
    assert len(began) == 48 < len(problem.windows) / 3
    assert np.diff(began).max() < 1.5 * DURATION / 24  # all of the recording is seen
    own = np.isin(prepared.problem.windows.time, began)
    known = prepared.linear.residual[own]
    np.testing.assert_allclose(some.linear.residual, known, atol=1e-6 * np.abs(known).max())


def beside_a_force_at_1_khz() -> tuple[Model, Recording, Recording]:
    """Positions at 100 Hz, without and with a force sensor that no residual has."""
    sensor = '<sensor><jointactuatorfrc name="tau" joint="x"/></sensor></mujoco>'
    t, fast = np.arange(0, 4, 0.01), np.arange(0, 4, 0.001) + 0.0003
    moved = 0.5 * np.sin(3 * t) + 1e-4 * np.random.default_rng(0).standard_normal(t.size)
    alone = Recording.from_arrays(t, qpos={"x": moved}, ctrl={"motor": 2 * np.sin(4 * t)})
    force = Channel(fast, np.sin(fast), "N", "tau")
    beside = Recording("r", {**alone.channels, "sensor.tau": force})
    return Model.from_xml(XML.replace("</mujoco>", sensor)), alone, beside


def test_a_faster_sensor_does_not_shorten_the_windows() -> None:
    model, alone, beside = beside_a_force_at_1_khz()
    found = []
    for recording in (alone, beside):
        evidence = make_evidence(model, [recording], effects=[CATALOGUE["link_mass"]], threads=1)
        problem = windows_of(evidence, 30, STEP)
        w = problem.windows
        np.testing.assert_allclose((w.step + w.fraction)[:, -1] * STEP, 0.3)
        found.append(problem)
    assert found[0].dof == found[1].dof > 300
    np.testing.assert_array_equal(found[0].windows.observed, found[1].windows.observed)


def test_instants_are_counted_over_all_channels_that_are_cut() -> None:
    _, alone, beside = beside_a_force_at_1_khz()
    assert instants_in(0.3, [alone], ["qpos.x", "sensor.tau"]) == 30
    assert instants_in(0.3, [beside], ["qpos.x"]) == 30
    assert instants_in(0.3, [beside], ["qpos.x", "sensor.tau"]) == 330


SATURATED = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" damping="{damping}"/>
      <geom size=".1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="x" {limit}/></actuator>
</mujoco>
"""


def test_a_limit_that_is_reached_in_one_window_of_many_is_found() -> None:
    """By the windows of the search damping is all that is missing."""
    limited = SATURATED.format(damping=2, limit='forcelimited="true" forcerange="-12 12"')
    plant = mujoco.MjModel.from_xml_string(limited)
    data, time, rng = mujoco.MjData(plant), np.arange(0, 40, 0.01), np.random.default_rng(0)
    tones = [(f, rng.uniform(1, 3), rng.uniform(0, 6)) for f in (0.3, 0.7, 1.1, 1.9)]
    u = np.clip(sum(a * np.sin(2 * np.pi * f * time + p) for f, a, p in tones), -9, 9)
    u[(time >= 17.3) & (time < 17.4)] = 20
    x = np.empty(time.size)
    for k in range(time.size):
        x[k], data.ctrl[:] = data.qpos[0], u[k]
        mujoco.mj_step(plant, data, 5)
    x += 1e-3 * rng.normal(size=x.size)
    recording = Recording.from_arrays(time, qpos={"x": x}, ctrl={"motor": u})
    names = ("viscous_damping", "actuator_saturation", "dry_friction")
    evidence = make_evidence(
        Model.from_xml(SATURATED.format(damping=0, limit="")), [recording],
        effects=[CATALOGUE[n] for n in names], noise={"qpos": 1e-3}, threads=1,
    )  # fmt: skip
    told: list[str] = []
    best = locate(evidence, told.append).decision.best
    assert told[-1].startswith("other windows, since they show more: viscous_damping at x")
    assert {c.effect.id for c in best.members} == {"viscous_damping", "actuator_saturation"}
    assert best.rms < 1.02
