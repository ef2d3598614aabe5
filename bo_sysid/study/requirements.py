"""What a study, its model and its recordings require of each other, and what helps."""

from collections.abc import Mapping, Sequence
from itertools import compress

from bo_sysid.errors import ModelError, RecordingError, nearest
from bo_sysid.mjcf import Address, Loops, Model
from bo_sysid.mjcf.commands import controls_without_gain
from bo_sysid.recording import Recording, kind_of
from bo_sysid.recording.value import UNUSED
from bo_sysid.study.study import Study

MEASURED = ("qpos", "qvel", "sensor")
"""Kinds of channels that predictions are compared with."""
_SUMMED = (
    "Where speed alone was measured, sum it up over time into a column of positions (trapezoids); "
    "its drift is harmless where nothing depends on the position itself"
)


def require_numbers(study: Study, model: Model) -> None:
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
    known = known_channels(model)
    for name in recording.channels:
        kind = kind_of(name)
        if kind in known and name not in known[kind]:
            near = nearest(name, known[kind]) or f"it has no {kind} at all"
            advice = _to_leave_out(recording, name)
            end = "." if advice and not near.endswith("?") else ""
            raise RecordingError(
                f"{recording.name}: channel {name!r} is not in the model {model.source}; {near}"
                f"{end}{advice}"
            )
    _require_own_columns(model, recording)


def _to_leave_out(recording: Recording, name: str) -> str:
    """Return how to leave out a column that a log itself calls like a channel; else nothing."""
    if not recording.channels[name].source.endswith(f": {name}"):
        return ""
    element = name.partition(".")[2]
    return (
        f" If the model has no need of that column: recordings: columns: {{aux.{element}: "
        f"{{from: {name}}}}}"
    )


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
    known = known_channels(model)
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


def known_channels(model: Model) -> dict[str, tuple[str, ...]]:
    """Return the channels of a model by kind."""
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


def unneeded(study: Study, model: Model) -> dict[str, str]:
    """Return the controls that need not be recorded, with the reason."""
    without = dict.fromkeys(_deaf(model), "without effect")
    return without | {f"ctrl.{n}": f"computed by {a.law}" for n, a in study.actuators.items()}


def require_recorded(study: Study, model: Model, recordings: Sequence[Recording]) -> None:
    """Refuse recordings without a position or control that the model needs, and say what helps."""
    spared = unneeded(study, model)
    for recording in recordings:
        _require_all(model, recording, spared)


def require_position(model: Model, recordings: Sequence[Recording], what: str) -> None:
    """Refuse recordings of which none says where any joint was.

    Args:
        model: the nominal model.
        recordings: of one machine.
        what: needs a position.

    Raises:
        RecordingError: the message says what else there is, and what helps.
    """
    if any(r.of_kind("qpos") for r in recordings):
        return
    first = model.qpos_channels[0]
    names, has = ", ".join(r.name for r in recordings), (n for r in recordings for n in r.channels)
    raise RecordingError(
        f"{names}: no position was recorded, and {what} needs one at least, of "
        f"{', '.join(model.qpos_channels)}; recorded: {', '.join(dict.fromkeys(has))}. Say which "
        f"column it is, for instance recordings: columns: {{{first}: {{from: …, unit: deg}}}}. "
        f"{_SUMMED}"
    )


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
                if name.replace("qpos.", "qvel.", 1) in recording.channels:
                    said += f". {_SUMMED}"
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
