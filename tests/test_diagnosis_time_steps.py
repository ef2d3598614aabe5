"""At which time step a search looks for what is missing."""

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare, second_order
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

STEP, SIGMA, SAMPLES, EVERY = 0.002, 3e-4, 1200, 0.005  # [s], [rad], samples and their interval [s]
STIFF = """<mujoco><option timestep="{step}" integrator="{integrator}"/><worldbody><body>
<joint name="a" axis="0 0 1" armature="{rotor}"/>
<inertial pos="0 0 0" mass=".4" diaginertia=".0015 .0015 .0015"/></body></worldbody>
<actuator><position name="a" joint="a" kp="20" kv=".3"/></actuator></mujoco>"""
"""A servo that is stiff beside the model's step: h k_v / I = .4."""


def evidence_of(rotor: float, simulated: bool = False) -> Evidence:
    """A servo with an inertia of the rotor in [kg m²], which its model lacks.

    It moves continuously, as real ones do, or as its model does: by Euler's steps of 1 ms.
    """
    fine, step = (STEP / 2, STEP / 2) if simulated else (EVERY / 50, STEP)
    rng, time = np.random.default_rng(0), np.arange(SAMPLES) * EVERY
    waves = zip(rng.uniform(0.3, 5, 6), rng.uniform(0, 6, 6), strict=True)
    sent = sum(0.15 * np.sin(2 * np.pi * f * time + p) for f, p in waves)
    integrator = "Euler" if simulated else "RK4"
    xml = STIFF.format(step=fine, integrator=integrator, rotor=rotor)
    plant = mujoco.MjModel.from_xml_string(xml)
    data, angle = mujoco.MjData(plant), np.zeros(SAMPLES)
    for k in range(SAMPLES):
        angle[k], data.ctrl[0] = data.qpos[0], sent[k]
        mujoco.mj_step(plant, data, round(EVERY / fine))
    angle += rng.normal(0, SIGMA, SAMPLES)
    names = ("armature", "actuator_lag", "actuator_delay", "sensor_delay", "servo_kd")
    return make_evidence(
        Model.from_xml(STIFF.format(step=step, integrator="Euler", rotor=0)),
        [Recording.from_arrays(time, qpos={"a": angle}, ctrl={"a": sent})],
        effects=[CATALOGUE[n] for n in names],
        noise={"qpos": SIGMA},
        threads=1,
    )


def test_what_half_a_step_misses_falls_with_the_square_of_the_step() -> None:
    """The correction is right to first order, so that what it misses is of second."""
    evidence = evidence_of(0.0)
    missed = [second_order(prepare(windows_of(evidence, 60, STEP / n))) for n in (2, 4, 8)]
    assert missed[0] / missed[1] == pytest.approx(4, rel=0.25)
    assert missed[1] / missed[2] == pytest.approx(4, rel=0.15)


def test_a_servo_that_lacks_nothing_has_nothing_missing_at_a_coarse_step() -> None:
    """By a step's first order a rotor of .0002 kg m² and a late encoder explained its second."""
    located = locate(evidence_of(0.0))
    assert located.decision.best.names == frozenset()
    assert located.prepared.problem.windows.timestep < STEP


def test_a_rotor_behind_a_stiff_servo_is_told_alone_and_as_large_as_it_is() -> None:
    """It was told with twice its inertia and a late encoder."""
    best = locate(evidence_of(0.0003)).decision.best
    assert best.names == {("armature", "a")}
    assert best.x[0][0] == pytest.approx(0.0003, rel=0.05)


def test_a_simulation_at_the_step_of_the_model_is_searched_at_that_step() -> None:
    """At a finer one nothing missing left 5.7 sigma, and a damping stood for a rotor."""
    nothing = locate(evidence_of(0.0, simulated=True))
    assert nothing.decision.best.names == frozenset()
    assert nothing.decision.best.rms < 1.05
    best = locate(evidence_of(0.0003, simulated=True)).decision.best
    assert best.names == {("armature", "a")}
    assert best.x[0][0] == pytest.approx(0.0003, rel=0.05)
