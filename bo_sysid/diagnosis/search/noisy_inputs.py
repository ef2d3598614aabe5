"""Noise of recorded controls: whether what is recorded there beside the motion reached the machine.

A torque that was measured, or computed from a current, shows noise that the machine never felt.
Above some frequency a spectrum is flat where noise covers everything else. What the model says that
this part of the recording does is compared with what the machine did: it did nothing where the
part is noise of the measurement, and what the model says, or the same later and smoother, where it
was sent.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.signal import butter, sosfiltfilt, welch

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.fit import Fit, by_block, sandwich
from bo_sysid.diagnosis.windows.input_noise import controlled_response, disturbances
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.process_noise import weighting
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.recording import Channel, Recording
from bo_sysid.recording.alignment import control_steps
from bo_sysid.simulation import Controller

_SEGMENT = 256  # samples of a spectrum's segments
_FLAT = 2.0  # times the noise's power, below which a spectrum is noise
_ORDER = 8  # of the filter: what it passes in part is in both of what it parts
_BURST = 4.0  # deviations, from which that is no noise
_WHOLE = (0, 1)  # samples by which the whole of a control is late, whose gain may be wrong
_LATE = (1, 2, 4, 8, 16)  # samples by which what arrives may be late
_SHARE, _SURE = 0.3, 4.0  # of the noise that does not arrive, and in deviations, to be believed
_ALIKE = 2.0  # deviations, where one actuator's is believed, for another's, or to be refuted
_FEW = 24  # windows that tell how far noise moves all of them
_TINY = 1e-9
_FELT = 0.3  # [sigma], and as a share of what the leading set leaves, that noise must do


@dataclass(frozen=True)
class _Noise:
    """The flat part of an actuator's recorded controls.

    Attributes:
        actuator: whose controls.
        sigma: its standard deviation, all frequencies taken together.
        courses: what of it lies where nothing else does, by recording.
    """

    actuator: str
    sigma: float
    courses: tuple[Channel | None, ...]


def noisy_inputs(search: Search) -> dict[str, float]:
    """Return the noise of the recorded controls that the machine did not feel, by actuator.

    Empty where there is none, where it does nothing that could be seen beside what the leading set
    leaves, or where that cannot be told.
    """
    linear, leader = search.frame, search.best
    problem = linear.problem
    actuators_with_law = {w.actuator for w in problem.laws if isinstance(w, Controller)}
    names = [n.removeprefix("ctrl.") for n in problem.model.ctrl_channels]
    flat = (_flat(problem.recordings, n) for n in names if n not in actuators_with_law)
    noises = [n for n in flat if n is not None]
    if not noises or problem.machine.impacts:
        return {}
    few = np.zeros(len(linear.start), bool)  # windows, enough to tell how far it moves them
    few[np.linspace(0, len(few) - 1, _FEW).astype(int)] = True
    response, _ = disturbances(linear.rows(few), {n.actuator: n.sigma for n in noises})
    does = float(np.sqrt((response**2).sum() / problem.seen_in_each[few].sum()))
    if does < _FELT * max(1.0, leader.rms):
        return {}
    shares = _absent(linear, leader, noises)
    sure = any(share > max(_SHARE, _SURE * unsure) for share, unsure in shares)
    sure = sure or any(n.actuator in problem.input_noise for n in noises)
    return {
        n.actuator: n.sigma
        for n, (share, unsure) in zip(noises, shares, strict=True)
        if sure and share > _least(n.actuator in problem.input_noise, unsure)
    }


def _least(known: bool, unsure: float) -> float:
    """Return the share from which a control counts as noisy where one does.

    Its noise was likely measured in the same way; known noise is so until that is refuted.
    """
    return _SHARE - _ALIKE * unsure if known else max(_SHARE, _ALIKE * unsure)


def _flat(recordings: Sequence[Recording], actuator: str) -> _Noise | None:
    """Return the flat part of an actuator's spectrum, None where it has none.

    Its power is the median over the upper half of the frequencies, and it is cut out above the
    last frequency at which there is much more.
    """
    channels = [_long(r.channels.get(f"ctrl.{actuator}")) for r in recordings]
    held = [c for c in channels if c is not None]
    if not held:
        return None
    f = np.fft.rfftfreq(_SEGMENT)  # of a rate of 1
    powers = [welch(c.values, nperseg=_SEGMENT)[1] for c in held]
    power = np.average(powers, axis=0, weights=[c.values.size for c in held])
    floor = float(np.median(power[f > 0.25]))
    more = f[power > _FLAT * floor]
    cut = float(more.max(initial=0.0)) + f[1]
    if floor <= 0 or cut > 0.35:
        return None
    sos, sigma = butter(_ORDER, 2 * cut, "highpass", output="sos"), float(np.sqrt(0.5 * floor))
    courses = tuple(
        c and replace(c, values=_quiet(sosfiltfilt(sos, c.values), sigma)) for c in channels
    )
    return _Noise(actuator, sigma, courses)


def _quiet(values: Float[np.ndarray, " T"], sigma: float) -> Float[np.ndarray, " T"]:
    """Return noise without bursts."""
    return np.where(np.abs(values) < _BURST * sigma, values, 0.0)


def _long(channel: Channel | None) -> Channel | None:
    """Return a channel that is long enough for a spectrum, else None."""
    return channel if channel is not None and channel.values.size >= 2 * _SEGMENT else None


def _absent(linear: Linear, leader: Fit, noises: Sequence[_Noise]) -> list[tuple[float, float]]:
    """Return for each noise the share of it that did not arrive, and its standard deviation.

    It is minus what the residual holds of the response to the noise, beside what the leader's
    magnitudes and a gain of the whole control may change. A share is 0 where the noise arrives
    later (`_LATE`).
    """
    problem = linear.problem
    columns = [leader.jacobian.astype(float), *map(partial(_responses, linear), noises)]
    S = np.concatenate(columns, axis=2)
    y, J = leader.residual, linear.J
    new = {n.actuator: n.sigma for n in noises if n.actuator not in problem.input_noise}
    if new:  # least squares that count with all of it see much more
        weight = weighting(problem.whitened(disturbances(linear, new)[0]))
        S, y, J = (project(weight, part) for part in (S, y, J))
    Q = np.linalg.qr(J)[0]
    S, y = project(Q, S), project(Q, y)
    first, each = leader.jacobian.shape[-1], len(_WHOLE) + 1 + len(_LATE)
    prompt = [first + each * k + len(_WHOLE) for k in range(len(noises))]
    whole = [p - 1 - k for p in prompt for k in range(len(_WHOLE))]
    known = [*range(first), *whole, *prompt]
    c, deviation = _solved(S[..., known], y, problem)
    found = list(zip(-c[-len(noises) :], deviation[-len(noises) :], strict=True))
    for k, at in enumerate(prompt):
        for late in range(at + 1, at + 1 + len(_LATE)):
            c, deviation = _solved(S[..., [*known, late]], y, problem)
            if c[-1] > max(_SHARE, _SURE * deviation[-1]):
                found[k] = (0.0, float(deviation[-1]))
    return [(float(share), float(unsure)) for share, unsure in found]


def _responses(linear: Linear, noise: _Noise) -> Float[np.ndarray, "W R c"]:
    """Return what a whole control does, and then its noise: at once, and late."""
    whole = [r.channels.get(f"ctrl.{noise.actuator}") for r in linear.problem.recordings]
    courses = [_course(linear, whole, lag) for lag in _WHOLE]
    courses += [_course(linear, noise.courses, lag) for lag in (0, *_LATE)]
    shown = controlled_response(linear, noise.actuator, np.stack(courses, axis=-1))
    return linear.problem.whitened(shown)


def _solved(
    S: Float[np.ndarray, "W R p"], y: Float[np.ndarray, "W R"], problem: Problem
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Return the least-squares coefficients of columns, and their standard deviations."""
    scale = np.sqrt((S**2).sum(axis=(0, 1))) + _TINY
    G, g, _ = by_block(S / scale, y, problem.block)
    total = G.sum(axis=0) + _TINY * np.eye(len(scale))
    c = np.linalg.solve(total, g.sum(axis=0))
    left = y - (S / scale) @ c
    scatter = by_block(S / scale, left, problem.block)[1]
    covariance = sandwich(total, scatter, float((left**2).sum()) / problem.dof)
    return c / scale, np.sqrt(np.diag(covariance)) / scale


def _course(
    linear: Linear, channels: Sequence[Channel | None], lag: int
) -> Float[np.ndarray, "W M"]:
    """Return a control over the macro steps of every window, some samples late."""
    windows = linear.problem.windows
    macro = linear.macro * windows.timestep
    out = np.zeros((len(windows), linear.macros))
    for i, channel in enumerate(channels):
        if channel is not None:
            late = lag * float(np.median(np.diff(channel.time)))
            moved = replace(channel, time=channel.time + late)
            own = windows.recording == i
            out[own] = control_steps(moved, windows.time[own], linear.macros, macro)
    return out
