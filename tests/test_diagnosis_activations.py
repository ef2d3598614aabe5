"""Windows of actuators with a lag of their own begin as a hypothesis has it, by plain MuJoCo."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.signatures import signatures
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.effects.memory import activation
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation.activations import activations

STEP, LAG, LATE = 0.002, 0.08, 15
XML = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body><joint name="a"
damping=".1"/><geom size=".05" pos=".3 0 0" mass="1"/></body></worldbody><actuator>
<general name="drive" joint="a" dyntype="filterexact" dynprm="{lag}"/></actuator></mujoco>"""


def recorded(lag: float, late: int, dead: float = 0.0) -> Recording:
    """What plain MuJoCo does with commands that arrive `late` steps later, less a dead zone."""
    plant = mujoco.MjModel.from_xml_string(XML.format(lag=lag))
    data, time = mujoco.MjData(plant), np.arange(0, 5, STEP)
    u = np.repeat(np.random.default_rng(0).uniform(-3, 3, len(time) // 50), 50)
    told = np.concatenate([np.full(late, u[0]), u])
    told = told - np.clip(told, -dead, dead)
    data.act[0], q, v = told[0], np.zeros(len(time)), np.zeros(len(time))
    for k in range(len(time)):
        q[k], v[k], data.ctrl[0] = data.qpos[0], data.qvel[0], told[k]
        mujoco.mj_step(plant, data)
    return Recording.from_arrays(time, qpos={"a": q}, qvel={"a": v}, ctrl={"drive": u})


def evidence_of(recording: Recording, parameters: tuple[Parameter, ...] = ()) -> Evidence:
    return make_evidence(
        Model.from_xml(XML.format(lag=LAG)),
        [recording],
        parameters=parameters,
        noise={"qpos": 1e-6},
        threads=1,
    )


@pytest.mark.parametrize(
    ("effect", "x", "late", "dead"),
    [("actuator_delay", LATE * STEP, LATE, 0.0), ("actuator_deadzone", 0.5, 0, 0.5)],
)
def test_a_filter_before_a_lag_changes_the_activations_of_windows(effect, x, late, dead) -> None:
    evidence = evidence_of(recorded(LAG, late, dead))
    problem = windows_of(evidence, 20, STEP)
    c = next(c for c in evidence.candidates if c.effect.id == effect)
    start = problem.windows.start
    off, nominal = (
        np.abs(problem.residual(h, start)).max()
        for h in (Hypothesis((c,), (np.array([x]),)), Hypothesis())
    )
    assert off < 1e-3  # sigma
    assert nominal > 100


@pytest.mark.parametrize("effect", ["actuator_delay", "load_dependent_friction"])
def test_signatures_beside_a_lag_are_the_difference_of_two_simulations(effect: str) -> None:
    evidence = evidence_of(recorded(LAG, LATE))
    problem = windows_of(evidence, 20, STEP)
    c = next(c for c in evidence.candidates if c.effect.id == effect)
    start, x = problem.windows.start, c.point
    linear = linearise(problem, Hypothesis(), start)
    signature = signatures(linear, [c])[..., 0].astype(float)
    moved = problem.residual(Hypothesis(), start) - problem.residual(Hypothesis((c,), (x,)), start)
    exact = project(linear.Q, moved) / x[0]
    assert np.linalg.norm(signature - exact) < 1e-3 * np.linalg.norm(exact)


def test_a_time_constant_that_is_a_parameter_changes_the_activations_of_windows() -> None:
    tau = Parameter("lag", ("actuator[drive].dynprm[0]",), 0.02, 0.2)
    evidence = evidence_of(recorded(0.05, 0), (tau,))
    problem = windows_of(evidence, 20, STEP)
    off = [
        np.abs(problem.residual(at(evidence, lag), problem.windows.start)).max()
        for lag in (0.04, 0.05, LAG)
    ]
    assert off[1] < 1e-3  # sigma
    assert min(off[0], off[2]) > 10


def at(evidence: Evidence, lag: float) -> Hypothesis:
    return Hypothesis((), (), evidence.nuisances, (np.array([lag - LAG]),))


LOADED = """<mujoco><option timestep="0.002"/><worldbody><body name="link">
<joint name="h" axis="0 1 0" damping=".1" armature=".01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="{mass}"/></body></worldbody><actuator>
<intvelocity name="m" joint="h" kp="50" kv="2" {more}/></actuator></mujoco>"""
NOISE = 5e-4  # [rad]


def moved_by_a_servo(
    mass: float = 1.0, more: str = "", noise: float = NOISE
) -> tuple[Recording, np.ndarray]:
    """A servo that carries a link away from its rest, and its activation."""
    plant = mujoco.MjModel.from_xml_string(LOADED.format(mass=mass, more=more))
    data, time = mujoco.MjData(plant), np.arange(0.0, 10.0, 0.01)
    data.qpos[0] = data.act[0] = 0.8
    mujoco.mj_step(plant, data, 1000)  # it sags under the load
    q, act = np.zeros(len(time)), np.zeros(len(time))
    rates = np.random.default_rng(1).uniform(0.2, 1.0, 3)
    ctrl = sum(0.5 * np.sin(r * (2 + 3 * k) * time + k) for k, r in enumerate(rates))
    for k, u in enumerate(ctrl):
        q[k], act[k], data.ctrl[0] = data.qpos[0], data.act[0], u
        mujoco.mj_step(plant, data, 5)
    q += noise * np.random.default_rng(0).standard_normal(len(q))
    return Recording.from_arrays(time, qpos={"h": q}, ctrl={"m": ctrl}), act


@pytest.mark.parametrize("more", ["", 'actrange="-.1 1"'])
@pytest.mark.parametrize("begin", [0, 750])
def test_an_integrator_begins_where_its_forces_balance(more: str, begin: int) -> None:
    """It holds the load beside where its joint is, and one sample is off by its noise."""
    whole, act = moved_by_a_servo(more=more)
    part = whole.between(0.01 * begin, 9.99)
    model = mujoco.MjModel.from_xml_string(LOADED.format(mass=1.0, more=more))
    at = np.array([0, 40, 200])
    off = activation(model, part, 0, 0.01 * (at + begin)) - act[at + begin]
    assert np.abs(off).max() < NOISE * (0.2 if not more else 1.0)  # soon at an end of its range
    sagged = act[begin] - whole.channels["qpos.h"].values[begin]
    assert abs(sagged) > 10 * NOISE


def test_an_integrator_balances_what_a_hypothesis_has_it_carry() -> None:
    """A load that is found moves the activation; a constant force cannot be told from it."""
    recording, _ = moved_by_a_servo(1.3)
    mass = Parameter("mass", ("geom[0].mass",), 0.5, 2.0)
    evidence = make_evidence(
        Model.from_xml(LOADED.format(mass=1.0, more="").replace("<geom ", '<geom name="0" ')),
        [recording], parameters=(mass,), noise={"qpos": NOISE}, threads=1,
    )  # fmt: skip
    problem = windows_of(evidence, 20, STEP)
    at = {c.effect.id: c for c in evidence.candidates}
    start = problem.windows.start

    def left(x: float, f: float, effect: str = "constant_force") -> float:
        sizes = (np.full(at[effect].size, f),)
        h = Hypothesis((at[effect],), sizes, evidence.nuisances, (np.array([x]),))
        r = project(linearise(problem, h, start).Q, problem.residual(h, start))
        return float(np.sqrt((r**2).sum() / problem.dof))

    assert left(0.3, 0.0) < 1.05
    assert left(0.0, 0.0) > 1.2
    assert left(0.3, 0.5) == pytest.approx(left(0.3, 0.0), rel=0.02)
    passive = left(0.3, 1e-9, "cogging")  # an actuator that drives nothing
    assert passive == pytest.approx(left(0.3, 0.0), rel=0.02)


DRIVES = {
    "muscle": '<muscle name="m" joint="h" gear=".1" force="60" lengthrange="-.2 .2"/>',
    "current": '<dcmotor name="m" joint="h" gear="10" motorconst=".05" resistance=".5" '
    'inductance=".01 0"/>',
}


@pytest.mark.parametrize("kind", list(DRIVES))
def test_muscles_and_currents_follow_the_recorded_motion(kind: str) -> None:
    """Against plain MuJoCo; settled at the control they would be off by a tenth and more."""
    servo = LOADED[LOADED.index("<intvelocity") : LOADED.index("</actuator>")]
    xml = LOADED.replace(servo, DRIVES[kind]).format(mass=1.0)
    model = Model.from_xml(xml)
    plant = model.compile()
    data, time = mujoco.MjData(plant), np.arange(0.0, 6.0, 0.01)
    q, act = np.zeros(len(time)), np.zeros(len(time))
    told = 0.35 + 0.3 * np.sin(9.0 * time) * np.sin(0.7 * time)
    told = told if kind == "muscle" else 6.0 * (told - 0.35)
    for k, u in enumerate(told):
        q[k], act[k], data.ctrl[0] = data.qpos[0], data.act[0], u
        mujoco.mj_step(plant, data, 5)
    recording = Recording.from_arrays(time, qpos={"h": q}, ctrl={"m": told})
    at = np.arange(100, 500, 7)
    windows = [activations(model, plant, recording, time[at], told[at][:, None, None])[:, 0]]
    off, settled = (np.abs(x - act[at]).max() for x in (windows[0], told[at]))
    assert off < 0.03 * np.abs(act).max()
    assert settled > 0.1 * np.abs(act).max()


def test_an_integrator_does_not_balance_gravity_that_its_actuator_compensates() -> None:
    text = LOADED.format(mass=1.0, more="").replace("<body", '<body gravcomp=".7"')
    plant = mujoco.MjModel.from_xml_string(
        text.replace("<joint ", '<joint actuatorgravcomp="true" ')
    )
    data, time = mujoco.MjData(plant), np.arange(0.0, 3.0, 0.01)
    data.qpos[0] = data.act[0] = 0.8
    mujoco.mj_step(plant, data, 1000)
    q, act, rate = np.zeros(len(time)), np.zeros(len(time)), 0.5 * np.sin(2 * time)
    for k, u in enumerate(rate):
        q[k], act[k], data.ctrl[0] = data.qpos[0], data.act[0], u
        mujoco.mj_step(plant, data, 5)
    log = Recording.from_arrays(time, qpos={"h": q}, ctrl={"m": rate})
    assert activation(plant, log, 0, time[:1]) == pytest.approx(act[:1], abs=0.2 * NOISE)
