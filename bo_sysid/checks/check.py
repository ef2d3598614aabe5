"""All checks of a study, before anything is fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from bo_sysid.checks.attitude import find_attitudes
from bo_sysid.checks.channels import (
    channel_flags,
    coarse_flags,
    sampling_flags,
    shared_flags,
    slow_flags,
)
from bo_sysid.checks.evidence import Laws
from bo_sysid.checks.flags import Flag
from bo_sysid.checks.motion import excitation, excitation_flags, range_flags
from bo_sysid.checks.numerics import (
    contact_flags,
    divergence_flags,
    far_flags,
    step_effect,
    step_flags,
)
from bo_sysid.checks.proposal import Rule, as_yaml, proposed_clocks, proposed_columns
from bo_sysid.checks.rewired import rewired
from bo_sysid.checks.sensitivity import bounds_flags, in_words, information
from bo_sysid.checks.wiring import Wiring, find_wiring
from bo_sysid.checks.wraps import find_wraps, unwrapped, wrap_flags
from bo_sysid.execution import OnProgress, silent
from bo_sysid.mjcf import Model, nominal
from bo_sysid.parameters import MOST_CANDIDATES, Parameter
from bo_sysid.recording import Recording, sensor_noise, stated_for
from bo_sysid.recording.alignment import instants_in
from bo_sysid.simulation import ForceLaw, MujocoSimulator, Windows
from bo_sysid.simulation.of_study import make_simulator, study_law, study_windows
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model, load_train
from bo_sysid.study.overview import Overview, overview, too_many
from bo_sysid.study.requirements import require_position

_WINDOW = 0.3  # [s] of a prediction: long enough for masses and springs, short of chaos
_WINDOWS = 40  # that are simulated
_LEAST = 1e-3  # of a channel's spread, that no model predicts better
_STILL = 1e-12  # of the largest value, below which a spread is rounding
_ORDER = {"wrong": 0, "look": 1, "note": 2}


@dataclass(frozen=True)
class Checked:
    """What a study is made of, and what is to be said about it.

    Attributes:
        summary: model, channels and parameters.
        flags: what was found, the most serious first.
        wiring: what the channels really are.
        columns: rules to be put under ``recordings: columns:``; empty where nothing is wrong.
        clocks: rules to be put under ``recordings: clocks:``.
        motion: one row a recording and joint: how it moved.
        parameters: one row a parameter: what these recordings can say about it at best.
        step: one row a channel: change of predictions with half the step, and what they leave.
        recordings: as they should be read, for pictures.
        dataset: name of the public data set that the study reads; its rules are its own.
    """

    summary: Overview
    flags: tuple[Flag, ...]
    wiring: Wiring
    columns: Mapping[str, Rule]
    clocks: Mapping[str, Rule]
    motion: pd.DataFrame
    parameters: pd.DataFrame
    step: pd.DataFrame
    recordings: tuple[Recording, ...]
    dataset: str | None

    @property
    def proposal(self) -> str:
        """The corrected blocks as YAML; empty where nothing is to be corrected."""
        return as_yaml(self.columns, self.clocks)


@np.errstate(over="ignore")  # squares of absurd values, which flags are about
def check(study: Study, *, strict: bool = False, progress: OnProgress = silent) -> Checked:
    """Check a study: wiring, clocks, excitation, identifiability, noise; nothing is fitted.

    Args:
        study: the study.
        strict: refuse messy recordings.
        progress: is called while other wirings are tried.

    Raises:
        UserError: something is wrong or does not fit together.
    """
    summary = overview(study, strict=strict)
    model = load_model(study)
    read = load_train(study, strict=strict)
    require_position(model, read, "a check")
    laws: Laws = {name: (study_law(study, name), a.uses) for name, a in study.actuators.items()}
    wraps = find_wraps(read)
    whole = unwrapped(read, wraps)
    compiled = model.compile()
    wiring = find_wiring(compiled, whole, laws, progress)
    kind = "goal" if laws else "ctrl"
    turned, attitude = find_attitudes(compiled, whole)
    wires = {**wiring.wires, **turned}
    right = rewired(whole, wires, wiring.delay, kind)
    motion = excitation(right, compiled)
    predicted = _predict(study, model, right)
    flags = [
        *_log_flags(read),
        *bounds_flags(predicted.parameters, predicted.point),
        *wrap_flags(wraps),
        *_grid_flags(summary),
        *attitude,
        *wiring.flags,
        *excitation_flags(motion),
        *predicted.weak,
        *range_flags(compiled, right),
        *channel_flags(compiled, read),
        *sampling_flags(read),
        *_prediction_flags(predicted),
        *contact_flags(compiled, right),
        *_beside_flags(predicted.simulator),
    ]
    written = study.resolved()["recordings"]
    return Checked(
        summary,
        tuple(sorted(flags, key=lambda f: _ORDER[f.level])),
        wiring,
        proposed_columns(written.get("columns", {}), wires, wraps),
        proposed_clocks(written.get("clocks", {}), kind, wiring.delay, linear=wiring.half_early),
        motion,
        predicted.identifiability,
        predicted.step,
        right,
        study.recordings.dataset,
    )


@dataclass(frozen=True)
class _Predicted:
    """The model's predictions in windows of the recordings, and what they say.

    Attributes:
        simulator: of the model.
        parameters: of the study.
        point: their values in the model.
        windows: that are predicted.
        noise: of each measured channel, by name.
        step: as in `Checked`.
        identifiability: one row a parameter; as `Checked.parameters`.
        weak: flags of parameters that the recordings do not determine.
    """

    simulator: MujocoSimulator
    parameters: Sequence[Parameter]
    point: np.ndarray
    windows: Windows
    noise: dict[str, float]
    step: pd.DataFrame
    identifiability: pd.DataFrame
    weak: Sequence[Flag]


def _predict(study: Study, model: Model, recordings: Sequence[Recording]) -> _Predicted:
    """Predict windows of recordings, with half the time step and other parameters as well."""
    noise = _noise(study, recordings)
    windows = _windows(study, model, recordings, None)
    parameters = study.parameter_set(model)
    simulator = make_simulator(study, model, parameters, threads=1)
    point = np.array([nominal(model, p) for p in parameters])
    halved = _windows(study, model, recordings, 0.5 * windows.timestep)
    step = step_effect(simulator, point, windows, halved)
    known, weak = _identifiability(simulator, parameters, point, windows, noise, recordings)
    return _Predicted(simulator, parameters, point, windows, noise, step, known, weak)


def _log_flags(recordings: Sequence[Recording]) -> list[Flag]:
    """Return what the logs show by themselves: slow, coarse or shared channels."""
    return [*slow_flags(recordings), *coarse_flags(recordings), *shared_flags(recordings)]


def _prediction_flags(predicted: _Predicted) -> list[Flag]:
    """Return what predictions show: divergence, the time step, a model that is far off."""
    step, noise, timestep = predicted.step, predicted.noise, predicted.windows.timestep
    return [
        *divergence_flags(step, timestep),
        *step_flags(step, noise, timestep),
        *far_flags(step, noise),
    ]


def _noise(study: Study, recordings: Sequence[Recording]) -> dict[str, float]:
    """Return the deviation of each measured channel that counts: stated, or its noise.

    A sensor may be better than any model: at least a thousandth of the recorded spread counts.
    """
    estimates: dict[str, list[float]] = {}
    for r in recordings:
        for name, sigma in sensor_noise(r).items():
            moved = float(r.channels[name].values.std())
            if moved <= _STILL * float(np.abs(r.channels[name].values).max(initial=0.0)):
                continue  # it never moves, and what rounding leaves is no noise
            floor = _LEAST * moved
            estimates.setdefault(name, []).append(max(sigma, floor))
    stated = study.recordings.noise
    return {n: stated_for(n, stated, float(np.median(s))) for n, s in estimates.items()}


def _windows(
    study: Study, model: Model, recordings: Sequence[Recording], timestep: float | None
) -> Windows:
    """Return windows of 0.3 s, spread over the recordings."""
    shown = model.shown_channels
    shortest = min(instants_in(r.duration, [r], shown) for r in recordings)
    horizon = min(instants_in(_WINDOW, recordings, shown), max(shortest // 3, 1))
    windows = study_windows(study, model, recordings, horizon, timestep)
    return windows.rows(windows.evenly(_WINDOWS))


def _grid_flags(summary: Overview) -> list[Flag]:
    """Return what `identify` will refuse, and nothing else needs."""
    if summary.candidates <= MOST_CANDIDATES:
        return []
    sentence = f"For identify {too_many(summary.candidates)}. diagnose needs none."
    return [Flag("look", "bounds", tuple(summary.parameters["name"]), sentence)]


def _beside_flags(simulator: MujocoSimulator) -> list[Flag]:
    """Return what the balance of forces, which knows the model file alone, does not know."""
    joints = tuple(dict.fromkeys(w.joint for w in simulator.laws if isinstance(w, ForceLaw)))
    if not joints:
        return []
    sentence = (
        f"Forces stand beside the model at {', '.join(joints)}: predictions have them, the test of "
        "the wiring has not."
    )
    return [Flag("note", "balance", joints, sentence)]


def _identifiability(
    simulator: MujocoSimulator,
    parameters: Sequence[Parameter],
    point: np.ndarray,
    windows: Windows,
    noise: Mapping[str, float],
    recordings: Sequence[Recording],
) -> tuple[pd.DataFrame, list[Flag]]:
    """Return what the recordings say about each parameter at best, and what they do not say."""
    if not parameters:
        return pd.DataFrame({"name": [], "unit": [], "sigma": [], "of_range": []}), []
    seconds = sum(r.duration for r in recordings)
    length = float((windows.step[:, -1] + windows.fraction[:, -1]).mean() * windows.timestep)
    share = max(seconds / (length * len(windows)), 1.0)  # all windows say so much more
    found = information(simulator, point, windows, noise)
    found = replace(found, fisher=found.fisher * share)
    flags = [
        Flag(
            "look",
            "identifiability",
            tuple(names),
            f"These recordings do not determine {in_words(names)}: at best within "
            f"±{196 * min(sigma, 0.5):.0f} % of the range.",
            {"sigma_of_range": sigma, **names},
        )
        for sigma, names in found.weakest()
    ]
    return found.table(), flags
