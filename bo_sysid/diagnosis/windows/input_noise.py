"""What a change of the recorded controls does to windows, along the linear model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from bo_sysid.diagnosis.windows.linear import Linear, linearise
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.process_noise import ProcessNoise
from bo_sysid.recording import Recording
from bo_sysid.recording.alignment import OTHER_RATE

_PIECES = 64  # of a window in which noise has a value each, at most
_ROUNDS = 6  # of Gauss-Newton steps
_SHARES = (1.0, 0.4, 0.1)  # of a step, tried one after the other
_WORTH_A_ROUND = 1e-2  # share of the cost that a round must gain to be followed by another
_MOST = 1e6  # [sigma] of a response, in windows that diverge


def controlled_response(
    linear: Linear, actuator: str, change: Float[np.ndarray, "W M c"]
) -> Float[np.ndarray, "W R c"]:
    """Return what changes of one control do, in sigma of the sensors.

    Args:
        linear: the model along a prediction.
        actuator: whose control changes.
        change: `c` courses of its change over the macro steps, in the control's unit.
    """
    column = linear.problem.model.ctrl_channels.index(f"ctrl.{actuator}")
    E = linear.held(linear.E[..., column])
    shown = linear.seen(linear.propagate(np.einsum("wmn,wmc->wmnc", E, change)))
    return np.asarray(np.clip(np.nan_to_num(shown), -_MOST, _MOST))


@dataclass(frozen=True)
class Courses:
    """What k independent noises of size 1 add to the controls of windows.

    Attributes:
        kinds: the courses of each kind of window: those of recordings of one rate are alike.
        kind: of each window.
    """

    kinds: Float[np.ndarray, "g k S nu"]
    kind: Int[np.ndarray, " W"]

    def added(self, drawn: Float[np.ndarray, "W k"]) -> Float[np.ndarray, "W S nu"]:
        """Return what drawn noises add to the controls of each window."""
        out = np.empty((len(drawn), *self.kinds.shape[2:]))
        for number, courses in enumerate(self.kinds):
            own = self.kind == number
            out[own] = np.einsum("wk,ksu->wsu", drawn[own], courses)
        return out


def disturbances(
    linear: Linear, noise: Mapping[str, float]
) -> tuple[Float[np.ndarray, "W R k"], Courses]:
    """Return what white noise of recorded controls does to windows, and its courses.

    A window is cut into pieces of length L, none shorter than the interval h between two controls.
    The mean of the noise over a piece has a deviation of σ √(h/L), and what differs within one is
    smoothed away by the mechanics.

    Args:
        linear: the model along a prediction.
        noise: σ of each sample, by actuator.

    Returns:
        The responses to k independent courses of size 1, and what these add to the controls. Of
        recordings whose controls are slower than others' the last ones may be nothing.
    """
    problem, steps = linear.problem, linear.macro
    last = problem.windows.ctrl.shape[1]
    each = [sampling(problem.recordings, actuator) for actuator in noise]
    rates, kind = np.unique(np.transpose(each), axis=0, return_inverse=True)
    kind = kind.reshape(-1)[problem.windows.recording]
    responses, courses = [], []
    for k, (actuator, sigma) in enumerate(noise.items()):
        changes = [_pieces(linear, interval, sigma) for interval in rates[:, k]]
        most = max(c.shape[1] for c in changes)
        change = np.stack([np.pad(c, ((0, 0), (0, most - c.shape[1]))) for c in changes])
        responses.append(controlled_response(linear, actuator, change[kind]))
        added = np.zeros((len(rates), most, last, problem.windows.ctrl.shape[2]))
        column = problem.model.ctrl_channels.index(f"ctrl.{actuator}")
        added[..., column] = np.repeat(change.transpose(0, 2, 1), steps, axis=2)[..., :last]
        courses.append(added)
    return np.concatenate(responses, axis=2), Courses(np.concatenate(courses, axis=1), kind)


def _pieces(linear: Linear, interval: float, sigma: float) -> Float[np.ndarray, "M c"]:
    """Return the courses of a control over the macro steps, a piece each.

    Args:
        linear: the model along a prediction.
        interval: between two of its samples in [s].
        sigma: of each sample.
    """
    macro = linear.macro * linear.problem.windows.timestep
    least = max(interval / macro, 1.0)
    count = int(np.clip(linear.macros / least, 1, _PIECES))
    piece = np.arange(linear.macros) * count // linear.macros
    length = np.maximum(np.bincount(piece, minlength=count), least) * macro
    return np.asarray(np.eye(count)[piece] * sigma * np.sqrt(interval / length))


def smoothed(linear: Linear, noise: Mapping[str, float]) -> Linear:
    """Return the linear model in units of all noise, along the likely course of the inputs'.

    Noise that moves a window by hundreds of sigma moves it to where another linear model holds.
    Gauss-Newton steps lead to the start and the course that are most likely together.

    Args:
        linear: the model along a prediction, in units of the sensors.
        noise: σ of each sample, by actuator.
    """
    problem, at, start = linear.problem, linear.hypothesis, linear.start
    response, courses = disturbances(linear, noise)
    drawn = np.zeros((len(response), response.shape[2]))
    cost = _cost(problem.deviation(at, start), drawn)
    for _ in range(_ROUNDS):
        before, left = cost.sum(), np.ones(len(cost), bool)
        move, toward = _likeliest(linear, _process(response, courses, drawn))
        for share in _SHARES:
            other = drawn + share * (toward - drawn)
            moved = problem.moved(start, share * move)
            tried = _along(problem, _process(response, courses, other))
            costs = _cost(tried.deviation(at, moved), other)
            better = left & (costs < cost)
            drawn, cost = np.where(better[:, None], other, drawn), np.where(better, costs, cost)
            start, left = start.picked(better, moved), left & ~better
        linear = linearise(_along(problem, _process(response, courses, drawn)), at, start)
        response, _ = disturbances(linear, noise)
        if cost.sum() > (1 - _WORTH_A_ROUND) * before:
            break
    return linear.with_process(_process(response, courses, drawn))


def shaken(
    linear: Linear, noise: Mapping[str, float], rng: np.random.Generator
) -> Float[np.ndarray, "W R"]:
    """Return how drawn noise of the inputs moves what is simulated, in sigma of the sensors."""
    response, courses = disturbances(linear, noise)
    drawn = rng.standard_normal((len(response), response.shape[2]))
    problem, at, start = linear.problem, linear.hypothesis, linear.start
    moved = _along(problem, _process(response, courses, drawn))
    return np.asarray(problem.deviation(at, start) - moved.deviation(at, start))


def _process(
    response: Float[np.ndarray, "W R k"],
    courses: Courses,
    drawn: Float[np.ndarray, "W k"],
) -> ProcessNoise:
    return ProcessNoise.about(response, courses.added(drawn), drawn)


def _along(problem: Problem, process: ProcessNoise) -> Problem:
    """Return the problem with a course of noise in its controls, in units of the sensors."""
    return replace(problem, process=process.unweighted)


def _cost(
    deviation: Float[np.ndarray, "W R"], drawn: Float[np.ndarray, "W k"]
) -> Float[np.ndarray, " W"]:
    """Return twice the negative logarithm of how likely noise of sensors and inputs is."""
    return np.asarray((deviation**2).sum(axis=1) + (drawn**2).sum(axis=1))


def _likeliest(
    linear: Linear, process: ProcessNoise
) -> tuple[Float[np.ndarray, "W n"], Float[np.ndarray, "W k"]]:
    """Return the change of start and the noise that are most likely along a linear model."""
    weighted = linear.with_process(process)
    move = np.einsum("wkr,wr->wk", weighted.start_gain, weighted.residual)
    left = linear.problem.deviation(linear.hypothesis, linear.start) + process.drawn_response
    left = left - np.einsum("wrk,wk->wr", linear.J, move)
    return np.asarray(move), process.likely(left)


def sampling(recordings: Sequence[Recording], actuator: str) -> list[float]:
    """Return the interval between two of an actuator's controls in [s], for each recording.

    Their median, but for those of another rate, which have their own. Where a recording has none
    of its controls there is no noise of them: the interval is 0.
    """
    channels = [r.channels.get(f"ctrl.{actuator}") for r in recordings]
    own = [
        0.0 if c is None or len(c.time) < 2 else float(np.median(np.diff(c.time))) for c in channels
    ]
    usual = float(np.median([h for h in own if h]))
    return [h if not 1 / OTHER_RATE <= h / usual <= OTHER_RATE else usual for h in own]
