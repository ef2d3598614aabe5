"""What a study is made of: its model, recordings and parameters, before anything is fitted."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from math import prod

import numpy as np
import pandas as pd

from bo_sysid.errors import ModelError, RecordingError, nearest
from bo_sysid.mjcf import Address, Loops, Model, nominal
from bo_sysid.mjcf.commands import controls_without_gain
from bo_sysid.parameters import MOST_CANDIDATES, CandidateSet, Parameter
from bo_sysid.recording import Recording, Sampling, kind_of
from bo_sysid.recording.noise import noise_sigma
from bo_sysid.recording.value import UNUSED
from bo_sysid.study.inputs import load_model, load_train
from bo_sysid.study.study import Study

MEASURED = ("qpos", "qvel", "sensor")
"""Kinds of channels that predictions are compared with."""


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
    _require_numbers(study, model)
    unrecorded = _unneeded(study, model)
    require_recorded(study, model, recordings)
    return Overview(
        study.name,
        model.source,
        float(model.compile().opt.timestep),
        tuple(r.name for r in recordings),
        _channels(model, recordings, unrecorded),
        described(model, parameters),
        candidate_count(study, parameters),
        tuple(dict.fromkeys(n for r in recordings for n in r.notes)),
    )


def _require_numbers(study: Study, model: Model) -> None:
    """Require that what a study calls certain is a number of its model."""
    for i, address in enumerate(study.diagnosis.known):
        try:
            Address.parse(address).matches(model)
        except ModelError as error:
            raise study.error(("diagnosis", "known", i), str(error)) from None


def require_known(model: Model, recording: Recording) -> None:
    """Refuse what the model does not have, and one column for two joints that move on their own.

    Raises:
        RecordingError: the message names the channel and the nearest one of the model, or the
            channels and the nearest column that is not used.
    """
    known = _known(model)
    for name in recording.channels:
        kind = kind_of(name)
        if kind in known and name not in known[kind]:
            raise RecordingError(
                f"{recording.name}: channel {name!r} is not in the model {model.source}; "
                f"{nearest(name, known[kind]) or f'it has no {kind} at all'}"
            )
    _require_own_columns(model, recording)


def _require_own_columns(model: Model, recording: Recording) -> None:
    """Refuse one column for two joints, but for those that the model ties to others."""
    unused = [n.removeprefix(UNUSED) for n in recording.notes if n.startswith(UNUSED)]
    for kind in ("qpos", "qvel"):
        first: dict[str, str] = {}
        for joint, channel in recording.of_kind(kind).items():
            other = first.setdefault(channel.source, joint)
            if other == joint or not channel.source:
                continue
            if {other, joint} & set(model.loops.joints):
                continue
            name = f"{kind}.{joint}"
            near = nearest(name, [c for n in unused for c in n.removesuffix(".").split(", ")])
            raise RecordingError(
                f"{channel.source}: this column is read as {kind}.{other} and as {name}; each "
                "joint needs one of its own, unless an equality of the model ties it to another"
                + (f"; of those that are not used: {near}" if near else "")
            )


def require_actuators(study: Study, model: Model) -> None:
    """Refuse a law for an actuator that the model does not have.

    Raises:
        StudyError: there is one.
    """
    for name in study.actuators:
        if name not in model.actuators:
            near = nearest(name, model.actuators)
            raise study.error(("actuators", name), f"the model has no such actuator; {near}")


def require_limits(study: Study, model: Model) -> None:
    """Refuse limits of a joint that the model does not have, or not any more.

    Raises:
        StudyError: there is one.
    """
    for name in study.limits:
        if name not in model.joints:
            gone = ", since it is held" if name in study.model.hold else ""
            near = nearest(name, model.joints)
            raise study.error(("limits", name), f"the model has no such joint{gone}; {near}")


def require_scales(study: Study, model: Model) -> None:
    """Refuse noise or a scale for what is neither a kind of channel nor a channel of the model.

    Raises:
        StudyError: the message names the nearest kind or channel.
    """
    known = _known(model)
    valid = [name for kind in MEASURED for name in (kind, *known[kind])]
    given = {("recordings", "noise"): study.recordings.noise}
    if study.deviation.whiten != "auto":
        given["deviation", "whiten"] = study.deviation.whiten
    for key, scales in given.items():
        for name in scales:
            if name not in valid:
                raise study.error(
                    (*key, name),
                    f"the model measures no such kind or channel; {nearest(name, valid)}",
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


def _known(model: Model) -> dict[str, tuple[str, ...]]:
    return {
        "qpos": model.qpos_channels,
        "qvel": model.qvel_channels,
        "act": model.act_channels,
        "ctrl": model.ctrl_channels,
        "sensor": model.sensor_channels,
        "goal": tuple(f"goal.{a}" for a in model.actuators),
    }


def _deaf(model: Model) -> list[str]:
    """Return the channels of the controls that do nothing."""
    return list(compress(model.ctrl_channels, controls_without_gain(model.compile())))


def _unneeded(study: Study, model: Model) -> dict[str, str]:
    """Return the controls that need not be recorded, with the reason."""
    without = dict.fromkeys(_deaf(model), "without effect")
    return without | {f"ctrl.{n}": f"computed by {a.law}" for n, a in study.actuators.items()}


def require_recorded(study: Study, model: Model, recordings: Sequence[Recording]) -> None:
    """Refuse recordings without a position or control that the model needs, and say what helps."""
    unneeded = _unneeded(study, model)
    for recording in recordings:
        _require_all(model, recording, unneeded)


def _require_all(model: Model, recording: Recording, unrecorded: Mapping[str, str]) -> None:
    silent = {f"qpos.{j}" for j in model.unrecorded}
    for name in (*model.qpos_channels, *model.ctrl_channels):
        if name not in recording.channels and name not in unrecorded and name not in silent:
            said = (
                f"{recording.name}: no channel {name!r}, which the model needs; "
                f"{recording.hint(name)}"
            )
            if name.startswith("qpos."):
                end = "" if said.endswith("?") else "."
                said += f"{end} {_remedy(model, recording, _joint(model, name))}"
            raise RecordingError(said)


def _remedy(model: Model, recording: Recording, joint: str) -> str:
    """Return what to write for a joint that was not recorded."""
    silent = [n for n in model.joints if f"qpos.{n}" not in recording.channels]
    following = [n for n in Loops.of(model.compile(), silent).joints if n in silent]
    if joint in following:
        nothing = ", ".join(f"{n}: null" for n in following)
        return (
            "It follows from the recorded joints through the model's equalities: model: "
            f"{{file: …, unrecorded: {{{nothing}}}}}"
        )
    still = f"To hold the joint still instead: model: {{file: …, hold: [{joint}]}}"
    if f"qpos.{joint}" not in model.qpos_channels:  # several coordinates: a ball, a free joint
        return still
    return f"{still}; to let it move unmeasured: model: {{file: …, unrecorded: {{{joint}: null}}}}"


def _joint(model: Model, position: str) -> str:
    """Return the joint of a channel ``qpos.<joint>`` or ``qpos.<joint>.<index>``."""
    name = position.removeprefix("qpos.")
    return name if name in model.joints else name.rpartition(".")[0]


def _channels(
    model: Model, recordings: Sequence[Recording], unrecorded: Mapping[str, str]
) -> pd.DataFrame:
    known = _known(model)
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
                "unit": found[0].unit,
            }
            if found[0].hold == "none":
                row["noise"] = float(np.median([noise_sigma(c.time, c.values) for c in found]))
        rows.append(row)
    return pd.DataFrame(rows)
