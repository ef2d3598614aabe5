"""From a study to the deviation that the search minimises."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bo_sysid.arrays import Point
from bo_sysid.deviation import Deviation, Whitening
from bo_sysid.mjcf import Model
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation import Windows, cut
from bo_sysid.simulation.of_study import make_simulator, study_signals
from bo_sysid.study import Study
from bo_sysid.study.check import candidate_set, nominal, require_known
from bo_sysid.study.inputs import load_model, load_train

_UNMEASURED = 0.15  # [s] shortest window where velocities were not recorded


@dataclass(frozen=True)
class Problem:
    """What a study asks: which candidate predicts these recordings best.

    Attributes:
        study: the study.
        model: the nominal model.
        recordings: what is fitted.
        parameters: what is uncertain.
        candidates: the discrete set B.
        deviation: Δ on the recordings.
        horizon: number of recorded instants in a window.
        notes: what was chosen where the study did not fit the recordings.
    """

    study: Study
    model: Model
    recordings: tuple[Recording, ...]
    parameters: tuple[Parameter, ...]
    candidates: CandidateSet
    deviation: Deviation
    horizon: int
    notes: tuple[str, ...] = ()

    @property
    def nominal(self) -> Point:
        """The `d` parameter values that leave the model as it is."""
        return np.array([nominal(self.model, p) for p in self.parameters])

    @property
    def fingerprint(self) -> str:
        """Hash of what Δ depends on beside the study: the recordings and the compiled model."""
        digest = hashlib.sha256()
        windows = self.deviation.windows
        for array in (windows.observed, windows.ctrl, windows.start.qpos, windows.start.qvel):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(self.model.spec().to_xml().encode())
        return digest.hexdigest()

    def on(self, recordings: Sequence[Recording], horizon: int | None = None) -> Deviation:
        """Return the deviation on other recordings or over another horizon, on these scales."""
        windows = _cut(self.study, self.model, recordings, horizon or self.horizon)
        return Deviation(
            self.deviation.simulator,
            windows,
            self.deviation.whitening.restricted(windows.channels),
            fitted_starts=self.deviation.fitted_starts,
        )


def make_problem(
    study: Study,
    recordings: Sequence[Recording] | None = None,
    *,
    threads: int = 0,
    strict: bool = False,
) -> Problem:
    """Return the problem that a study describes.

    Args:
        study: the study.
        recordings: what is fitted; the study's training recordings where left out.
        threads: number of threads for simulations, 0 for all cores.
        strict: refuse messy recordings.

    Raises:
        UserError: the study, its model or its recordings are wrong.
    """
    model = load_model(study)
    recordings = load_train(study, strict=strict) if recordings is None else tuple(recordings)
    for recording in recordings:
        require_known(model, recording)
    parameters = study.parameter_set(model)
    if not parameters:
        raise study.error(
            ("parameters",), "identify needs at least one uncertain parameter; the study has none"
        )
    simulator = make_simulator(study, model, parameters, threads=threads)
    fitted, horizon, notes = _framing(study, model, recordings)
    windows = _cut(study, model, recordings, horizon)
    whiten = study.deviation.whiten
    noise = study.recordings.noise if whiten == "auto" else whiten
    deviation = Deviation(
        simulator,
        windows,
        Whitening.of(windows, noise),
        fitted_starts=fitted,
    )
    candidates = candidate_set(study, parameters)
    return Problem(study, model, recordings, parameters, candidates, deviation, horizon, notes)


def _framing(
    study: Study, model: Model, recordings: Sequence[Recording]
) -> tuple[bool, int, tuple[str, ...]]:
    """Return whether starts are fitted, the horizon, and what was chosen for the study.

    Where no velocity was recorded a start cannot be measured: one step from an estimated velocity
    shows the noise of the estimate, and hardly the parameters. Starts are then fitted, in windows
    of at least 0.15 s.
    """
    asked = study.deviation
    rates = set(model.qvel_channels)
    measured = not model.unrecorded and any(rates & set(r.channels) for r in recordings)
    if asked.starts == "fitted" or not rates or measured:
        return asked.starts == "fitted", asked.horizon, ()
    name = next(n for n in model.qpos_channels if n in recordings[0].channels)
    interval = float(np.median([np.median(np.diff(r.channels[name].time)) for r in recordings]))
    horizon = max(asked.horizon, round(_UNMEASURED / interval), 4 * len(rates))
    why = "a joint moves unmeasured" if model.unrecorded else "no velocity was recorded"
    note = (
        f"{why}, so that "
        f"starts cannot be measured: they are fitted, in windows of {horizon} instants "
        f"({horizon * interval:.3g} s); deviation: {{starts: fitted, horizon: N}} says otherwise"
    )
    return True, horizon, (note,)


def _cut(study: Study, model: Model, recordings: Sequence[Recording], horizon: int) -> Windows:
    return cut(
        model,
        recordings,
        horizon=horizon,
        signals=study_signals(study, recordings),
        controlled=tuple(study.actuators),
    )
