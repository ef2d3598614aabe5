"""What a late encoder shows first in a window is simulated, from where the window begins on."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from bo_sysid.diagnosis.search.final import compare, final_fits
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording

SERVO = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
<joint name="a" axis="0 0 1" armature=".0004" damping=".02"/>
<geom type="capsule" fromto="-.05 0 0 .05 0 0" size=".02" mass=".6"/>
</body></worldbody><actuator><position name="a" joint="a" kp="8" kv=".2"/></actuator></mujoco>"""
STEP, EVERY, LATE, SIGMA = 0.001, 5, 0.012, 3e-4  # [s], steps in a sample, [s], [rad]
HORIZON = 60

CAMERA = """<mujoco><option timestep="{step}"/><worldbody><body>
<joint name="a" axis="0 1 0" damping=".01"/>
<inertial pos="{com} 0 0" mass=".6" diaginertia=".0012 .0015 .0012"/>
</body></worldbody><actuator><position name="a" joint="a" kp="20" kv=".6"/></actuator></mujoco>"""
COM = 0.012  # [m]


def recorded(
    seed: int, samples: int = 2000, plant: str = SERVO, fine: int = 1, fastest: float = 5
) -> Recording:
    """A stiff servo whose commands are held from sample to sample, and whose encoder is late."""
    model, rng = mujoco.MjModel.from_xml_string(plant), np.random.default_rng(seed)
    data, time = mujoco.MjData(model), np.arange(samples) * EVERY * STEP
    waves = zip(rng.uniform(0.3, fastest, 6), rng.uniform(0, 6, 6), strict=True)
    sent = sum(0.15 * np.sin(2 * np.pi * f * time + p) for f, p in waves)
    angle = np.zeros(samples * EVERY * fine)
    for k in range(len(angle)):
        angle[k] = data.qpos[0]
        data.ctrl[0] = sent[k // (EVERY * fine)]
        mujoco.mj_step(model, data)
    late = round(LATE / STEP * fine)
    seen = np.concatenate([np.zeros(late), angle[:-late]])[:: EVERY * fine]
    seen += rng.normal(0, SIGMA, samples)
    return Recording.from_arrays(time, qpos={"a": seen}, ctrl={"a": sent}, name=f"log {seed}")


def evidence_of(*recordings: Recording) -> Evidence:
    effects = [CATALOGUE[e] for e in ("actuator_delay", "sensor_delay", "armature")]
    return make_evidence(
        Model.from_xml(SERVO), recordings, effects=effects, noise={"qpos": SIGMA}, threads=1
    )


@pytest.mark.parametrize("lead", [0.0, 0.0049, 0.012, 0.02])
def test_every_instant_is_compared_once_and_as_late_in_its_window_as_was_asked(lead: float) -> None:
    short = recorded(1, samples=HORIZON + 2)  # no window fits into it that begins earlier
    evidence = replace(evidence_of(recorded(0), short), lead=lead)
    problem = windows_of(evidence, HORIZON, STEP)
    windows, seen = problem.windows, problem.weight[..., 0] > 0
    after = (windows.step + windows.fraction) * windows.timestep
    at = np.round((windows.time[:, None] + after) / (EVERY * STEP), 6)
    whole = (windows.recording == 0)[:, None] & seen
    first = np.where(seen, after, np.inf).min(axis=1)
    assert first[windows.recording == 0].min() >= max(lead, EVERY * STEP) - 1e-9
    assert len(np.unique(at[whole])) == whole.sum()
    assert np.ptp(np.diff(np.sort(at[whole]))) == pytest.approx(0, abs=1e-6)  # none is left out
    assert np.all(seen[windows.recording == 0].sum(axis=1) == HORIZON)
    assert (windows.recording == 1).sum() == 1


def test_a_late_encoder_explains_what_was_recorded_as_well_as_a_late_command() -> None:
    """One joint alone moves alike with either, so that the data cannot tell them apart.

    Commands that are held change its acceleration at each step: what it did before a window began
    does not follow from how it moves there.
    """
    evidence = evidence_of(recorded(0))
    search = Search.on(
        prepare(windows_of(evidence, HORIZON, STEP)), list(evidence.candidates), 2, None
    )
    for effect in ("actuator_delay", "sensor_delay"):
        c = next(c for c in search.candidates if c.effect.id == effect)
        search.fit([c], [np.array([LATE])])
    final = final_fits(evidence, search, HORIZON, STEP)
    command, encoder = (
        next(f for f in final.fits.values() if [c.effect.id for c in f.members] == [effect])
        for effect in ("actuator_delay", "sensor_delay")
    )
    problem = final.prepared.problem
    assert encoder.rms == pytest.approx(1.0, abs=3 / np.sqrt(2 * problem.dof))
    assert abs(encoder.rms**2 - command.rms**2) * problem.dof < 4.0  # [sigma²]
    assert encoder.x[0][0] == pytest.approx(LATE, rel=0.02)


def test_a_late_encoder_is_fitted_by_its_own_slopes_behind_a_servo_stiffer_than_a_step() -> None:
    """One joint moves alike with either delay, and h k_v / I is .8: starts are forgotten soon."""
    plant = CAMERA.format(step=STEP / 5, com=COM)
    effects = [CATALOGUE[e] for e in ("actuator_delay", "sensor_delay", "com_shift")]
    evidence = make_evidence(
        Model.from_xml(CAMERA.format(step=2 * STEP, com=0)),
        [recorded(1, 1500, plant, 5, fastest=3)],
        effects=effects, noise={"qpos": SIGMA}, threads=1,
    )  # fmt: skip
    step = STEP / 2
    prepared = prepare(windows_of(evidence, HORIZON, step))
    search = Search.on(prepared, list(evidence.candidates), 2, None)
    delay, shift = (
        next(c for c in search.candidates if c.effect.id == effect)
        for effect in ("actuator_delay", "com_shift")
    )
    search.fit([delay, shift], [np.array([LATE]), np.array([COM, 0.0, 0.0])])
    final = final_fits(evidence, search, HORIZON, step)
    compare(final, search.best)
    command, encoder = (
        next(f for f in final.fits.values() if effect in {c.effect.id for c in f.members})
        for effect in ("actuator_delay", "sensor_delay")
    )
    assert encoder.rms == pytest.approx(command.rms, rel=1e-3)
    late = next(x for c, x in zip(encoder.members, encoder.x, strict=True) if c is not shift)
    assert late[0] == pytest.approx(LATE, rel=0.02)
