"""Joints that MuJoCo's soft equalities tie: how far they open, and windows that begin open."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.windowing import nothing, prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.loops import Loops
from bo_sysid.recording import Recording

SIGMA, EVERY, STEP = 1e-4, 0.01, 0.00025
XML = """<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody><body><joint name="left" axis="0 1 0" damping=".05"/>
<geom size=".03" pos="0 0 -.3" mass="1"/></body>
<body pos="0 .5 0"><joint name="right" axis="0 1 0" damping=".05"/>
<geom size=".03" pos="0 0 -.3" mass="1"/></body></worldbody>
<equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0" solref="{tau} 1"/></equality>
<actuator><motor name="grip" joint="left"/></actuator></mujoco>"""
JOINT = '<joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"'
ROPE = '<tendon tendon1="rope"'  # left + right stays as it is
TWO = '<tendon tendon1="r" tendon2="l" polycoef="0 -2 0 0 0"'
TENDONS = """<tendon><fixed name="rope"><joint joint="left" coef="1"/>
<joint joint="right" coef="1"/></fixed><fixed name="r"><joint joint="right" coef="2"/></fixed>
<fixed name="l"><joint joint="left" coef="1"/></fixed>
<spatial name="space"><site site="a"/><site site="b"/></spatial></tendon>"""


def tied(tau: float, by: str) -> str:
    """The machine with another tie."""
    xml = XML.format(tau=tau).replace(JOINT, by).replace("<equality>", TENDONS + "<equality>")
    sites = '<worldbody><site name="a" pos=".1 0 0"/><body><site name="b" pos="0 0 -.2"/>'
    return xml.replace("<worldbody><body>", sites)


@pytest.mark.parametrize("tau", [0.015, 0.02])
def test_a_tie_opens_under_load_by_what_its_constant_says(tau: float) -> None:
    model = mujoco.MjModel.from_xml_string(XML.format(tau=tau))
    data, load = mujoco.MjData(model), 0.1
    data.qfrc_applied[:] = load  # against each other: the tie is right + left = 0
    for _ in range(1000):
        mujoco.mj_step(model, data)
    held = 2 * load / (0.3**2 + 0.4 * 0.03**2)  # of two balls at arms
    d, most = model.eq_solimp[0, :2]
    opens = tau**2 * most**2 * (1 - d) / d**2 * held
    assert data.qpos.sum() == pytest.approx(opens, rel=0.02)


def test_joints_yield_where_their_tie_is_slow() -> None:
    for tau, yields in ((0.004, set()), (0.02, {"right"})):
        loops = Loops.of(mujoco.MjModel.from_xml_string(XML.format(tau=tau)))
        assert loops.mirrored == {"right": "left"}
        assert loops.yielding == yields
    assert loops.released({"left"}).joints == ("right",)
    assert not loops.released({"right"})


@pytest.mark.parametrize("by", [ROPE, TWO])
def test_fixed_tendons_tie_two_joints_as_an_equality_of_joints_does(by: str) -> None:
    for tau, yields in ((0.004, set()), (0.02, {"right"})):
        loops = Loops.of(mujoco.MjModel.from_xml_string(tied(tau, by)))
        assert loops.mirrored == {"right": "left"}
        assert loops.yielding == yields


@pytest.mark.parametrize(
    "by", ['<tendon tendon1="space"', '<tendon tendon1="l"',
           '<tendon tendon1="r" tendon2="l" polycoef="0 -2 1 0 0"']
)  # fmt: skip
def test_tendons_in_space_of_one_joint_or_curved_tie_nothing_in_proportion(by: str) -> None:
    loops = Loops.of(mujoco.MjModel.from_xml_string(tied(0.02, by)))
    assert (loops.mirrored, loops.yielding) == ({}, frozenset())


def exact(tau: float, by: str = JOINT) -> Evidence:
    """What the model itself does at a finer step, of a quarter of a millisecond."""
    plant = mujoco.MjModel.from_xml_string(tied(tau, by))
    plant.opt.timestep = STEP
    data, rng = mujoco.MjData(plant), np.random.default_rng(1)
    time = EVERY * np.arange(600)
    u = np.repeat(rng.uniform(-4, 4, 60), 10)
    q = np.zeros((600, 2))
    for k in range(600):
        q[k], data.ctrl[0] = data.qpos, u[k]
        mujoco.mj_step(plant, data, nstep=40)
    q += rng.normal(0, SIGMA, q.shape)
    recording = Recording.from_arrays(
        time, qpos={"left": q[:, 0], "right": q[:, 1]}, ctrl={"grip": u}
    )
    return make_evidence(
        Model.from_xml(tied(tau, by)), [recording], noise={"qpos": SIGMA}, threads=1,
        effects=[CATALOGUE["dry_friction"]],
    )  # fmt: skip


def left(problem: Problem) -> float:
    """Return what the model leaves of its own motion, in sigma."""
    prepared = prepare(problem)
    p = prepared.problem
    r = project(prepared.linear.Q, p.residual(nothing(p), prepared.start))
    return float(np.sqrt((r**2).sum() / p.dof))


@pytest.mark.parametrize("by", [JOINT, ROPE])
def test_windows_begin_with_a_slow_tie_as_open_as_it_was(by: str) -> None:
    evidence = exact(0.02, by)
    problem = windows_of(evidence, 12, STEP, everything=True)
    assert not problem.loops
    assert left(problem) == pytest.approx(1.0, abs=0.05)
    assert left(replace(problem, loops=evidence.model.loops)) > 1.2


def test_windows_begin_with_a_quick_tie_closed() -> None:
    problem = windows_of(exact(0.004), 12, STEP, everything=True)
    assert problem.loops.joints == ("right",)
    assert left(problem) == pytest.approx(1.0, abs=0.05)
