"""From a study to the deviation that the search minimises."""

import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.arrays import Point
from bo_sysid.checks.sensitivity import with_fitted_starts
from bo_sysid.deviation import Deviation, Whitening
from bo_sysid.errors import RecordingError
from bo_sysid.execution import threads as cores
from bo_sysid.mjcf import Model, nominal
from bo_sysid.mjcf.address import resolve
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation import Windows
from bo_sysid.simulation.of_study import make_simulator, study_windows
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model, load_train
from bo_sysid.study.overview import candidate_set
from bo_sysid.study.requirements import (
    require_known,
    require_position,
    require_recorded,
    require_scales,
)

_UNMEASURED = 0.15  # [s] shortest window where velocities were not recorded
_MOSTLY = 0.5  # of the instants of positions, at which a velocity must be known to measure starts
_GAP = 1.5  # times the usual length, from which a window holds a gap
_STEPS, _ARRIVED = 4, 0.3  # to what fits with fitted starts; of a standard deviation, at the end


@dataclass(frozen=True)
class FittedStarts:
    """What would fit best of all values, where the start of each window is fitted.

    Attributes:
        values: `d` parameter values.
        sigma: their `d` standard deviations.
        horizon: recorded instants of a window.
        measured: whether the search measured starts.
    """

    values: Point
    sigma: Point
    horizon: int
    measured: bool = True

    def outside(self, low: Point, high: Point) -> Bool[np.ndarray, " d"]:
        """Return which of the `d` values are not from low to high."""
        return np.asarray((self.values < low) | (self.values > high))


@dataclass(frozen=True)
class Problem:
    """The problem of a study: which candidate predicts these recordings best.

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
        """Hash of what Δ depends on beside the study: recordings, model, named files."""
        windows = self.deviation.windows
        start = windows.start
        arrays = {
            "observed": windows.observed,
            "step": windows.step,
            "fraction": windows.fraction,
            "ctrl": windows.ctrl,
            "qpos": start.qpos,
            "qvel": start.qvel,
            "act": start.act,
            **{f"signal {name}": values for name, values in windows.signals.items()},
        }
        if start.warmstart is not None:
            arrays["warmstart"] = start.warmstart
        digest = hashlib.sha256(self.model.sha256.encode())
        for name, array in arrays.items():
            digest.update(f"{name} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        for file in (*self.study.code, *self.study.model.beside):
            digest.update((self.study.folder / file).read_bytes())
        return digest.hexdigest()

    def on(self, recordings: Sequence[Recording], horizon: int | None = None) -> Deviation:
        """Return the deviation on other recordings or over another horizon, on these scales.

        Channels that have no scale here are not compared, see `unscaled`.
        """
        whitening = self.deviation.whitening
        windows = study_windows(self.study, self.model, recordings, horizon or self.horizon)
        windows = windows.among(whitening.channels)
        return Deviation(
            self.deviation.simulator,
            windows,
            whitening.restricted(windows.channels),
            fitted_starts=self.deviation.fitted_starts,
        )

    def at_timestep(self, timestep: float) -> Deviation:
        """Return the deviation on the same recordings, simulated with another time step in [s]."""
        own = self.deviation
        simulator = make_simulator(self.study, self.model, self.parameters, threads=cores())
        return Deviation(
            replace(simulator, timestep=timestep),
            study_windows(self.study, self.model, self.recordings, self.horizon, timestep),
            own.whitening,
            fitted_starts=own.fitted_starts,
        )

    def with_fitted_starts(
        self, point: Point, noise: Mapping[str, float], low: Point, high: Point
    ) -> FittedStarts | None:
        """Return what would fit best with fitted starts, in windows that are long enough for it.

        None where a parameter has no order, and where recordings are too short or have gaps.

        Args:
            point: `d` values, from which that is one step, and more where it leaves the intervals.
            noise: standard deviation of each channel, in its unit.
            low: `d` lower ends of the intervals.
            high: `d` upper ends.
        """
        stamps = [s for r in self.recordings if len(s := _stamps(r, self.model.shown_channels)) > 1]
        if self.candidates.categories or not stamps:
            return None
        horizon, interval = _long_enough_for_starts(self.study, self.model, stamps)
        if self.deviation.fitted_starts:
            horizon = self.horizon
        try:
            windows = self.on(self.recordings, horizon).windows
        except RecordingError:  # no such long window fits into them
            return None
        if windows.step.max() * windows.timestep > _GAP * horizon * interval:
            return None
        simulator = self.deviation.simulator
        for _ in range(_STEPS):
            found = FittedStarts(*with_fitted_starts(simulator, point, windows, noise), horizon)
            arrived = (np.abs(found.values - point) <= _ARRIVED * found.sigma).all()
            if arrived or not found.outside(low, high).any():
                break
            point = found.values
        return replace(found, measured=not self.deviation.fitted_starts)

    def unscaled(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """Return in words which channels of other recordings are not compared."""
        model = self.model
        shown = {*model.shown_channels} - {*self.deviation.whitening.channels}
        return tuple(
            f"{r.name}: {name} is not compared: no training recording has it"
            for r in recordings
            for name in r.channels
            if name in shown and name.split(".", 1)[1] not in model.unrecorded
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
    require_scales(study, model)
    parameters = study.parameter_set(model)
    if not parameters:
        raise study.error(
            ("parameters",), "identify needs at least one uncertain parameter; the study has none"
        )
    require_recorded(study, model, recordings)
    require_position(model, recordings, "identify")
    simulator = make_simulator(study, model, parameters, threads=threads)
    fitted, horizon, notes = _framing(study, model, recordings)
    windows = study_windows(study, model, recordings, horizon)
    _require_two(study, model, recordings, windows)
    if fitted:
        _require_more_than_starts(study, model, windows)
    whiten = study.deviation.whiten
    noise = study.recordings.noise if whiten == "auto" else whiten
    deviation = Deviation(
        simulator,
        windows,
        Whitening.of(windows, noise),
        fitted_starts=fitted,
    )
    candidates = candidate_set(study, parameters)
    notes += tuple(_untied(model, parameters))
    return Problem(study, model, recordings, parameters, candidates, deviation, horizon, notes)


def _untied(model: Model, parameters: Sequence[Parameter]) -> Iterator[str]:
    """Say of which parameters the model has several values, so that no one leaves it as it is."""
    for p in parameters:
        own = [t.nominal for a in p.addresses for t in resolve(model, a)]
        if p.apply == "set" and not np.allclose(own, own[0], rtol=1e-9, atol=0.0):
            yield (
                f"{p.name}: the model has {min(own):.4g} to {max(own):.4g} at its addresses; "
                f"'nominal' has {np.mean(own):.4g} at all of them, and so is another model"
            )


def _framing(
    study: Study, model: Model, recordings: Sequence[Recording]
) -> tuple[bool, int, tuple[str, ...]]:
    """Return whether starts are fitted, the horizon, and what was chosen for the study.

    Where no velocity was recorded a start cannot be measured: one step from an estimated velocity
    shows the noise of the estimate, and hardly the parameters. Starts are then fitted, in windows
    of at least 0.15 s. So they are where most positions were recorded at other instants.
    """
    asked = study.deviation
    rates = set(model.qvel_channels)
    unmeasured = set(model.unrecorded) - set(model.loops.joints)
    together = _recorded_with_velocity(model, recordings)
    measured = not unmeasured and together > _MOSTLY
    stamps = [s for r in recordings if len(s := _stamps(r, model.shown_channels)) > 1]
    if asked.starts == "fitted" or not rates or measured or not stamps:
        return asked.starts == "fitted", asked.horizon, ()
    horizon, interval = _long_enough_for_starts(study, model, stamps)
    why = "no velocity was recorded"
    if unmeasured:
        why = "a joint moves unmeasured"
    elif any(rates & set(r.channels) for r in recordings):
        why = f"{100 * (1 - together):.0f} % of the positions were recorded without a velocity"
    note = (
        f"{why}, so that "
        f"starts cannot be measured: they are fitted, in windows of {horizon} instants "
        f"({horizon * interval:.3g} s); deviation: {{starts: fitted, horizon: N}} says otherwise"
    )
    return True, horizon, (note,)


def _recorded_with_velocity(model: Model, recordings: Sequence[Recording]) -> float:
    """Return the share of the positions' instants at which a velocity was recorded as well."""
    own, rates = set(model.qpos_channels), set(model.qvel_channels)
    seen = count = 0
    for r in recordings:
        at = _stamps(r, own)
        seen, count = seen + int(np.isin(at, _stamps(r, rates)).sum()), count + len(at)
    return seen / max(count, 1)


def _long_enough_for_starts(
    study: Study, model: Model, stamps: Sequence[Float[np.ndarray, " _"]]
) -> tuple[int, float]:
    """Return the instants of a window that tells more than its start, and the [s] between two."""
    interval = float(np.median([np.median(np.diff(s)) for s in stamps]))
    least = max(round(_UNMEASURED / interval), 4 * len(model.qvel_channels))
    return max(study.deviation.horizon, least), interval


def _require_two(
    study: Study, model: Model, recordings: Sequence[Recording], windows: Windows
) -> None:
    """Refuse a single window: it leaves no others to bootstrap an interval from.

    Raises:
        StudyError: there are not two windows to draw from.
    """
    if len(windows) > 1:
        return
    instants, horizon = instants_of(model, recordings[0]), windows.observed.shape[1]
    most = (instants - 1) // 2
    remedy = f"a horizon of {most} or less gives two" if most else "record for longer"
    raise study.error(
        ("deviation", "horizon"),
        f"the horizon {horizon} cuts the {instants} instants of the recordings into one window; an "
        f"interval needs two or more: {remedy}",
    )


def _require_more_than_starts(study: Study, model: Model, windows: Windows) -> None:
    """Refuse windows that starts alone explain, whatever the candidate.

    Raises:
        StudyError: no window holds more numbers than its start has.
    """
    own = 2 * (windows.start.qvel.shape[1] - len(model.loops.joints))
    horizon = windows.observed.shape[1]
    most = max(int(np.isfinite(windows.observed).sum(axis=(1, 2)).max()), 1)
    least = own * horizon // most + 1
    if most <= own:
        raise study.error(
            ("deviation", "horizon"),
            f"windows of {horizon} instants hold at most {most} numbers, and a start that is "
            f"fitted to them has {own}: any candidate fits; use {least} or more",
        )


def instants_of(model: Model, recording: Recording) -> int:
    """Return at how many instants something was recorded that the model shows."""
    return len(_stamps(recording, model.shown_channels))


def _stamps(recording: Recording, names: Collection[str]) -> Float[np.ndarray, " T"]:
    """Return the instants at which any of some channels was recorded, in [s]."""
    times = [c.time for name, c in recording.channels.items() if name in names]
    return np.unique(np.concatenate([np.zeros(0), *times]))
