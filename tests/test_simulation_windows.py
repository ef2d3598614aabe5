"""Windows: cut from messy recordings, compared at the recorded instants."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine, Layout, MujocoSimulator, State, cut, predicted
from bo_sysid.simulation.smoothing import smooth

ARM = """<mujoco><option timestep="0.002" integrator="{integrator}"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
    <geom name="upper" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1"/>
    <body name="fore" pos="0 0 -0.4"><joint name="elbow" axis="0 1 0" damping="0.05"/>
      <geom name="fore" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/></body>
  </body></worldbody>
  <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator>
</mujoco>"""


@pytest.fixture(scope="module")
def arm() -> Model:
    return Model.from_xml(ARM.format(integrator="implicitfast"), name="arm")


def simulated(arm: Model, samples: int = 400, *, velocities: bool = True) -> Recording:
    """A recording of the model itself, sampled at every step."""
    dt = 0.002
    time = np.arange(samples + 1) * dt
    ctrl = np.stack([np.sin(3 * time), 0.4 * np.cos(5 * time)], axis=1)
    start = State(np.array([[0.3, -0.5]]), np.array([[0.2, 0.1]]), np.zeros((1, 0)))
    t = Engine(threads=1).rollout(arm.compile(), start, ctrl[None, :-1])
    kinds = {
        "qpos": {"shoulder": t.qpos[0, :, 0], "elbow": t.qpos[0, :, 1]},
        "ctrl": {"shoulder": ctrl[:, 0], "elbow": ctrl[:, 1]},
    }
    if velocities:
        kinds["qvel"] = {"shoulder": t.qvel[0, :, 0], "elbow": t.qvel[0, :, 1]}
    return Recording.from_arrays(time, **kinds)


def forecast(arm: Model, recording: Recording, horizon: int, **kwargs: object) -> tuple:
    windows = cut(arm, [recording], horizon=horizon, **kwargs)
    simulator = MujocoSimulator(arm, (), Engine(threads=1))
    prediction = next(iter(simulator.predictions(np.zeros((1, 0)), windows)))
    return windows, prediction


@pytest.mark.parametrize("horizon", [1, 7, 50])
def test_the_model_predicts_its_own_recording(arm: Model, horizon: int) -> None:
    windows, prediction = forecast(arm, simulated(arm), horizon)
    np.testing.assert_allclose(prediction.values, windows.observed, atol=1e-13)
    assert len(windows) == 400 // horizon
    assert windows.aligned


@pytest.mark.parametrize("horizon", [1, 7])
def test_stamps_that_count_from_1970_are_on_the_steps_as_well(arm: Model, horizon: int) -> None:
    """They are a quarter of a microsecond apart: what is on a step is off by as much."""
    plain = simulated(arm)
    late = {n: replace(c, time=c.time + 1_764_229_200.123) for n, c in plain.channels.items()}
    windows, prediction = forecast(arm, replace(plain, channels=late), horizon)
    assert windows.aligned
    assert windows.steps == horizon
    np.testing.assert_allclose(prediction.values, windows.observed, atol=1e-13)


def kept(recording: Recording, channel: str, where: Callable[[np.ndarray], object]) -> Recording:
    """Return a recording with some samples of a channel, chosen by their stamps."""
    whole = recording.channels[channel]
    rows = where(whole.time)
    part = replace(whole, time=whole.time[rows], values=whole.values[rows])
    return replace(recording, channels={**recording.channels, channel: part})


def test_no_window_begins_before_its_controls_are_known(arm: Model) -> None:
    late = kept(simulated(arm), "ctrl.elbow", lambda t: t >= 0.3)
    windows, prediction = forecast(arm, late, 10)
    np.testing.assert_allclose(prediction.values, windows.observed, atol=1e-13)
    assert windows.time[0] == pytest.approx(0.3)
    assert len(windows) == 25
    (note,) = windows.left_out
    assert "ctrl.elbow begins 0.3 s after the measurements; 15 of 40 windows lack it" in note
    hair = kept(
        simulated(arm), "ctrl.elbow", lambda t: t >= 0.002
    )  # as where logs of two topics begin
    assert len(forecast(arm, hair, 10)[0]) == 40
    shifted = late.channels["ctrl.elbow"]
    other = replace(shifted, time=shifted.time + 5.0)
    apart = replace(late, channels={**late.channels, "ctrl.elbow": other})
    with pytest.raises(RecordingError, match=r"ctrl.elbow begins 5.3 s after .* same moment"):
        cut(arm, [apart], horizon=10)


def test_no_window_begins_before_the_first_of_rare_commands(arm: Model) -> None:
    """What acted before a setpoint was first sent is not known, however rarely they are sent."""
    rare = [0.2, 0.4, 0.6]
    sent = kept(simulated(arm), "ctrl.elbow", lambda t: np.isclose(t[:, None], rare).any(axis=1))
    windows = cut(arm, [sent], horizon=10)
    assert windows.time.min() >= 0.2 - 0.005
    (note,) = windows.left_out
    assert "ctrl.elbow begins 0.2 s after the measurements" in note


def test_no_window_goes_on_after_its_controls_were_recorded(arm: Model) -> None:
    whole = simulated(arm)
    last = float(whole.channels["ctrl.elbow"].time[-1])
    cut_off = kept(whole, "ctrl.elbow", lambda t: t <= last - 0.3)
    windows, prediction = forecast(arm, cut_off, 10)
    np.testing.assert_allclose(prediction.values, windows.observed, atol=1e-13)
    (note,) = windows.left_out
    assert "ctrl.elbow ends 0.3 s before the measurements; 15 of 40 windows lack it" in note
    rare = [0.0, 0.005, 0.012, 0.03, 0.2, 0.21]  # sent where it changes, and held
    changing = kept(whole, "ctrl.elbow", lambda t: np.isclose(t[:, None], rare).any(axis=1))
    assert len(cut(arm, [changing], horizon=10)) == 40


def test_every_other_sample_is_predicted_over_two_steps(arm: Model) -> None:
    whole = simulated(arm)
    thinned = Recording(
        "thin",
        {
            n: c if n.startswith("ctrl") else Channel(c.time[::2], c.values[::2])
            for n, c in whole.channels.items()
        },
    )
    windows, prediction = forecast(arm, thinned, 5)
    assert windows.steps == 10
    np.testing.assert_allclose(prediction.values, windows.observed, atol=1e-13)


def test_instants_between_steps_are_met_to_third_order() -> None:
    """A free fall has q(t) = -g t²/2 exactly: the interpolation must reproduce it."""
    fall = Model.from_xml(
        "<mujoco><option timestep='0.01' integrator='RK4'/><worldbody><body><joint name='z' "
        "type='slide' axis='0 0 1'/><geom size='.1' mass='1'/></body></worldbody></mujoco>"
    )
    time = np.concatenate([[0.0], np.sort(np.random.default_rng(0).uniform(0.001, 0.3, 40))])
    recording = Recording.from_arrays(
        time, qpos={"z": -9.81 * time**2 / 2}, qvel={"z": -9.81 * time}
    )
    windows, prediction = forecast(fall, recording, 40)
    assert not windows.aligned
    np.testing.assert_allclose(prediction.values, windows.observed, atol=1e-12)


def test_a_control_that_changes_within_a_step_acts_by_its_mean() -> None:
    mass = Model.from_xml(
        "<mujoco><option timestep='0.01' gravity='0 0 0' integrator='RK4'/><worldbody><body><joint "
        "name='x' type='slide' axis='1 0 0'/><geom size='.1' mass='1'/></body></worldbody>"
        "<actuator><motor name='m' joint='x'/></actuator></mujoco>"
    )
    time = np.arange(21) * 0.01
    switch = 0.053
    v = np.clip(time - switch, 0, None)  # unit force from 53 ms on
    recording = Recording(
        "step",
        {
            "qpos.x": Channel(time, v**2 / 2),
            "qvel.x": Channel(time, v),
            "ctrl.m": Channel(np.array([0.0, switch]), np.array([0.0, 1.0]), hold="zero"),
        },
    )
    windows, prediction = forecast(mass, recording, 20)
    velocity = windows.channels.index("qvel.x")
    np.testing.assert_allclose(
        prediction.values[..., velocity], windows.observed[..., velocity], atol=1e-12
    )


@pytest.mark.parametrize("pause", [1.0, 60.0, 3600.0])
def test_no_velocity_is_estimated_across_a_pause(pause: float) -> None:
    arm = Model.from_xml(ARM.format(integrator="RK4"))
    whole = simulated(arm)
    late = np.where(np.arange(401) < 200, 0.0, pause)
    channels = {n: replace(c, time=c.time + late) for n, c in whole.channels.items()}
    moved = {  # by hand, while nothing was recorded
        n: replace(c, values=c.values + 0.5 * (late > 0)) if n.startswith("qpos.") else c
        for n, c in channels.items()
    }
    full = cut(arm, [replace(whole, channels=moved)], horizon=20)
    bare = {n: c for n, c in moved.items() if not n.startswith("qvel.")}
    windows = cut(arm, [replace(whole, channels=bare)], horizon=20)
    assert 200 in np.searchsorted(channels["qpos.elbow"].time, windows.time)
    np.testing.assert_allclose(windows.start.qvel, full.start.qvel, atol=2e-4)


FELT = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="x" axis="0 1 0"/>
  <geom size=".1" pos=".2 0 0" mass="1"/><site name="tip" pos=".2 0 0"/></body></worldbody>
  <actuator><motor name="m" joint="x"/></actuator>
  <sensor><jointactuatorfrc name="torque" joint="x"/><accelerometer name="felt" site="tip"/>
  </sensor></mujoco>"""


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("horizon", [1, 4, 20])
def test_forces_at_the_last_instant_are_those_of_the_control_from_then_on(
    horizon: int, every: int
) -> None:
    model = Model.from_xml(FELT)
    compiled = model.compile()
    data, rows = mujoco.MjData(compiled), []
    for k in range(1000):
        data.ctrl[:] = 2.0 * np.sin(0.04 * (k - k % every))
        state = (0.002 * k, *data.qpos, *data.qvel, *data.ctrl)
        mujoco.mj_step(compiled, data)
        rows.append([*state, *data.sensordata])
    time, *columns = np.array(rows)[::every].T
    names = ("qpos.x", "qvel.x", "ctrl.m", *model.sensor_channels)
    holds = ["zero" if n == "ctrl.m" else "none" for n in names]
    channels = {n: Channel(time, c, hold=h) for n, c, h in zip(names, columns, holds, strict=True)}
    windows = cut(model, [Recording("log", channels)], horizon=horizon)
    for part in (windows, windows.beginning(1)):
        (found,) = MujocoSimulator(model, (), Engine(1)).predictions(np.zeros((1, 0)), part)
        np.testing.assert_allclose(found.values, part.observed, atol=1e-9)


def test_a_sample_alone_between_pauses_is_at_rest_and_two_give_a_slope() -> None:
    steady = np.arange(50) * 0.01
    time = np.concatenate([steady, [60.0, 120.0, 120.01], 180.0 + steady])
    angle = 2.0 * time + 5.0 * np.sin(np.floor(time / 60.0))  # moved by hand in the pauses
    wheel = "<worldbody><body><joint/><geom size='1'/></body></worldbody>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{wheel}</mujoco>")
    fit = smooth(model, time, angle[:, None], np.array([50, 51, 52, 55]))
    np.testing.assert_allclose(fit.velocity[:, 0], [0.0, 2.0, 2.0, 2.0], atol=1e-9)


def test_a_noisy_joint_does_not_smear_a_quick_one_beside_it() -> None:
    time = np.arange(2000) * 0.01
    slow, quick = 0.5 * np.sin(2 * np.pi * 0.2 * time), 0.3 * np.sin(2 * np.pi * 4.0 * time)
    noisy = slow + 0.01 * np.random.default_rng(0).normal(size=len(time))
    wheels = "<body><joint/><geom size='1'/></body>" * 2
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{wheels}</worldbody></mujoco>")
    rows = np.arange(20, 1980, 20)
    alone = smooth(model, time, np.stack([slow, quick], axis=1), rows)
    fit = smooth(model, time, np.stack([noisy, quick], axis=1), rows)
    np.testing.assert_array_equal(fit.velocity[:, 1], alone.velocity[:, 1])
    true = 0.3 * 2 * np.pi * 4.0 * np.cos(2 * np.pi * 4.0 * time[rows])
    assert np.abs(fit.velocity[:, 1] - true).max() < 0.005 * np.abs(true).max()
    assert fit.samples[0] > 4 * fit.samples[1]  # and the noise is averaged as before
    steady = np.cos(2 * np.pi * 0.2 * time[rows]) * 0.5 * 2 * np.pi * 0.2
    assert np.std(fit.velocity[:, 0] - steady) < 0.06


def test_missing_velocities_are_estimated() -> None:
    arm = Model.from_xml(ARM.format(integrator="RK4"))  # Euler's qvel trails the slope of qpos
    with_velocity = cut(arm, [simulated(arm)], horizon=20)
    without = cut(arm, [simulated(arm, velocities=False)], horizon=20)
    np.testing.assert_allclose(without.start.qvel, with_velocity.start.qvel, atol=2e-4)
    assert "estimated" in without.notes[0]


def test_a_channel_with_its_own_clock_is_observed_at_its_own_instants(arm: Model) -> None:
    whole = simulated(arm)
    channels = dict(whole.channels)
    late = channels["qvel.elbow"]
    channels["qvel.elbow"] = Channel(late.time[::4], late.values[::4])
    windows = cut(arm, [Recording("two clocks", channels)], horizon=8)
    column = windows.observed[..., windows.channels.index("qvel.elbow")]
    assert np.isfinite(column).sum() == 2 * len(windows)  # every fourth of eight instants
    assert np.isfinite(windows.observed[..., 0]).all()


def two_rates(arm: Model, phase: float) -> Recording:
    """Positions at 50 Hz and a velocity at 500 Hz, all of them the model's own."""
    whole = simulated(arm)
    late = whole.channels["qvel.elbow"]
    slow = {n: Channel(c.time[::10], c.values[::10]) for n, c in whole.channels.items()
            if n.startswith("qpos")}  # fmt: skip
    fast = {"qvel.elbow": Channel(late.time + phase, late.values)}
    ctrl = {n: c for n, c in whole.channels.items() if n.startswith("ctrl")}
    return Recording("two rates", slow | fast | ctrl)


def test_windows_start_wherever_clocks_that_interleave_let_them(arm: Model) -> None:
    """Of 11 instants one has the positions: a window of 10 starts at each of them, not at a few."""
    windows = cut(arm, [two_rates(arm, 0.001)], horizon=10)
    np.testing.assert_allclose(windows.time, np.arange(40) * 0.02)
    assert any("39 of 442 instants are predicted by no window" in n for n in windows.left_out)
    wide = cut(arm, [two_rates(arm, 0.001)], horizon=10, stride=12)
    np.testing.assert_allclose(wide.time, np.arange(20) * 0.04)
    dense = cut(arm, [two_rates(arm, 0.001)], horizon=25, stride=1)
    np.testing.assert_allclose(dense.time, np.arange(38) * 0.02)
    assert not any("by no window" in n for n in dense.left_out)


@pytest.mark.parametrize("stride", [None, 3, 20])
def test_where_every_instant_is_complete_windows_start_every_stride(
    arm: Model, stride: int | None
) -> None:
    whole = simulated(arm)
    windows = cut(arm, [whole], horizon=10, stride=stride)
    rows = np.arange(0, 401 - 10, stride or 10)
    np.testing.assert_array_equal(windows.time, whole.channels["qpos.elbow"].time[rows])
    assert windows.notes == windows.left_out == ()


def test_positions_that_end_before_a_sensor_are_told(arm: Model) -> None:
    whole = simulated(arm)
    channels = {n: Channel(c.time[:201], c.values[:201]) if n.startswith("qpos") else c
                for n, c in whole.channels.items()}  # fmt: skip
    windows = cut(arm, [Recording("ends", channels)], horizon=10)
    np.testing.assert_allclose(windows.time, np.arange(21) * 0.02)
    assert windows.left_out == (
        "ends: 181 of 401 instants are predicted by no window, for one starts only where every "
        "joint position was recorded",
    )


def test_windows_do_not_span_gaps(arm: Model) -> None:
    whole = simulated(arm)
    keep = np.r_[0:150, 250:401]
    gappy = Recording(
        "gap",
        {n: Channel(c.time[keep], c.values[keep], hold=c.hold) for n, c in whole.channels.items()},
    )
    windows = cut(arm, [gappy], horizon=10)
    assert "gap" in windows.left_out[0]
    length = (windows.step + windows.fraction)[:, -1] * windows.timestep
    np.testing.assert_allclose(length, 0.02)


def test_long_windows_do_not_span_pauses_either(arm: Model) -> None:
    """Of .6 s, of which a third was not recorded, one was hardly longer than the others."""
    whole = simulated(arm, 1500)
    keep = np.r_[0:700, 800:1501]
    pausing = Recording(
        "pause",
        {n: Channel(c.time[keep], c.values[keep], hold=c.hold) for n, c in whole.channels.items()},
    )
    windows = cut(arm, [pausing], horizon=300)
    assert windows.left_out == (
        "pause: 1 of 4 windows span a gap in the recording and are left out",
    )
    length = (windows.step + windows.fraction)[:, -1] * windows.timestep
    np.testing.assert_allclose(length, 0.6)


def test_a_finer_simulation_sees_the_same_instants(arm: Model) -> None:
    windows, _ = forecast(arm, simulated(arm), 10)
    fine = cut(arm, [simulated(arm)], horizon=10, timestep=0.0005)
    assert fine.steps == 4 * windows.steps
    np.testing.assert_array_equal(fine.step, 4 * windows.step)
    np.testing.assert_allclose(fine.ctrl[:, ::4], windows.ctrl)


def test_recordings_of_other_rates_have_windows_that_last_as_long(arm: Model) -> None:
    """The slow one is cut as by itself; at what is left of the horizon nothing is observed."""
    fast = simulated(arm)
    slow = fast
    for name in fast.channels:
        slow = kept(slow, name, lambda t: slice(0, len(t), 10))
    windows = cut(arm, [fast, slow], horizon=[50, 5])
    by_itself = cut(arm, [slow], horizon=5)
    own = windows.recording == 1
    assert windows.observed.shape[:2] == (8 + len(by_itself), 50)
    assert windows.steps == by_itself.steps == 50
    np.testing.assert_array_equal(windows.observed[own, :5], by_itself.observed)
    np.testing.assert_array_equal(windows.step[own, :5], by_itself.step)
    assert np.isnan(windows.observed[own, 5:]).all()
    assert (windows.step[own, 5:] == 50).all()
    assert np.isfinite(windows.observed[~own]).all()


def test_what_the_model_needs_and_the_log_lacks_is_named(arm: Model) -> None:
    whole = simulated(arm)
    channels = {n: c for n, c in whole.channels.items() if n != "qpos.elbow"}
    with pytest.raises(RecordingError, match=r"no channel 'qpos.elbow'.*did you mean"):
        cut(arm, [Recording("r", channels)], horizon=1)
    channels = {n: c for n, c in whole.channels.items() if n != "ctrl.shoulder"}
    with pytest.raises(RecordingError, match=r"no channel 'ctrl.shoulder'"):
        cut(arm, [Recording("r", channels)], horizon=1)
    cut(arm, [Recording("r", channels)], horizon=1, controlled=["shoulder"])
    with pytest.raises(RecordingError, match="too few for a window of 900"):
        cut(arm, [whole], horizon=900)


def test_joints_that_are_all_said_to_be_unrecorded_are_told_with_the_key(
    arm: Model, tmp_path: Path
) -> None:
    (tmp_path / "arm.xml").write_text(ARM.format(integrator="implicitfast"))
    unrecorded = {"shoulder": None, "elbow": None}
    silent = Model.from_file(tmp_path / "arm.xml", unrecorded=unrecorded)
    with pytest.raises(RecordingError, match=r"no joint is left .*unrecorded: .* shoulder, elbow"):
        cut(silent, [simulated(arm)], horizon=10)


def test_many_candidates_in_one_call_equal_one_by_one(arm: Model) -> None:
    """Also in pieces: the memory budget changes nothing but the number of calls."""
    windows = cut(arm, [simulated(arm)], horizon=10)
    mass = Parameter("mass", ("geom[fore].mass",), 0.2, 0.9)
    points = np.linspace(0.2, 0.9, 7)[:, None]
    values = []
    for memory in (2**28, 60_000, 2_000):
        simulator = MujocoSimulator(arm, (mass,), Engine(), memory=memory)
        values.append(np.stack([p.values for p in simulator.predictions(points, windows)]))
    alone = [
        predicted(
            Layout.of(arm, arm.compile()),
            windows,
            Engine(threads=1).rollout(simulator.compile(p), windows.start, windows.ctrl),
        )
        for p in points
    ]
    for v in values:
        np.testing.assert_array_equal(v, alone)


def test_free_joint_velocity_is_estimated_in_mujocos_frames() -> None:
    body = Model.from_xml(
        "<mujoco><option timestep='0.001' gravity='0 0 -3'/><worldbody><body name='b'>"
        "<freejoint name='root'/><geom type='box' size='.1 .2 .3' mass='1'/></body></worldbody>"
        "</mujoco>"
    )
    start = State(
        np.array([[0, 0, 1, 1, 0, 0, 0.0]]), np.array([[0.3, 0, 1, 2, -1, 3.0]]), np.zeros((1, 0))
    )
    t = Engine().rollout(body.compile(), start, np.zeros((1, 300, 0)))
    recording = Recording.from_arrays(np.arange(301) * 0.001, qpos={"root": t.qpos[0]})
    windows = cut(body, [recording], horizon=20)
    rows = np.rint(windows.time / 0.001).astype(int)
    np.testing.assert_allclose(windows.start.qvel, t.qvel[0][rows], atol=6e-3)


TUMBLE = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
  <body><freejoint name="brick"/><geom type="box" size=".1 .06 .03" mass="1"/></body>
  <body pos="1 0 0"><joint name="wheel" type="ball"/><geom type="box" size=".1 .06 .03" mass="1"/>
  </body></worldbody></mujoco>"""


def test_what_is_no_orientation_is_refused_by_name_and_time() -> None:
    model = Model.from_xml(TUMBLE)
    pose = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (100, 1))
    turns = np.tile([0.6, 0.0, 0.8, 0.0], (100, 1))

    def tried(brick: np.ndarray, wheel: np.ndarray) -> None:
        kinds = {"brick": brick, "wheel": wheel}
        time = 2.0 + np.arange(100) * 0.01
        cut(model, [Recording.from_arrays(time, qpos=kinds, name="throw")], horizon=5)

    tried(pose, turns * np.linspace(0.97, 1.03, 100)[:, None])
    unknown = np.where(np.arange(100)[:, None] == 3, 0.0, pose)
    said = r"throw: qpos.brick.3 to qpos.brick.6 .* length 0 at 2.03 s; .*\(1 of 100 .*: leave such"
    with pytest.raises(RecordingError, match=said):
        tried(unknown, turns)
    said = r"qpos.wheel.0 to .* length 1.638e\+04 at 2 s; .* {qpos.wheel.0: {scale: 6.10352e-05}}"
    with pytest.raises(RecordingError, match=said):
        tried(pose, 16384 * turns)
    with pytest.raises(RecordingError, match=r"100 have another\): columns: .*scale: 0.952381"):
        tried(pose, 1.05 * turns)


def test_an_orientation_may_be_told_with_either_sign() -> None:
    """A free body and one on a ball joint turn more than once; the log says w >= 0."""
    model = Model.from_xml(TUMBLE)
    compiled = model.compile()
    qvel = np.array([[0, 0, 0, 9.0, 1.0, 2.0, 1.0, 11.0, 0.5]])
    start = State(compiled.qpos0[None], qvel, np.zeros((1, 0)))
    t = Engine(threads=1).rollout(compiled, start, np.zeros((1, 800, 0)))
    told = t.qpos[0].copy()
    for first in (3, 7):
        told[:, first : first + 4] *= np.where(told[:, first] < 0, -1.0, 1.0)[:, None]
    assert np.abs(told - t.qpos[0]).max() > 1.0
    channels = dict(zip(model.qpos_channels, told.T, strict=True))
    rates = dict(zip(model.qvel_channels, t.qvel[0].T, strict=True))
    time = np.arange(801) * 0.002
    both = {n: Channel(time, x) for n, x in {**channels, **rates}.items()}
    windows, prediction = forecast(model, Recording("tumbling", both), 100)
    assert np.abs(windows.observed - prediction.values).max() > 0.5
    assert np.abs(windows.residual(prediction.values)).max() < 1e-9


def test_joints_that_are_called_by_numbers_are_no_orientation() -> None:
    joints = "".join(
        f'<body><joint name="{k}" axis="1 0 0"/><geom size=".1" pos="0 0 -.3"/></body>'
        for k in range(1, 7)
    )
    model = Model.from_xml(f"<mujoco><worldbody>{joints}</worldbody></mujoco>")
    time = np.arange(20) * 0.01
    log = Recording.from_arrays(time, qpos={str(k): 0.1 * k + time for k in range(1, 7)})
    windows = cut(model, [log], horizon=3)
    expected = 2 * windows.observed
    np.testing.assert_array_equal(windows.residual(-windows.observed), expected)


def test_activations_are_those_of_the_actuators_that_are_told_something() -> None:
    """Friction with bristles has an activation and no control; here it stands before the motor."""
    stuck = (
        '<general name="stuck" joint="x" dyntype="dcmotor" dynprm="0 0 0 0 0 20 .1" input="none" '
        'gaintype="dcmotor" biastype="dcmotor" gainprm="1 1e-6" biasprm="0 0 0 .1 .15 .1" '
        'actdim="1" actearly="true"/>'
    )
    model = Model.from_xml(
        "<mujoco><worldbody><body><joint name='x' type='slide'/><geom size='.1'/></body>"
        f"</worldbody><actuator>{stuck}<general name='slow' joint='x' dyntype='filter' "
        "dynprm='.1'/></actuator></mujoco>"
    )
    time = np.arange(5) * 0.002
    motion = {"qpos": {"x": 0.0 * time}, "qvel": {"x": 0.0 * time}, "ctrl": {"slow": 0.0 * time}}
    recording = Recording.from_arrays(time, **motion, act={"slow": 3.0 + time})
    windows = cut(model, [recording], horizon=2)
    np.testing.assert_allclose(windows.start.act, [[0.0, 3.0], [0.0, 3.004]])


ACTING = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="a" type="slide" damping="3"/><geom size=".05" mass="1"/></body>
    <body pos="0 1 0"><joint name="b" type="slide" damping="3"/><geom size=".05" mass="1"/></body>
  </worldbody>
  <actuator>
    <general name="slow" joint="a" dyntype="filterexact" dynprm=".04" ctrlrange="-1 1"/>
    <intvelocity name="held" joint="b" kp="50" actrange="-2 2"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("plain", "other"),
    [
        ("", ""),
        ("<actuator>", '<actuator><dcmotor joint="a" input="none" motorconst="1e-9" '
         'resistance="1"/>'),  # without a control
        ('dynprm=".04"', 'dynprm=".04" actrange="-.3 .5"'),
        ('dynprm=".04"', 'dynprm=".04" delay=".006" nsample="7" interp="linear"'),
    ],
)  # fmt: skip
def test_activations_are_what_the_controls_before_led_to(plain: str, other: str) -> None:
    model = Model.from_xml(ACTING.replace(plain, other, 1) if plain else ACTING)
    plant = model.compile()
    data, rows = mujoco.MjData(plant), []
    data.qpos[1] = data.act[1] = 0.3
    for k in range(300):
        rows.append([0.01 * k, *data.qpos, *data.act])
        data.ctrl[:] = 1.5 * np.sin(0.2 * k), 0.4 * np.cos(0.05 * k)
        rows[-1] += [*data.ctrl]
        for _ in range(10):
            mujoco.mj_step(plant, data)
    time, a, b, slow, held, *ctrl = np.transpose(rows)
    motion = {"qpos": {"a": a, "b": b}, "ctrl": {"slow": ctrl[0], "held": ctrl[1]}}
    windows = cut(model, [Recording.from_arrays(time, **motion)], horizon=7)
    first = np.rint(100 * windows.time).astype(int)
    np.testing.assert_allclose(windows.start.act[1:, 0], slow[first][1:], atol=1e-9)
    np.testing.assert_allclose(windows.start.act[1:, 1], held[first][1:], atol=2e-4)  # balanced


LAGS = """<mujoco><option timestep=".002"/><worldbody><body><joint name="a" damping="1"/>
    <geom size=".1"/></body></worldbody><actuator>
    <general name="m" joint="a" dyntype="filterexact" dynprm=".05" delay="{}" nsample="9"/>
  </actuator></mujoco>"""


@pytest.mark.parametrize(("delay", "first"), [(0.0, 0.3), (0.016, 0.316)])
@pytest.mark.parametrize("told", [False, True])
def test_windows_begin_once_a_lag_forgot_what_was_sent_before(delay, first, told: bool) -> None:
    """A log that begins in the middle of a motion: six time constants, unless it is recorded."""
    model = Model.from_xml(LAGS.format(delay))
    time = 0.01 * np.arange(200)
    channels = {"qpos": {"a": np.sin(time)}, "ctrl": {"m": 3 + np.cos(4 * time)}}
    if told:
        channels["act"], first = {"m": 2 * time}, delay
    windows = cut(model, [Recording.from_arrays(time, **channels)], horizon=5)
    assert first <= windows.time[0] + 1e-9
    assert windows.time[0] < first + 0.05
    left_out = 39 - len(windows)
    assert left_out == np.ceil(first / 0.05 - 1e-9)
    assert bool(windows.left_out) == bool(left_out)


def test_a_short_log_is_not_left_out_for_what_a_lag_remembers() -> None:
    model = Model.from_xml(LAGS.format(0.0))
    time = 0.01 * np.arange(31)
    log = Recording.from_arrays(time, qpos={"a": np.sin(time)}, ctrl={"m": np.cos(time)})
    windows = cut(model, [log], horizon=5)
    np.testing.assert_allclose(windows.time, [0.15, 0.2, 0.25], atol=1e-9)  # three time constants


@pytest.mark.parametrize("clamp", ["enable", "disable"])
@pytest.mark.parametrize("limits", ['actrange="-.5 .5"', 'ctrlrange="-.4 .3"'])
def test_an_activation_that_integrates_stops_where_mujoco_stops_it(limits: str, clamp: str) -> None:
    """It leaves the end of its range as soon as its control turns."""
    flag = f'<option><flag clampctrl="{clamp}"/></option>'
    text = ACTING.replace('actrange="-2 2"', limits)
    model = Model.from_xml(text.replace("<worldbody>", f"{flag}<worldbody>", 1))
    plant = model.compile()
    data, rows = mujoco.MjData(plant), []
    for k in range(600):
        rate = (0.6, -0.6, 0.3)[k // 200]
        rows.append([0.01 * k, *data.qpos, data.act[1], 0.0, rate])
        data.ctrl[:] = 0.0, rate
        for _ in range(10):
            mujoco.mj_step(plant, data)
    time, a, b, held, *ctrl = np.transpose(rows)
    motion = {"qpos": {"a": a, "b": b}, "ctrl": {"slow": ctrl[0], "held": ctrl[1]}}
    windows = cut(model, [Recording.from_arrays(time, **motion)], horizon=7)
    expected = held[np.rint(100 * windows.time).astype(int)]
    np.testing.assert_allclose(windows.start.act[:, 1], expected, atol=1.5e-3)  # balanced
    turned = windows.time > 2.1  # from the end of its range on
    if "actrange" in limits:
        np.testing.assert_allclose(windows.start.act[turned, 1], expected[turned], atol=1e-9)


def test_a_torque_that_was_measured_acts_as_late_as_it_did() -> None:
    """A plant is stepped with a torque that never rests; a log has every tenth of its values."""
    model = Model.from_xml(ACTING.replace('ctrlrange="-1 1"', ""))
    plant = model.compile()
    data, rows = mujoco.MjData(plant), []
    for k in range(3000):
        told = 3.0 * np.sin(0.02 * k + np.array([0.0, 1.0]))
        if k % 10 == 0:
            rows.append([1e-3 * k, *data.qpos, data.act[1], *told])
        data.ctrl[:] = 3.0 * np.sin(0.02 * (k + 0.5) + np.array([0.0, 1.0]))  # a step's mean
        mujoco.mj_step(plant, data)
    time, a, b, integral, *ctrl = np.transpose(rows)
    errors = []
    for hold in ("zero", "linear"):
        inputs = {
            f"ctrl.{n}": Channel(time, u, hold=hold)
            for n, u in zip(("slow", "held"), ctrl, strict=True)
        }
        motion = {"qpos.a": Channel(time, a), "qpos.b": Channel(time, b)}
        motion["act.held"] = Channel(time, integral)
        windows, prediction = forecast(model, Recording(hold, {**motion, **inputs}), 20)
        errors.append(np.abs(windows.residual(prediction.values)[2:-2]).max())
    assert errors[1] < 0.1 * errors[0]


@pytest.mark.parametrize("horizon", [1, 10, 60])
@pytest.mark.parametrize(
    ("address", "true", "low", "high"),
    [("dynprm[0]", 0.08, 0.02, 0.12), ("delay", 0.006, 0.0, 0.01)],
)
def test_candidates_begin_with_the_activations_of_their_own_time_constants_and_delays(
    horizon: int, address: str, true: float, low: float, high: float
) -> None:
    """A window of one sample shows them by its start alone."""
    late = 'dynprm=".04" delay=".002" nsample="11" interp="linear"'
    xml = ACTING.replace('ctrlrange="-1 1"', "").replace('dynprm=".04"', late)
    spec = mujoco.MjSpec.from_string(xml)
    if address == "delay":
        spec.actuator("slow").delay = true
    else:
        spec.actuator("slow").dynprm[0] = true
    plant = spec.compile()
    data, rows = mujoco.MjData(plant), []
    told = np.repeat(np.random.default_rng(0).uniform(-3, 3, (40, 2)), 50, axis=0)
    told[:50] = 0.0  # as MuJoCo has what was before
    for k, u in enumerate(told):
        rows.append([1e-3 * k, *data.qpos, *data.qvel, *u, data.act[1]])
        data.ctrl[:] = u
        mujoco.mj_step(plant, data)
    time, a, b, va, vb, slow, held, integral = np.transpose(rows)
    recording = Recording.from_arrays(
        time,
        qpos={"a": a, "b": b},
        qvel={"a": va, "b": vb},
        ctrl={"slow": slow, "held": held},
        act={"held": integral},
    )
    model = Model.from_xml(xml)
    lag = Parameter("lag", (f"actuator[slow].{address}",), low, high, steps=6)
    windows = cut(model, [recording], horizon=horizon, parameters=[lag])
    found = MujocoSimulator(model, (lag,), Engine(1)).predictions(lag.grid[:, None], windows)
    off = [np.abs(windows.residual(f.values)).max() for f in found]
    assert lag.grid[np.argmin(off)] == pytest.approx(true)
    assert min(off) < 1e-9
    assert sorted(off)[1] > 1e-4


NUMBERED = """<mujoco><worldbody>
  <body><joint name="f.{0}"/><geom size=".1"/><body pos="0 0 1"><joint name="f.{1}"/>
    <geom size=".1"/><body pos="0 0 1"><joint name="f.{2}"/><geom size=".1"/><body pos="0 0 1">
      <joint name="f.{3}"/><geom size=".1"/></body></body></body></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("first", [0, 3])
def test_four_hinges_with_numbers_for_names_are_no_quaternion(first: int) -> None:
    model = Model.from_xml(NUMBERED.format(*range(first, first + 4)))
    time = np.arange(0, 0.1, 0.002)
    angles = {name: 0.3 + 0.1 * np.sin(20 * time) for name in model.joints}
    windows = cut(model, [Recording.from_arrays(time, qpos=angles)], horizon=5)
    np.testing.assert_allclose(windows.residual(-windows.observed), 2 * windows.observed)


def test_an_orientation_is_compared_with_its_nearer_sign() -> None:
    xml = '<mujoco><worldbody><body><joint name="b" type="ball"/><geom size=".1" pos=".1 0 0"/>'
    model = Model.from_xml(xml + "</body></worldbody></mujoco>")
    time = np.arange(0, 0.1, 0.002)
    half = 0.5 * time
    turned = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=1)
    windows = cut(model, [Recording.from_arrays(time, qpos={"b": turned})], horizon=5)
    np.testing.assert_allclose(windows.residual(-windows.observed), 0.0, atol=1e-15)
