"""What a study is made of: its model, recordings and parameters, before anything is fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod

import numpy as np
import pandas as pd

from bo_sysid.mjcf import Model, nominal
from bo_sysid.mjcf.commands import units
from bo_sysid.parameters import MOST_CANDIDATES, CandidateSet, Parameter
from bo_sysid.recording import Recording, Sampling, kind_of
from bo_sysid.recording.alignment import rates_note
from bo_sysid.recording.noise import noise_sigma
from bo_sysid.study.inputs import load_model, load_train
from bo_sysid.study.requirements import (
    known_channels,
    require_actuators,
    require_known,
    require_limits,
    require_numbers,
    require_recorded,
    require_scales,
    unneeded,
)
from bo_sysid.study.study import Study


@dataclass(frozen=True)
class Overview:
    """What a study is made of.

    Attributes:
        name: of the study.
        model: where the model comes from.
        timestep: of the model, in [s].
        recordings: names of the training recordings.
        channels: one row a channel of the model or of a recording: channel, use (what it is in the
            model), recordings that have it, samples, interval in [ms], low, high, unit, noise
            (standard deviation).
        parameters: one row a parameter: name, unit, addresses, apply, nominal, low, high, steps.
        candidates: number N of candidates in B; 0 where nothing is uncertain. Of a grid it may be
            more than can be searched, since not every command searches it.
        notes: what was done to the data.
    """

    name: str
    model: str
    timestep: float
    recordings: tuple[str, ...]
    channels: pd.DataFrame
    parameters: pd.DataFrame
    candidates: int
    notes: tuple[str, ...]


def overview(study: Study, *, strict: bool = False) -> Overview:
    """Load what a study names, and match recordings and parameters with the model.

    Args:
        study: the study.
        strict: refuse messy recordings.

    Raises:
        UserError: something is wrong or does not fit together.
    """
    model = load_model(study)
    recordings = load_train(study, strict=strict)
    _ = study.holdout_files  # named wrongly, it is told now; nothing in it is read
    for recording in recordings:
        require_known(model, recording)
    require_scales(study, model)
    require_actuators(study, model)
    require_limits(study, model)
    parameters = study.parameter_set(model)
    require_numbers(study, model)
    unrecorded = _silent(model) | unneeded(study, model)
    require_recorded(study, model, recordings)
    rates = rates_note(recordings, model.qpos_channels)
    return Overview(
        study.name,
        model.source,
        float(model.compile().opt.timestep),
        tuple(r.name for r in recordings),
        _channels(model, recordings, unrecorded),
        described(model, parameters),
        candidate_count(study, parameters),
        tuple(dict.fromkeys([*rates, *(n for r in recordings for n in r.notes)])),
    )


def candidate_set(study: Study, parameters: Sequence[Parameter]) -> CandidateSet:
    """Return the discrete set B: the full grid, or a Sobol design of the stated size.

    Raises:
        StudyError: the grid is too large to be searched.
    """
    size = study.search.candidates.sobol
    if size is None:
        require_searchable(study, candidate_count(study, parameters))
        return CandidateSet.from_grid(parameters)
    if size > MOST_CANDIDATES:
        raise study.error(
            ("search", "candidates", "sobol"), f"is {size:,}; at most {MOST_CANDIDATES:,}"
        )
    return CandidateSet.from_sobol(parameters, size, study.search.seed)


def candidate_count(study: Study, parameters: Sequence[Parameter]) -> int:
    """Return the number of candidates in B, of a grid that is too large for `candidate_set` too."""
    if not parameters:
        return 0
    if study.search.candidates.sobol is None:
        return prod(p.steps for p in parameters)
    return len(candidate_set(study, parameters))


def require_searchable(study: Study, count: int) -> None:
    """Refuse a set B of more candidates than can be searched; see `Overview.candidates`.

    Raises:
        StudyError: the message says how else to choose candidates.
    """
    if count > MOST_CANDIDATES:
        raise study.error(("search", "candidates"), too_many(count))


def too_many(count: int) -> str:
    """Return what to do about a grid that is too large."""
    return (
        f"a grid of {count:,} candidates is searched by nothing, at most {MOST_CANDIDATES:,} are: "
        "search: {candidates: {sobol: 20000}} takes a sample of it, fewer steps make it smaller"
    )


def described(model: Model, parameters: Sequence[Parameter]) -> pd.DataFrame:
    """Return one row a parameter: name, unit, addresses, apply, nominal, low, high, steps."""
    return pd.DataFrame(
        {
            "name": [p.name for p in parameters],
            "unit": [p.unit for p in parameters],
            "addresses": [", ".join(p.addresses) for p in parameters],
            "apply": [p.apply for p in parameters],
            "nominal": [nominal(model, p) for p in parameters],
            "low": [p.low for p in parameters],
            "high": [p.high for p in parameters],
            "steps": [p.steps for p in parameters],
        }
    )


def _silent(model: Model) -> dict[str, str]:
    """Return the channels of joints that move though nothing measures them, with what they do."""
    following = set(model.loops.joints)
    return {
        f"{kind}.{j}": "follows from others" if j in following else "moves unmeasured"
        for kind in ("qpos", "qvel")
        for j in model.unrecorded
    }


def _channels(
    model: Model, recordings: Sequence[Recording], unrecorded: Mapping[str, str]
) -> pd.DataFrame:
    known, assumed = known_channels(model), units(model.compile())
    needed = [*known["qpos"], *known["qvel"], *known["ctrl"]]
    recorded = dict.fromkeys(n for r in recordings for n in r.channels)
    rows = []
    for name in dict.fromkeys([*needed, *recorded]):
        found = [r.channels[name] for r in recordings if name in r.channels]
        row: dict[str, object] = {
            "channel": name,
            "use": "in the model" if kind_of(name) in known else "auxiliary",
            "recordings": f"{len(found)} of {len(recordings)}",
            "samples": sum(len(c.time) for c in found),
        }
        if name in unrecorded or not found:
            row["use"] = unrecorded.get(name, "estimated from qpos")
        if found:
            row |= {
                "interval": 1e3 * float(np.median([Sampling.of(c.time).median_dt for c in found])),
                "low": min(float(c.values.min()) for c in found),
                "high": max(float(c.values.max()) for c in found),
                "unit": found[0].unit or assumed.get(name, ""),
            }
            if found[0].hold == "none":
                row["noise"] = float(np.median([noise_sigma(c.time, c.values) for c in found]))
        rows.append(row)
    return pd.DataFrame(rows)
