"""What goes by the machine as it turned out to be, and not by the given model."""

import numpy as np
import pytest
from diagnosis_helpers import arm, candidate, posed, record

from bo_sysid.diagnosis.answer.experiment import _Bounds, _kept, _motions
from bo_sysid.diagnosis.frozen import _fitted
from bo_sysid.diagnosis.sets.refit import refit
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE, Site
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.study.outer import Limit


def test_a_proposed_motion_keeps_efforts_of_motors_that_are_stronger_than_the_model() -> None:
    """The elbow's motor turned out to give 60 % more than the model has it."""
    lacks = record([("actuator_gain", "actuator", "elbow", [0.6])], duration=3.0)
    problem, machine = posed(lacks)
    gain = candidate(machine, "actuator_gain", "elbow")
    fit = refit(prepare(problem).linear, [gain], [np.array([0.5])])
    limits = {"elbow": Limit(effort=0.2), "shoulder": Limit(effort=0.8)}
    bounds = _Bounds.of(arm(), limits, problem, fit)
    model, _ = problem.compiled(fit.hypothesis)
    most = float(model.actuator_gainprm[1, 0] * model.actuator_gear[1, 0])
    assert most == pytest.approx(1.6, rel=0.01)
    kept = [
        told for _, controls in _motions(problem) if (told := _kept(problem, fit, bounds, controls))
    ]
    assert kept
    efforts = [most * np.abs(controls[:, 1]).max() for controls, _ in kept]
    assert max(efforts) <= 0.2
    assert max(efforts) > 0.1


def test_a_proposed_motion_keeps_to_what_was_recorded_where_no_limit_is_stated() -> None:
    problem, machine = posed(record([("dry_friction", "joint", "elbow", [0.15])], duration=3.0))
    friction = candidate(machine, "dry_friction", "elbow")
    fit = refit(prepare(problem).linear, [friction], [np.array([0.15])])
    bounds = _Bounds.of(arm(), {}, problem, fit)
    shown = problem.simulate(fit.hypothesis, fit.start)
    speed = np.abs(shown.trajectory.qvel).max(axis=(0, 1))
    gear = problem.machine.model.actuator_gear[:2, 0]
    effort = np.abs(gear * shown.ctrl).max(axis=(0, 1))
    tried = 0
    for _, controls in _motions(problem):
        if kept := _kept(problem, fit, bounds, controls):
            recording = kept[1]
            assert (np.abs(gear * kept[0]).max(axis=0) <= 1.151 * effort).all()
            for j, name in enumerate(problem.model.joints):
                q = recording.channels[f"qpos.{name}"].values
                rate = np.abs(np.gradient(q, machine.sampling)).max()
                assert rate <= 1.16 * speed[j]
                assert np.ptp(q) <= 1.31 * machine.joints[name].span
            tried += 1
    assert tried


def test_what_a_parameter_fitted_of_a_servo_is_what_a_finding_begins_with() -> None:
    text = (
        '<mujoco><option timestep="0.002"/><worldbody><body name="link">'
        '<joint name="elbow" axis="0 1 0"/><geom name="rod" size=".02" pos=".3 0 0" mass=".5"/>'
        '</body></worldbody><actuator><position name="servo" joint="elbow" kp="20"/></actuator>'
        "</mujoco>"
    )
    model = Model.from_xml(text)
    time = np.arange(0.0, 2.0, 0.01)
    moved = {"elbow": np.sin(4 * time)}
    log = Recording.from_arrays(time, qpos=moved, ctrl={"servo": np.sin(4 * time)})
    parameters = [
        Parameter("gain", ("actuator[servo].kp",), 18.0, 26.0, 9),
        Parameter("mass", ("geom[rod].mass",), 0.4, 0.6, 5),
    ]
    evidence = make_evidence(
        model, [log], effects=[CATALOGUE["servo_kp"]], parameters=parameters, noise={}, most=1
    )
    held = tuple(evidence.nuisances)
    fitted = _fitted(
        evidence, Hypothesis(nuisances=held, nuisance_x=(np.array([4.0]), np.array([0.05])))
    )
    for effect, kind, site, value in (
        ("servo_kp", "actuator", "servo", 24.0), ("link_mass", "body", "link", 0.55)
    ):  # fmt: skip
        assert CATALOGUE[effect].nominal(Site(kind, site), fitted) == pytest.approx(value)
