"""Windows of actuators with a lag of their own begin as a hypothesis has it, by plain MuJoCo."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.signatures import signatures
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import linearise, project
from bo_sysid.effects.memory import activation
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording

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
    start, x = problem.windows.start, 0.3 * c.point
    linear = linearise(problem, Hypothesis(), start)
    signature = signatures(linear, [c])[..., 0].astype(float)
    moved = problem.residual(Hypothesis(), start) - problem.residual(Hypothesis((c,), (x,)), start)
    exact = project(linear.Q, moved) / x[0]
    assert np.linalg.norm(signature - exact) < 0.1 * np.linalg.norm(exact)


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


def test_an_integrator_begins_where_its_joint_is_first_seen() -> None:
    """A part of a log has its controls from the log's beginning, and positions of the part."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.002"/><worldbody><body><joint name="h" damping="1"/>'
        '<geom size=".02" pos=".3 0 0" mass="1"/></body></worldbody><actuator>'
        '<intvelocity name="m" joint="h" kp="50" kv="2" actrange="-9 9"/></actuator></mujoco>'
    )
    data, time = mujoco.MjData(model), np.arange(0.0, 10.0, 0.01)
    ctrl, q, act = 0.5 + np.sin(time), np.zeros(len(time)), np.zeros(len(time))
    for k, u in enumerate(ctrl):
        q[k], act[k], data.ctrl[0] = data.qpos[0], data.act[0], u
        mujoco.mj_step(model, data, 5)
    whole = Recording.from_arrays(time, qpos={"h": q}, ctrl={"m": ctrl})
    at = np.array([8.0, 9.5])
    np.testing.assert_allclose(activation(model, whole, 0, at), act[[800, 950]], atol=1e-5)
    part = whole.between(7.5, 9.9)
    assert part.channels["ctrl.m"].time[0] == 0.0
    lead = act[750] - q[750]  # by which the activation is ahead of the joint that follows it
    np.testing.assert_allclose(activation(model, part, 0, at), act[[800, 950]] - lead, atol=1e-5)
    assert abs(lead) < 0.2
