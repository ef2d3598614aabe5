"""What to record next: the motion that would tell apart what these recordings cannot.

Every proposed motion is simulated with the answer in the model; the rival is then fitted to that
simulation, starts and all, as it would be to a recording. What it cannot fit is the separation.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import mujoco
import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.diagnosis.answer.explain import Outcome
from bo_sysid.diagnosis.answer.findings import named
from bo_sysid.diagnosis.answer.sentences import unit_words
from bo_sysid.diagnosis.answer.unexplained import Unexplained
from bo_sysid.diagnosis.answer.wording import spoken
from bo_sysid.diagnosis.search.locate import Located
from bo_sysid.diagnosis.sets.decide import Decision
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.groups import units_beyond, units_of
from bo_sysid.diagnosis.sets.refit import Effort, refit_at
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.observation import observe
from bo_sysid.diagnosis.windows.problem import Problem, Simulated
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import Machine, Site
from bo_sysid.errors import StudyError, UserError
from bo_sysid.excite.limits import Limits, knows_effort
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Controller
from bo_sysid.study.outer import Limit

EXPERIMENT = "next_experiment.csv"
"""File in the run folder with the controls to be recorded."""

_LENGTH = 4.0  # [s] of a proposed motion
_RIVALS, _OPEN = 2, 0.05  # how many rivals are looked at; probability from which a set is one
_SEPARATES = 0.5  # [sigma] per sample below which a motion separates nothing
_SLOW, _MIDDLE, _FAST = 0.15, 0.8, 3.0  # [Hz]
_SMALLER, _TRIES = 0.7, 8  # factor by which a motion is made smaller until it keeps the limits
_BEYOND = 0.15  # share by which a motion may exceed what was recorded where no limit is stated
_AT_REST = 1e-9  # [m] or [rad], and a second, of a joint that never moved
_EFFORT = Effort(iterations=5, gain=1.0, final=True)

_VARY = {
    "position": "visit every position of the joint in both directions, slowly and fast",
    "speed": "run the joint at several constant speeds, in both directions",
    "control": "repeat one motion with other commands: another load, or another gain",
    "load": "repeat one motion with a known weight added",
    "time": "run the same motion from cold to warm, and again after a pause",
    "other_joint": "hold the joint and move the others one at a time",
}


@dataclass(frozen=True)
class Experiment:
    """What to record next.

    Attributes:
        sentence: what to do and why.
        separates: the sets that it would tell apart.
        separation: rms difference of their predictions in sigma, after the rival was fitted.
        controls: time [s] and one column an actuator; None where words must do.
    """

    sentence: str
    separates: tuple[tuple[Mapping[str, Any], ...], ...]
    separation: float
    controls: pd.DataFrame | None

    def as_json(self) -> dict[str, Any]:
        """Return the content of the key `next_experiment` of an answer."""
        return {
            "sentence": self.sentence,
            "separates": [list(s) for s in self.separates],
            "separation": self.separation,
            "unit": "sensor sigma",
            "file": None if self.controls is None else EXPERIMENT,
        }


def next_experiment(
    located: Located, outcome: Outcome, stated: Mapping[str, Limit]
) -> Experiment | None:
    """Return what would tell apart what the recordings cannot; None where nothing is open.

    Args:
        located: the decision.
        outcome: what it amounts to.
        stated: the study's limits; what was recorded binds where there are none.
    """
    if outcome.unexplained.flagged:
        return _about_unknown(outcome.unexplained)
    best, rivals = outcome.fit, _rivals(located.decision)
    if best.key != located.decision.best.key or not rivals:
        return None
    problem = located.prepared.problem
    machine = problem.machine
    separates = tuple(named(f, machine) for f in (best, *rivals))
    bounds = _Bounds.of(located.evidence.given, stated, problem, best)
    separation, name, controls = _most_separating(problem, best, rivals, bounds)
    if controls is None or separation < _SEPARATES:
        tried = bounds is not None and next(_motions(problem), None) is not None
        recorded = "the recorded positions, speeds and efforts (the study states no limits)"
        within = "the limits" if stated else recorded
        words = _in_words(best, rivals, machine, within if tried else "")
        return Experiment(words, separates, separation, None)
    one, other = _what_it_adds(best, other=rivals[0]), _what_it_adds(rivals[0], other=best)
    return Experiment(
        f"Record {name}: {one} and {other}, which these recordings do not tell apart, then differ "
        f"by {separation:.2g} sensor sigmas.",
        separates,
        separation,
        _frame(problem, controls),
    )


@dataclass(frozen=True)
class _Bounds:
    """What a motion must keep: limits, and that no parts of the machine touch.

    Attributes:
        limits: of every degree of freedom: the study's, within those of the model; about what was
            recorded where none is stated.
        whole: the compiled model with all that can touch. Recordings in which nothing does are
            explained without.
    """

    limits: Limits
    whole: mujoco.MjModel

    @classmethod
    def of(
        cls, given: Model, stated: Mapping[str, Limit], problem: Problem, best: Fit
    ) -> "_Bounds | None":
        """Return the bounds of the given model; None where limits are not known of its joints.

        Args:
            given: model of the study.
            stated: the study's limits.
            problem: the recordings.
            best: the answer, which says what speeds and efforts they show.
        """
        try:
            limits, whole = Limits.of(given, stated), given.compile()
        except StudyError:  # they are known of hinges and slides only
            return None
        unstated = [n for n in limits.joints if n not in stated or stated[n].position is None]
        return cls(_within_recorded(limits, unstated, whole, problem, best), whole)


def _within_recorded(
    limits: Limits, unstated: Sequence[str], whole: mujoco.MjModel, problem: Problem, best: Fit
) -> Limits:
    """Return limits with what the recordings show, and a little more, where none is stated.

    Args:
        limits: the study's, within the ranges of the model's joints.
        unstated: joints whose positions the study does not limit.
        whole: the compiled model that the limits are of.
        problem: the recordings.
        best: the answer, which says what speeds and efforts they show.
    """
    shown, more = problem.simulate(best.hypothesis, best.start), 1.0 + _BEYOND
    position, fastest = limits.position.copy(), np.abs(shown.trajectory.qvel).max(axis=(0, 1))
    for j in problem.machine.joints.values():
        dof = int(whole.joint(j.name).dofadr[0])
        fastest[dof] = max(fastest[dof], j.speed, _AT_REST)
        if j.name in unstated:
            recorded = j.middle + (0.5 + _BEYOND) * j.span * np.array([-1.0, 1.0])
            low, high = np.clip(recorded, *position[dof])
            position[dof] = low, max(high, low + _AT_REST)
    velocity = np.where(np.isfinite(limits.velocity), limits.velocity, more * fastest)
    effort = limits.effort
    if knows_effort(whole):
        force = np.abs(limits.torque([whole], shown.trajectory, shown.ctrl)).max(axis=(0, 1))
        effort = np.where(np.isfinite(effort) | (force == 0), effort, more * force)
    return replace(limits, position=position, velocity=velocity, effort=effort)


def _most_separating(
    problem: Problem, best: Fit, rivals: Sequence[Fit], bounds: _Bounds | None
) -> tuple[float, str, Float[np.ndarray, "T nu"] | None]:
    """Return the motion that a rival is worst at, with its name and separation; None if none."""
    found: tuple[float, str, np.ndarray | None] = (0.0, "", None)
    if bounds is None:  # words must do
        return found
    for name, controls in _motions(problem):
        try:
            planned = _kept(problem, best, bounds, controls)
            if planned is None:
                continue
            separation = min(_separation(problem, r, planned[1]) for r in rivals)
        except UserError:  # a rival diverges: no number says by how much they differ
            continue
        if separation > found[0]:
            found = (separation, name, planned[0])
    return found


def _rivals(decision: Decision) -> tuple[Fit, ...]:
    rivals = list(decision.equivalents)
    for f, p in zip(decision.fits, decision.probability, strict=True):
        if f is not decision.best and p >= _OPEN and f not in rivals:
            rivals.append(f)
    return tuple(rivals[:_RIVALS])


def _about_unknown(unexplained: Unexplained) -> Experiment:
    where = "the machine"
    if unexplained.kind == "joint" and unexplained.site is not None:
        where = spoken(Site("joint", unexplained.site))
    ways = [_VARY[d] for d in unexplained.depends_on] or ["vary one thing at a time"]
    if unexplained.much:
        ways = ["move one joint at a time, slowly and fast", "do so with a known weight added"]
    text = f"To learn what acts on {where}: {'; '.join(ways)}."
    return Experiment(text, (), 0.0, None)


def _in_words(best: Fit, rivals: Sequence[Fit], machine: Machine, within: str) -> str:
    """Return what is not told apart, by motions within some bounds if any were tried, and how."""
    members = (*best.members, *(c for r in rivals for c in r.members))
    ways_of_each = (c.effect.separation.split("; ") for c in members if c.effect.separation)
    ways = dict.fromkeys(chain.from_iterable(ways_of_each))
    if not any(c.site.kind != "body" or machine.bodies[c.site.name].turns for c in members):
        ways = {}  # bodies that only slide have one posture
    one, other = _what_it_adds(best, other=rivals[0]), _what_it_adds(rivals[0], other=best)
    sentence = (
        f"{one[:1].upper()}{one[1:]} and {other} are not told apart by what was recorded here."
    )
    if within:
        sentence = (
            f"None of the motions that were tried within {within} tells {one} from {other} by "
            "the channels that were recorded here."
        )
    rule = "As a rule such effects are told apart by" if within else "What tells them apart:"
    return f"{sentence} {rule} {'; '.join(ways)}." if ways else sentence


def _what_it_adds(fit: Fit, other: Fit) -> str:
    """Return what a set has that another lacks, all of it where it lacks nothing."""
    own = units_beyond(fit, other) or units_of(fit)
    words = [unit_words([fit.members[k] for k in unit]) for unit in own]
    return " with ".join(words) or "nothing missing"


def _motions(problem: Problem) -> Iterator[tuple[str, Float[np.ndarray, "T nu"]]]:
    """Yield motions by name: controls about the recorded middle, within the recorded range."""
    time = np.arange(0.0, _LENGTH, problem.machine.sampling)
    names = [c.removeprefix("ctrl.") for c in problem.model.ctrl_channels]
    if any(isinstance(w, Controller) for w in problem.laws) or not names:
        return
    low, high = (edge(problem.windows.ctrl, axis=(0, 1)) for edge in (np.min, np.max))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    phase = np.arange(len(names))
    for rate, word in ((_SLOW, "slow"), (_MIDDLE, "medium"), (_FAST, "fast")):
        angle = 2 * np.pi * rate * (1 + 0.13 * phase) * time[:, None] + phase
        wave = np.sin(angle)
        yield f"{word} sine waves of all commands (about {rate:g} Hz)", middle + half * wave
    sweep = 2 * np.pi * (_SLOW * time + 0.5 * (_FAST - _SLOW) * time**2 / _LENGTH)
    yield "a sweep from slow to fast", middle + half * np.sin(sweep[:, None] + phase)
    square = np.sign(np.sin(2 * np.pi * _MIDDLE * (1 + 0.13 * phase) * time[:, None] + phase))
    yield "steps back and forth", middle + 0.7 * half * square
    servos = any(a.servo for a in problem.machine.actuators.values())  # zero is a place to go to
    if (low < 0).all() and (high > 0).all() and not servos:
        yield "a release from where it began, with all commands at zero", 0.0 * square


def _kept(
    problem: Problem, best: Fit, bounds: _Bounds, controls: Float[np.ndarray, "T nu"]
) -> tuple[Float[np.ndarray, "T nu"], Recording] | None:
    """Return controls so small that the motion keeps the limits, and the motion; None if none."""
    middle = controls.mean(axis=0)
    for _ in range(_TRIES):
        one = _posed(problem, recording_at_rest(problem, controls), len(controls) - 1)
        simulated = one.simulate(best.hypothesis, one.smoothed(best.hypothesis))
        over = max(
            float(bounds.limits.violation([m], simulated.trajectory, simulated.ctrl, 1.0)[0])
            for m in (bounds.whole, *((simulated.model,) if simulated.coordinates.same else ()))
        )  # motors may be stronger than the given model has them
        if over == 0.0:
            return controls, _shown(one, simulated, controls)
        controls = middle + _SMALLER * (controls - middle)
    return None


def _posed(problem: Problem, recording: Recording, horizon: int) -> Problem:
    sigma = 1 / problem.weight.reshape(-1, len(problem.windows.channels)).max(axis=0)
    return cut_problem(
        problem.model,
        problem.machine,
        [recording],
        dict(zip(problem.windows.channels, sigma.tolist(), strict=True)),
        problem.nuisances,
        horizon=horizon,
        timestep=problem.windows.timestep,
        engine=problem.engine,
        laws=problem.laws,
    )


def recording_at_rest(problem: Problem, controls: Float[np.ndarray, "T nu"]) -> Recording:
    """Return a recording of a machine that rests at its first recorded pose under controls."""
    first = problem.recordings[0]
    time = np.arange(len(controls)) * problem.machine.sampling
    shown = (*problem.windows.channels, *problem.model.qpos_channels)  # also of joints at rest
    at = {n: first.channels[n].values[0] for n in shown if n in first.channels}
    at |= {n: first.channels[n].values.mean() for n in problem.machine.inputs}
    channels = {n: np.full(time.size, value) for n, value in at.items() if "qvel." not in n}
    for k, name in enumerate(problem.model.ctrl_channels):
        channels[name] = controls[:, k]
    return Recording.from_frame(pd.DataFrame({"time": time, **channels}), name="proposed")


def _shown(one: Problem, simulated: Simulated, controls: Float[np.ndarray, "T nu"]) -> Recording:
    """Return what the channels show of the proposed motion."""
    still = one.recordings[0]
    shown = observe(one.layout, simulated.windows, simulated.trajectory, simulated.parts)[0]
    channels = {n: c.values for n, c in still.channels.items()}
    for k, name in enumerate(one.windows.channels):
        channels[name] = np.concatenate([still.channels[name].values[:1], shown[:, k]])
    time = np.arange(len(controls)) * one.machine.sampling
    return Recording.from_frame(pd.DataFrame({"time": time, **channels}), name="proposed")


def _separation(problem: Problem, rival: Fit, recording: Recording) -> float:
    """Return the rms in sigma that a rival leaves of a motion, at its best magnitudes there."""
    horizon = int(problem.windows.observed.shape[1])
    prepared = prepare(_posed(problem, recording, horizon), rival.hypothesis)
    return refit_at(prepared.linear, rival, start=prepared.start, effort=_EFFORT).rms


def _frame(problem: Problem, controls: Float[np.ndarray, "T nu"]) -> pd.DataFrame:
    frame = pd.DataFrame(controls, columns=list(problem.model.ctrl_channels))
    frame.insert(0, "time", np.arange(len(controls)) * problem.machine.sampling)
    return frame
