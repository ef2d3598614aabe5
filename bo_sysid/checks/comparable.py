"""What of a log can be compared with a model: hinges and slides that were recorded for a while."""

import copy
from collections.abc import Iterable, Sequence
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.checks.motion import beyond_range
from bo_sysid.checks.traces import Traces, gap_ends
from bo_sysid.mjcf.commands import LAGS, controlled
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.mjcf.touching import touched
from bo_sysid.recording import Recording

_LEAST = 60  # instants that are looked at
_NEAR = 0.002  # of its range, from which on a joint is at its stop
_ABOUT = 4.0  # standard deviations of the filter, within which a stop or a contact is felt
_ENOUGH = 0.2  # of the instants, that must be left
_MOSTLY = 0.8  # of the samples, from which commands beyond their range are in another unit
_RARELY = 0.01  # of the instants, in which a tendon may be at its limit
_SETTLED = (6.0, 3.0)  # time constants after which a lag has forgotten; the less, the more is left


def comparable(
    model: mujoco.MjModel, recordings: Sequence[Recording], most: int
) -> tuple[mujoco.MjModel, Traces] | str:
    """Return a copy of a model without stops that did not act, and traces to compare it with.

    Where they cannot be compared, why.

    Args:
        model: the compiled model; it is not changed.
        recordings: of the machine.
        most: number of instants that are looked at.
    """
    positions = [f"qpos.{model.joint(j).name}" for j in range(model.njnt)]
    measured = [n for n in positions if all(n in r.channels for r in recordings)]
    if not all(int(t) in SCALAR for t in model.jnt_type):
        return "a joint is neither a hinge nor a slide"
    if not measured:
        return "no joint was recorded"
    traces = Traces(recordings, measured, most)
    if traces.count < _LEAST:
        return _too_short(traces)
    traces = _off_contact(model, _off_stops(model, _settled(model, traces)))
    if tight := _tight(model, traces):
        return f"the tendon {tight} is at its limit in the recordings, and its tension is unknown"
    free = copy.copy(model)
    for joint in beyond_range(model, recordings):
        free.jnt_limited[free.joint(joint).id] = 0
    return free, traces


def as_acting(
    model: mujoco.MjModel, recordings: Sequence[Recording]
) -> tuple[Recording, ...] | None:
    """Return recordings with their commands as they act: clipped to the model's control ranges.

    None where no command leaves its range. One that mostly lies beyond it is in another unit, and
    is left as it is.

    Args:
        model: the compiled model.
        recordings: of the machine.
    """
    ranges = {
        f"ctrl.{model.actuator(a).name}": model.actuator_ctrlrange[k]
        for k, a in enumerate(controlled(model))
        if model.actuator_ctrllimited[k]
    }
    made, clipped = [], False
    for recording in recordings:
        channels = dict(recording.channels)
        for name in ranges.keys() & channels.keys():
            values, (low, high) = channels[name].values, ranges[name]
            beyond = (values < low) | (values > high)
            if 0 < np.count_nonzero(beyond) < _MOSTLY * len(values):
                channels[name] = replace(channels[name], values=np.clip(values, low, high))
                clipped = True
        made.append(replace(recording, channels=channels))
    return tuple(made) if clipped else None


def _too_short(traces: Traces) -> str:
    """Return why there are too few instants in recordings."""
    needed, has = traces.required_seconds(_LEAST), traces.seconds
    if has > needed:
        return "gaps in the recordings leave too few stretches to look at"
    reason = (
        f", since the noise of {traces.noisiest} needs a wide filter" if traces.noisiest else ""
    )
    return f"the recordings are too short; they have {has:.2g} s, and need {needed:.2g} s{reason}"


def _settled(model: mujoco.MjModel, traces: Traces) -> Traces:
    """Return traces without instants at which a drive acts on what no log has, if enough are left.

    A lag follows the commands of a gap, and those before the log began, for some time constants; an
    actuator with a delay acts on them that much later.
    """
    memory = {
        f"ctrl.{model.actuator(a).name}": np.array(_memory(model, a))
        for a in controlled(model)
        if any(_memory(model, a))
    }
    for count in _SETTLED if memory else ():
        kept = []
        for recording, instants in zip(traces.recordings, traces.instants, strict=True):
            lagged = memory.keys() & recording.channels.keys()
            longest = max((float(memory[n] @ (count, 1.0)) for n in lagged), default=0.0)
            clear = longest + _ABOUT * traces.width
            good = np.ones(len(instants), bool)
            for first, last in _unknown(recording, lagged, traces) if lagged else ():
                good &= np.searchsorted(first, instants) == np.searchsorted(last + clear, instants)
            kept.append(instants[good])
        if (settled := _enough(traces, kept)) is not traces:
            return settled
    return traces


def _memory(model: mujoco.MjModel, a: int) -> tuple[float, float]:
    """Return the time constant and the delay of an actuator, in [s]."""
    lag = model.actuator_dynprm[a, 0] if int(model.actuator_dyntype[a]) in LAGS else 0.0
    return float(lag), float(model.actuator_delay[a])


def _unknown(
    recording: Recording, controls: Iterable[str], traces: Traces
) -> list[tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]]:
    """Return when stretches without commands begin and end: what precedes them, and gaps."""
    begin = max(recording.channels[n].time[0] for n in controls)
    gaps = [gap_ends(recording.channels[n].time, traces.width) for n in traces.measured]
    return [(np.array([-np.inf]), np.array([begin])), *gaps]


def _off_stops(model: mujoco.MjModel, traces: Traces) -> Traces:
    """Return traces without the instants about which a joint is at its stop, if enough are left.

    A stop gives what holds against it, over less time than the filter resolves.
    """
    kept = []
    for recording, instants in zip(traces.recordings, traces.instants, strict=True):
        good = np.ones(len(instants), bool)
        for j in np.flatnonzero(model.jnt_limited):
            if (channel := recording.channels.get(f"qpos.{model.joint(int(j)).name}")) is None:
                continue
            (low, high), inside = model.jnt_range[j], _NEAR * np.ptp(model.jnt_range[j])
            at = (channel.values < low + inside) | (channel.values > high - inside)
            good &= _away(instants, channel.time[at], traces.width)
        kept.append(instants[good])
    return _enough(traces, kept)


def _off_contact(model: mujoco.MjModel, traces: Traces) -> Traces:
    """Return traces without the instants about which geoms touch, if enough are left."""
    if len(traces.measured) < model.njnt:
        return traces
    hit, kept = touched(model, _poses(model, traces)), []
    for instants in traces.instants:
        own, hit = hit[: len(instants)], hit[len(instants) :]
        kept.append(instants[_away(instants, instants[own], traces.width)])
    return _enough(traces, kept)


def _away(
    instants: Float[np.ndarray, " n"], stamps: Float[np.ndarray, " m"], width: float
) -> Bool[np.ndarray, " n"]:
    """Return which instants no stamp is within reach of a filter of."""
    ends = np.array([-np.inf, *stamps, np.inf])
    after = np.searchsorted(ends, instants)
    nearest = np.minimum(ends[after] - instants, instants - ends[after - 1])
    return np.asarray(nearest > _ABOUT * width)


def _enough(traces: Traces, kept: Sequence[Float[np.ndarray, " n"]]) -> Traces:
    """Return traces at the instants that are kept, or as they are where those are too few."""
    count = sum(map(len, kept))
    return traces if count < max(_LEAST, _ENOUGH * traces.count) else traces.at(kept)


def _poses(model: mujoco.MjModel, traces: Traces) -> Float[np.ndarray, "n nq"]:
    """Return the recorded poses; joints that were not recorded are where the model puts them."""
    poses = np.tile(model.qpos0, (traces.count, 1))
    for name in traces.measured:
        column = int(model.joint(name.removeprefix("qpos.")).qposadr[0])
        poses[:, column] = traces.column(name, held=False)
    return np.asarray(poses)


def _tight(model: mujoco.MjModel, traces: Traces) -> str:
    """Return a tendon that is at its limit in the recorded poses, empty where none is."""
    if not model.tendon_limited.any():
        return ""
    poses, data = _poses(model, traces), mujoco.MjData(model)
    lengths = np.empty((traces.count, model.ntendon))
    for length, pose in zip(lengths, poses, strict=True):
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(model, data)
        length[:] = data.ten_length
    low, high = (model.tendon_range + np.array([1, -1]) * model.tendon_margin[:, None]).T
    at = ((lengths < low) | (lengths > high)).mean(axis=0) * model.tendon_limited
    worst = int(np.argmax(at))
    return str(model.tendon(worst).name) if at[worst] > _RARELY else ""
