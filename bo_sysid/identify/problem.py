"""From a study to the deviation that the search minimises."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from bo_sysid.arrays import Point
from bo_sysid.deviation import Deviation, Whitening
from bo_sysid.errors import nearest
from bo_sysid.mjcf import Address, Model
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation import Controller, Engine, MujocoSimulator, Windows, cut
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_function, load_model, load_train


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
    """

    study: Study
    model: Model
    recordings: tuple[Recording, ...]
    parameters: tuple[Parameter, ...]
    candidates: CandidateSet
    deviation: Deviation

    @property
    def nominal(self) -> Point:
        """The `d` parameter values that leave the model as it is."""
        return nominal_point(self.model, self.parameters)

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
        windows = _cut(self.study, self.model, recordings, horizon)
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
    parameters = study.parameter_set(model)
    if not parameters:
        raise study.error(
            ("parameters",), "identify needs at least one uncertain parameter; the study has none"
        )
    simulator = make_simulator(study, model, parameters, threads=threads)
    windows = _cut(study, model, recordings)
    whiten = study.deviation.whiten
    noise = study.recordings.noise if whiten == "auto" else whiten
    deviation = Deviation(
        simulator,
        windows,
        Whitening.of(windows, noise),
        fitted_starts=study.deviation.starts == "fitted",
    )
    return Problem(
        study, model, recordings, parameters, candidate_set(study, parameters), deviation
    )


def make_simulator(
    study: Study, model: Model, parameters: Sequence[Parameter], *, threads: int = 0
) -> MujocoSimulator:
    """Return the simulator of a study: its model, its parameters and its actuators' laws."""
    for name in study.actuators:
        if name not in model.actuators:
            near = nearest(name, model.actuators)
            raise study.error(("actuators", name), f"the model has no such actuator; {near}")
    laws = tuple(Controller(n, load_function(study, a.law)) for n, a in study.actuators.items())
    return MujocoSimulator(model, tuple(parameters), Engine(threads), laws)


def candidate_set(study: Study, parameters: Sequence[Parameter]) -> CandidateSet:
    """Return the discrete set B: the full grid, or a Sobol design of the stated size."""
    size = study.search.candidates.sobol
    if size is None:
        return CandidateSet.from_grid(parameters)
    return CandidateSet.from_sobol(parameters, size, study.search.seed)


def nominal_point(model: Model, parameters: Sequence[Parameter]) -> Point:
    """Return the values that leave the model as it is: its own, a factor of 1, a change of 0."""
    neutral = {"scale": 1.0, "add": 0.0}
    return np.array(
        [
            neutral[p.apply] if p.apply in neutral else Address.parse(p.addresses[0]).read(model)
            for p in parameters
        ]
    )


def described(model: Model, parameters: Sequence[Parameter]) -> pd.DataFrame:
    """Return one row a parameter: name, unit, addresses, nominal value, bounds and grid."""
    return pd.DataFrame(
        {
            "name": [p.name for p in parameters],
            "unit": [p.unit for p in parameters],
            "addresses": [", ".join(p.addresses) for p in parameters],
            "apply": [p.apply for p in parameters],
            "nominal": nominal_point(model, parameters),
            "low": [p.low for p in parameters],
            "high": [p.high for p in parameters],
            "steps": [p.steps for p in parameters],
        }
    )


def _cut(
    study: Study, model: Model, recordings: Sequence[Recording], horizon: int | None = None
) -> Windows:
    signals = sorted({channel for a in study.actuators.values() for channel in a.uses})
    return cut(
        model,
        recordings,
        horizon=horizon or study.deviation.horizon,
        signals=signals,
        controlled=tuple(study.actuators),
    )
