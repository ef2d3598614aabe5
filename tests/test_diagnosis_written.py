"""The files of a repaired model predict what was fitted, to far less than a sensor tells."""

from pathlib import Path

import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, candidate, record

from bo_sysid.diagnosis.answer.repaired import BESIDE, MODEL, write_model
from bo_sysid.diagnosis.unexplained.law import law_candidate
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import Machine, survey
from bo_sysid.effects.beside import as_commanded_and_measured, read_beside
from bo_sysid.effects.learned import features
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine
from bo_sysid.simulation.lockstep import ForceLaw, force_laws

STEP, HORIZON = 0.002, 100
NOISE = {"qpos.shoulder": SIGMA, "qpos.elbow": SIGMA}


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(duration=2.0, sigma=1e-9)


@pytest.fixture(scope="module")
def machine(recording: Recording) -> Machine:
    return survey(arm().compile(), [recording])


def of_command(machine: Machine) -> Candidate:
    """A learned law at the elbow that depends on its command."""
    terms = [t for t in features("elbow", machine) if t.depends_on == "control"]
    return law_candidate(machine, "elbow", terms)


def differ(
    folder: Path,
    machine: Machine,
    recording: Recording,
    h: Hypothesis,
    laws: tuple[ForceLaw, ...] = (),
) -> tuple[float, float]:
    """Return what a hypothesis changes of the predictions, and its files of that; rms in sigma."""
    write_model(arm(), machine, h, folder, timestep=STEP, laws=laws)
    repaired, parts = Model.from_file(folder / MODEL), ()
    if (folder / BESIDE).exists():
        parts = read_beside(folder / BESIDE, repaired.compile()).parts(repaired)
    seen = as_commanded_and_measured(recording, parts, STEP)
    scales = survey(repaired.compile(), [seen])
    how = {"horizon": HORIZON, "engine": Engine(1)}
    fitted = cut_problem(arm(), machine, [recording], NOISE, (), laws=laws, **how)
    files = cut_problem(
        repaired, scales, [seen], NOISE, (), laws=(*laws, *force_laws(parts)), **how
    )
    # what a late actuator does in the first windows, no command of the log tells
    fitted = fitted.rows(np.isin(fitted.windows.time, files.windows.time))
    assert len(fitted.windows) > 5
    start = fitted.windows.start
    nominal, fit = (fitted.residual(made, start) for made in (Hypothesis(), h))
    read = files.residual(Hypothesis(), files.windows.start)
    return tuple(float(np.sqrt(np.mean((r - fit) ** 2))) for r in (nominal, read))


@pytest.mark.parametrize(
    ("effects", "x", "share"),
    [
        (("actuator_delay",), (0.0127,), 1e-6),
        (("actuator_lag",), (0.03,), 0.02),  # an activation is that of a step's beginning
        (("actuator_lag",), (0.004,), 0.05),
        (("actuator_lag",), (0.003,), 1e-6),  # which two steps of 2 ms do not resolve: a filter
        (("stribeck_friction",), ((0.02, 0.06),), 0.02),  # a law, and bristles
        (("stribeck_friction",), ((0.05, 0.2),), 0.01),
        (("stribeck_friction",), ((0.1, 0.05),), 0.15),  # which are twice as much as what holds
        (("actuator_lag", "load_dependent_friction"), (0.03, 0.3), 1e-6),
        (("actuator_delay", "load_dependent_friction"), (0.01, 0.3), 1e-6),
        (("actuator_lag", "asymmetric_damping"), (0.03, 0.01), 1e-6),
        (("actuator_deadzone", "actuator_lag"), (0.02, 0.03), 0.02),
        (("armature", "cogging"), (0.002, 0.02), 1e-6),
    ],
)
def test_a_file_predicts_what_was_fitted(
    tmp_path: Path, machine: Machine, recording: Recording, effects, x, share
) -> None:
    members = tuple(candidate(machine, e, "elbow") for e in effects)
    sized = [np.zeros(c.size) for c in members]
    for own, value in zip(sized, x, strict=True):
        own[: np.size(value)] = value
    effect, off = differ(tmp_path, machine, recording, Hypothesis(members, tuple(sized)))
    assert effect > 1.0
    assert off < share * effect


@pytest.mark.parametrize("bend", [0.0, 0.01])
def test_that_the_file_has_friction_as_bristles_is_said(
    tmp_path: Path, machine: Machine, bend: float
) -> None:
    friction = candidate(machine, "stribeck_friction", "elbow")
    held = friction.with_shapes(np.array([friction.shapes[0], bend]))
    h = Hypothesis((held,), (np.array([0.02, 0.06]),))
    (*_, note) = write_model(arm(), machine, h, tmp_path, timestep=STEP).notes or ("",)
    assert ("the friction of elbow is dry friction and stiff bristles" in note) == (not bend)


@pytest.mark.parametrize("learned", [True, False])
def test_what_reads_a_command_beside_the_file_reads_it_late(
    tmp_path: Path, machine: Machine, recording: Recording, learned: bool
) -> None:
    """A law that was learned with the lag, and one that stood beside the model before it."""
    lag, law = candidate(machine, "actuator_lag", "elbow"), of_command(machine)
    weights = np.linspace(-1.0, 1.0, law.size)
    h = Hypothesis((lag,), (np.array([0.03]),))
    if learned:
        laws = ()
        h = Hypothesis((lag, law), (*h.x, weights))
    else:
        laws = force_laws(law.effect.parts(arm().spec(), law.site, law.full(weights), machine))
    effect, off = differ(tmp_path, machine, recording, h, laws)
    assert effect > 1.0
    assert off < 1e-6 * effect
