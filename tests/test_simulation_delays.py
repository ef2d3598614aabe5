"""Windows of machines whose actuators or sensors are late, and what was before them."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import CATALOGUE, Site, survey
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine, ForceLaw, MujocoSimulator, State
from bo_sysid.simulation.cutting import cut
from bo_sysid.simulation.delays import load_past, remembered_steps
from bo_sysid.simulation.lockstep import force_laws

STEP = 0.002
TWO = """<mujoco><option timestep="0.002"/><worldbody><body><joint name="a" axis="0 1 0"/>
<geom size=".05" pos="0 0 -.5" mass="1"/><body pos="0 0 -1"><joint name="b" axis="0 1 0"/>
<geom size=".05" pos="0 0 -.5" mass="1"/></body></body></worldbody><actuator>
<motor name="prompt" joint="b"/>
<motor name="late" joint="a" delay=".0071" nsample="5" interp="linear"/>
</actuator></mujoco>"""


def model() -> Model:
    return Model.from_xml(TWO)


def recorded() -> Recording:
    """The motion that plain MuJoCo computes from its own start on, without noise."""
    compiled = model().compile()
    data, steps = mujoco.MjData(compiled), 600
    time = np.arange(steps) * STEP
    ctrl = np.stack([np.cos(7 * time), 3 * np.sin(40 * time)], axis=1)
    q, v = np.zeros((steps, 2)), np.zeros((steps, 2))
    for k in range(steps):
        q[k], v[k] = data.qpos, data.qvel
        data.ctrl[:] = ctrl[k]
        mujoco.mj_step(compiled, data)
    return Recording.from_arrays(
        time,
        qpos={"a": q[:, 0], "b": q[:, 1]},
        qvel={"a": v[:, 0], "b": v[:, 1]},
        ctrl={"prompt": ctrl[:, 0], "late": ctrl[:, 1]},
    )


@pytest.mark.parametrize(("horizon", "steps"), [(1, 1), (3, 1), (40, 1), (1, 2), (3, 2)])
def test_windows_repeat_the_motion_from_the_middle_of_a_recording(horizon: int, steps: int) -> None:
    recording = recorded()
    windows = cut(model(), [recording], horizon=horizon, timestep=STEP / steps)
    simulator = MujocoSimulator(model(), (), Engine(1), timestep=STEP / steps)
    (found,) = simulator.predictions(np.zeros((1, 0)), windows)
    off = np.nanmax(np.abs(windows.residual(found.values)), axis=(1, 2))
    moved = np.ptp(recording.channels["qvel.a"].values)
    assert off[1:].max() < (1e-9 if steps == 1 else 0.02) * moved
    nothing = cut(model(), [recording], horizon=horizon, timestep=STEP / steps)
    nothing.start.past[:] = 0.0
    (wrong,) = simulator.predictions(np.zeros((1, 0)), nothing)
    without = np.nanmax(np.abs(windows.residual(wrong.values)))
    assert without > 1e-3 * moved
    assert without > 3 * off[1:].max()


ONE = """<mujoco><option timestep="0.004" gravity="0 0 0"/><worldbody><body><joint name="a"
damping=".1"/><geom size=".05" pos=".3 0 0" mass="1"/></body></worldbody><actuator>
<motor name="late" joint="a"{late}/></actuator></mujoco>"""


@pytest.mark.parametrize(("more", "finer"), [(0.0, 1), (0.0, 4), (0.008, 1), (0.008, 4)])
def test_a_hypothesis_knows_what_was_commanded_before_its_windows(more: float, finer: int) -> None:
    """At the model's step and at a finer one, also with a further delay, as plain MuJoCo."""
    plant = mujoco.MjModel.from_xml_string(ONE.format(late=""))  # it is told late instead
    plant.opt.timestep = 0.004 / finer
    data, time = mujoco.MjData(plant), np.arange(0, 3, 0.004)
    u = np.repeat(np.random.default_rng(0).normal(size=len(time) // 5), 5)
    q, v = np.zeros((2, len(time)))
    delayed = np.concatenate([np.zeros(round((0.032 + more) / 0.004)), u])[: len(time)]
    for k in range(len(time)):
        q[k], v[k], data.ctrl[0] = data.qpos[0], data.qvel[0], delayed[k]
        mujoco.mj_step(plant, data, finer)
    recording = Recording.from_arrays(time, qpos={"a": q}, qvel={"a": v}, ctrl={"late": u})
    late = Model.from_xml(ONE.format(late=' delay=".032" nsample="9"'))
    evidence = make_evidence(late, [recording], noise={"qpos": 1e-6}, threads=1)
    problem = windows_of(evidence, 20, 0.004)
    c = next(c for c in evidence.candidates if c.effect.id == "actuator_delay")
    hypothesis = Hypothesis((c,), (np.array([more]),)) if more else Hypothesis()
    left = problem.residual(hypothesis, problem.windows.start, finer)
    assert np.abs(left[1:]).max() < 1e-3  # sigma


def test_buffers_hold_the_commands_of_the_last_steps() -> None:
    """As MuJoCo's own call fills them."""
    from mujoco.batch import Batch

    compiled = model().compile()
    assert remembered_steps(compiled) == 5
    batch, data = Batch(compiled, nsim=2, nthread=1), mujoco.MjData(compiled)
    past = np.arange(2 * 7 * 2, dtype=float).reshape(2, 7, 2)
    load_past(compiled, batch.bind("history"), past)
    for row in (0, 1):
        own = np.ascontiguousarray(past[row, -5:, 1:])
        mujoco.mj_initCtrlHistory(compiled, data, compiled.actuator("late").id, None, own)
        np.testing.assert_array_equal(batch.bind("history")[row], data.history)


def told_late(delay: float) -> Recording:
    """What plain MuJoCo computes of `ONE` with a delay in [s] and a buffer that is long enough."""
    late = f' delay="{delay}" nsample="40" interp="linear"'
    plant = mujoco.MjModel.from_xml_string(ONE.format(late=late))
    data, time = mujoco.MjData(plant), np.arange(0, 3, 0.004)
    u = np.repeat(np.random.default_rng(0).normal(size=len(time) // 5), 5)
    q, v = np.zeros((2, len(time)))
    for k in range(len(time)):
        q[k], v[k], data.ctrl[0] = data.qpos[0], data.qvel[0], u[k]
        mujoco.mj_step(plant, data)
    return Recording.from_arrays(time, qpos={"a": q}, qvel={"a": v}, ctrl={"late": u})


LONGER = Parameter("delay", ("actuator[late].delay",), 0.005, 0.065, steps=7)


@pytest.mark.parametrize("late", ["", ' delay=".005" nsample="3" interp="linear"'])
def test_a_candidate_may_have_a_longer_delay_than_its_models_buffer(late: str) -> None:
    """The model's buffer holds 8 ms at most, or nothing: every candidate would be as late."""
    model = Model.from_xml(ONE.format(late=late or ' interp="linear"'))
    windows = cut(model, [told_late(0.035)], horizon=10, parameters=[LONGER])
    simulator = MujocoSimulator(model, (LONGER,), Engine(1))
    found = simulator.predictions(LONGER.grid[:, None], windows)
    off = [np.abs(windows.residual(f.values)[6:]).max() for f in found]
    assert LONGER.grid[np.argmin(off)] == pytest.approx(0.035)
    assert min(off) < 1e-9
    assert sorted(off)[1] > 1e-3


def test_diagnosis_follows_a_parameter_that_is_a_longer_delay() -> None:
    late = Model.from_xml(ONE.format(late=' delay=".005" nsample="3" interp="linear"'))
    evidence = make_evidence(
        late, [told_late(0.035)], parameters=[LONGER], noise={"qpos": 1e-6}, threads=1
    )
    problem = windows_of(evidence, 20, 0.004)
    start, nuisances = problem.windows.start, evidence.nuisances
    sets = [Hypothesis((), (), nuisances, (np.array([x]),)) for x in LONGER.grid - 0.005]
    left = [problem.residual(h, start)[3:] for h in sets]
    off = [np.abs(r).max() for r in left]
    assert np.argmin(off) == 3
    assert min(off) < 1e-3  # sigma


@pytest.mark.parametrize("delay", [0.02, 0.0191])
@pytest.mark.parametrize("interp", ["zoh", "linear"])
@pytest.mark.parametrize(("horizon", "every"), [(30, 1), (30, 3), (1, 1)])
def test_what_a_late_sensor_shows_of_before_a_window_is_not_compared(
    delay: float, interp: str, horizon: int, every: int
) -> None:
    late = f'delay="{delay}" nsample="12" interp="{interp}"'
    sensing = Model.from_xml(
        TWO.replace(' delay=".0071" nsample="5" interp="linear"', "")
        .replace("<geom", '<site name="tip" pos="0 0 -1"/><geom', 1)
        .replace(
            "</mujoco>",
            f'<sensor><framepos name="far" objtype="site" objname="tip" {late}/>'
            '<jointpos name="angle" joint="a"/></sensor></mujoco>',
        )
    )
    compiled = sensing.compile()
    data, rows = mujoco.MjData(compiled), []
    for k in range(600):
        data.ctrl[:] = np.cos(0.02 * k), 3 * np.sin(0.08 * k)
        state = (k * STEP, *data.qpos, *data.qvel, *data.ctrl)
        mujoco.mj_step(compiled, data)
        rows.append([*state, *data.sensordata])
    names = (*sensing.qpos_channels, *sensing.qvel_channels, *sensing.ctrl_channels)
    columns = np.array(rows)[20:].T
    kept = {
        n: Channel(columns[0], x, hold="zero")
        if n.startswith("ctrl")
        else Channel(columns[0, ::every], x[::every])
        for n, x in zip((*names, *sensing.sensor_channels), columns[1:], strict=True)
    }
    windows = cut(sensing, [Recording("log", kept)], horizon=horizon)
    (found,) = MujocoSimulator(sensing, (), Engine(1)).predictions(np.zeros((1, 0)), windows)
    assert np.nanmax(np.abs(windows.residual(found.values))) < 1e-9
    seen = np.isfinite(windows.observed)
    far = [n.startswith("sensor.far") for n in windows.channels]
    assert seen[..., np.logical_not(far)].all()
    shown = (windows.step + windows.fraction) * STEP >= delay - 1e-9
    np.testing.assert_array_equal(seen[..., far], np.repeat(shown[..., None], 3, axis=2))
    told = [n for n in windows.left_out if "what was before it, by the sensor's delay" in n]
    assert len(told) == 3


@pytest.mark.parametrize(
    ("delay", "samples", "interp"),
    [(0.0071, 5, "linear"), (0.008, 3, "zoh"), (0.0071, 7, "zoh"), (0.003, 2, "linear")],
)
def test_a_law_sees_the_control_that_a_delayed_actuator_acts_on(
    delay: float, samples: int, interp: str
) -> None:
    """A law that undoes what the motor does leaves a joint at rest, to the last bit."""
    late = f' delay="{delay}" nsample="{samples}" interp="{interp}" ctrlrange="-1 1"'
    compiled = Model.from_xml(ONE.format(late=late).replace('damping=".1"', "")).compile()
    u, none = np.random.default_rng(0).normal(size=(2, 40, 1)), np.zeros((2, 1))
    past = np.random.default_rng(1).normal(size=(2, samples, 1))
    start = State(none, none, np.zeros((2, 0)), past=past)
    against = ForceLaw("a", lambda i: -i.act["late"])
    moved = Engine(1).rollout(compiled, start, u)
    assert np.abs(moved.qvel[:, -1]).min() > 1e-3
    still = Engine(1).rollout(compiled, start, u, laws=[against])
    assert np.abs(still.qvel).max() < 1e-15


def test_friction_grows_with_the_load_that_a_delayed_motor_makes() -> None:
    """A late motor with load-dependent friction moves as one that is told late."""
    time = np.arange(0, 2, 0.004)
    told = np.sin(9 * time) + 0.5 * np.sin(23 * time)
    late = np.concatenate([np.zeros(3), told])[: len(time)]
    moved = []
    for attributes, sent in ((' delay=".012" nsample="4" interp="linear"', told), ("", late)):
        model = Model.from_xml(ONE.format(late=attributes))
        recording = Recording.from_arrays(time, qpos={"a": 0 * time}, ctrl={"late": sent})
        machine = survey(model.compile(), [recording])
        effect = CATALOGUE["load_dependent_friction"]
        spec = model.spec()
        part = effect.apply(spec, Site("joint", "a"), np.array([0.2]), machine)
        laws = force_laws([part])
        start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
        moved.append(Engine(1).rollout(spec.compile(), start, sent[None, :, None], laws=laws).qpos)
    assert np.ptp(moved[1]) > 0.01
    assert np.abs(moved[0] - moved[1]).max() < 1e-9 * np.ptp(moved[1])
