"""Machines that touch something, and what postures tell."""

import mujoco
import numpy as np
import pytest
from choice_machines import walled
from numpy.testing import assert_allclose

from bo_sysid.diagnosis.answer.experiment import next_experiment
from bo_sysid.diagnosis.answer.explain import explain
from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.unexplained.missing_force import explained
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.recording import Recording


def test_postures_are_not_asked_of_a_body_that_only_slides() -> None:
    """A load on a cart and its mass are one thing, whatever is recorded."""
    text = (
        '<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0" '
        'damping="1"/><geom size=".1" mass="{}"/></body></worldbody>'
        '<actuator><motor name="x" joint="x"/></actuator></mujoco>'
    )
    plant = mujoco.MjModel.from_xml_string(text.format(1.3))
    time = plant.opt.timestep * np.arange(3000)
    data, ctrl, q = mujoco.MjData(plant), np.sin(4 * time), []
    for u in ctrl:
        q.append(data.qpos[0])
        data.ctrl[:] = u
        mujoco.mj_step(plant, data)
    noisy = np.array(q) + 1e-4 * np.random.default_rng(0).standard_normal(3000)
    log = Recording.from_arrays(time, qpos={"x": noisy}, ctrl={"x": ctrl})
    cart = Model.from_xml(text.format(1))
    effects = [CATALOGUE["payload"], CATALOGUE["link_mass"]]
    answer = locate(make_evidence(cart, [log], effects=effects, noise={"qpos": 1e-4}, threads=1))
    (found,) = answer.decision.best.hypothesis.x
    assert found[0] == pytest.approx(0.3, abs=0.01)
    assert answer.decision.equivalents
    said = next_experiment(answer, explain(answer), {}).sentence
    assert "tells a payload at the cart from mass at the cart" in said
    assert "posture" not in said


def test_a_hold_out_in_which_something_touches_is_judged_with_contact() -> None:
    t = np.arange(0, 3, 0.01)

    def swinging(far: float) -> Recording:
        moved = {"shoulder": far * np.sin(4 * t), "elbow": far * np.cos(3 * t)}
        return Recording.from_arrays(t, qpos=moved, ctrl=moved)

    evidence = make_evidence(walled(), [swinging(0.1)], threads=1)
    assert not can_touch(evidence.machine.model)
    assert evidence.with_contact_of([swinging(0.2)]) is evidence
    whole = evidence.with_contact_of([swinging(1.0)])
    assert whole.model is evidence.given
    assert can_touch(whole.machine.model)


def test_forces_that_impacts_hide_are_as_unknown_as_before() -> None:
    """One response as any other, one that is huge and alike for both joints, one that diverges."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 40, 2))
    truth = np.array([0.5, -1.0])
    A[1] = 1e8 * A[1, :, :1]
    A[2] = np.inf
    y = np.array([A[0] @ truth, A[1] @ truth, np.ones(40)])
    force, sigma = explained(A, y)
    exact = np.linalg.inv(A[0].T @ A[0] + np.eye(2) / 9)
    assert_allclose(force[0], exact @ A[0].T @ y[0])
    assert_allclose(sigma[0], np.sqrt(np.diag(exact)))
    assert_allclose(force[1].sum(), truth.sum(), rtol=1e-6)  # all that the second tells
    assert_allclose(sigma[1], 3.0 / np.sqrt(2), rtol=1e-6)
    assert_allclose(force[2], 0.0)
    assert_allclose(sigma[2], 3.0)
