"""What no named effect explains: found by predictability, answered by a learned force law.

A magnet near one angle hides as cogging and a spring with a few per cent left over: the size of a
residual says little. What says something is whether a flexible law at a joint predicts, in blocks
that it was not fitted to, what the answer leaves. Such a law is never given a physical name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.decide import Decision
from bo_sysid.diagnosis.fit import Fit
from bo_sysid.diagnosis.hypothesis import Candidate, Hypothesis
from bo_sysid.diagnosis.linear import Linear, linearise, project
from bo_sysid.diagnosis.problem import Problem
from bo_sysid.diagnosis.rules import MARGIN
from bo_sysid.diagnosis.settling import settle
from bo_sysid.diagnosis.signatures import response_to_forces, signatures
from bo_sysid.diagnosis.windowing import in_contact
from bo_sysid.effects import Component, Effect, Extent, Force, Machine, Site
from bo_sysid.effects.learned import Feature, features, learned_force
from bo_sysid.simulation import State

_GAIN = 0.02  # of the squared residual per degree of freedom that a law must predict
_RELATIVE = 0.005  # the same, of what the nominal model left unexplained
_LOOSE, _LOOSE_SHARE = 0.35, 0.08  # rms and share unexplained that are flagged without a law
_LOOSE_IN_CONTACT = 1.5  # the same rms in contact, where 1.05 was left of nothing missing
_BETWEEN_IMPACTS = 0.1  # of what is left, that a law must predict in contact
_STANDS_OUT = 1.25  # times what a law at any other joint predicts there
_WORTH = 0.015  # rms² - 1 below which nothing is asked
_RIDGES = (1e-3, 3e-2, 0.3, 2.0)
_NAMED = 1e-6  # ridge on names beside a law: they are believed, the law is not
_NEAR = 0.5  # of the best gain: dependences that are named
_WINDOWS = 40
_ROUNDS = 4


@dataclass(frozen=True)
class Clue:
    """How well a law of one dependence at one joint predicts what is left.

    Attributes:
        joint: name of the joint.
        depends_on: what the law depends on.
        gain: cross-validated gain of squared residual per degree of freedom.
        ridge: with which it was reached.
    """

    joint: str
    depends_on: str
    gain: float
    ridge: float


@dataclass(frozen=True)
class Unknown:
    """What stays unexplained.

    Attributes:
        flagged: whether it is more than noise.
        share: of the nominal model's excess.
        clues: best first.
    """

    flagged: bool
    share: float
    clues: tuple[Clue, ...]

    @property
    def joint(self) -> str | None:
        """The joint at which it sits, where a law there predicts some of it."""
        found = self.flagged and self.clues and self.clues[0].gain > _GAIN
        return self.clues[0].joint if found else None

    @property
    def depends_on(self) -> tuple[str, ...]:
        """What it depends on."""
        if self.joint is None:
            return ()
        first = self.clues[0]
        near = {
            c.depends_on
            for c in self.clues
            if c.joint == first.joint and c.gain > _NEAR * first.gain
        }
        return tuple(sorted(near))


def examine(problem: Problem, decision: Decision) -> Unknown:
    """Look for a law in what the decision leaves unexplained."""
    best, nominal = decision.best, decision.nominal
    share = best.excess / max(nominal.excess, 1e-9) if nominal.excess > 0 else 0.0
    share = min(share, 1.0)
    if best.excess < _WORTH:
        return Unknown(False, share, ())
    problem, best = _some(problem, best)
    linear = linearise(problem, best.hypothesis, best.start)
    clues = tuple(sorted(_clues(linear, best), key=lambda c: -c.gain))
    most = clues[0].gain if clues else 0.0
    need = max(_GAIN, _RELATIVE * nominal.excess)
    if in_contact(problem):  # impacts leave something whatever the model
        elsewhere = max((c.gain for c in clues if c.joint != clues[0].joint), default=0.0)
        loose = np.sqrt(best.excess) > _LOOSE_IN_CONTACT
        need = max(need, _BETWEEN_IMPACTS * best.excess, _STANDS_OUT * elsewhere)
    else:
        loose = np.sqrt(best.excess) > _LOOSE and share > _LOOSE_SHARE
    flagged = loose or most > need
    return Unknown(bool(flagged), share, clues)


def needed_beside(
    problem: Problem, fit: Fit, joint: str, depends_on: Sequence[str]
) -> tuple[bool, ...]:
    """Return which members of a fit are still needed once a law acts at a joint.

    A flexible law can say within the recordings what almost any name says. What a name says that
    holds beyond them is what it predicts in blocks that neither was fitted to: the gain of the law
    with the name over the law without it. It must exceed what both together leave there, and the
    least size of an effect, squared.
    """
    problem, fit = _some(problem, fit)
    linear = linearise(problem, fit.hypothesis, fit.start)
    terms = [f for f in features(joint, problem.machine) if f.depends_on in depends_on]
    L = _normalised(law_columns(linear, joint, terms))
    S = project(linear.Q, fit.jacobian.astype(float))
    y = project(linear.Q, fit.residual)
    explained = _cross_validated(L, y, problem.block, _normalised(S))[0] / problem.dof
    need = max(MARGIN**2, fit.excess - explained)
    kept, first = [], 0
    for c, x in zip(fit.members, fit.x, strict=True):
        own = np.arange(first, first + c.size)
        first += c.size
        before = y + S[..., own] @ x  # what is left without the member
        rest = _normalised(np.delete(S, own, axis=-1))
        free = np.concatenate([_normalised(S[..., own]), rest], axis=-1)
        gain = _cross_validated(L, before, problem.block, free)[0]
        without = _cross_validated(L, before, problem.block, rest)[0]
        kept.append(bool((gain - without) / problem.dof >= need))
    return tuple(kept)


def learn(
    problem: Problem, fit: Fit, unknown: Unknown
) -> tuple[Hypothesis, State, tuple[Feature, ...], Float[np.ndarray, " k"]]:
    """Fit a force law beside the members of a fit, through the simulator.

    Returns:
        The hypothesis with the law as its last member, the starts, the law's terms and weights.
    """
    joint, depends_on = unknown.joint, unknown.depends_on
    assert joint is not None  # noqa: S101 - something was flagged
    terms = [f for f in features(joint, problem.machine) if f.depends_on in depends_on]
    ridge = min(c.ridge for c in unknown.clues if c.joint == joint)
    law = law_candidate(problem.machine, joint, terms)
    hypothesis = fit.hypothesis
    hypothesis = replace(
        hypothesis, members=(*hypothesis.members, law), x=(*hypothesis.x, np.zeros(len(terms)))
    )
    start, r = fit.start, fit.residual
    for _ in range(_ROUNDS):
        linear = linearise(problem, hypothesis, start)
        moved = _step(linear, hypothesis, r, len(terms), joint, terms, ridge)
        begin, rn = settle(problem, linear, moved, start, 2)
        if (rn**2).sum() > (1 - 1e-3) * (r**2).sum():
            if (rn**2).sum() < (r**2).sum():
                hypothesis, start, r = moved, begin, rn
            break
        hypothesis, start, r = moved, begin, rn
    return hypothesis, start, tuple(terms), hypothesis.x[-1]


def law_candidate(machine: Machine, joint: str, terms: Sequence[Feature]) -> Candidate:
    """Return a force law with the given terms as a candidate.

    It is held for the model's time step, at which it is learned, also where the mechanics are
    stepped finer: it is evaluated outside the engine.
    """
    scale, hold = machine.joints[joint].force, machine.model.opt.timestep
    count = len(terms)
    extent = Extent((0.05,) * count, (-1e6,) * count, (1e6,) * count)

    def apply(spec: object, site: Site, x: np.ndarray, machine: Machine) -> Force:
        return Force(joint, learned_force(terms, x, scale), hold)

    effect = Effect(
        id="unknown", kind="joint", components=tuple(Component(t.name, "–") for t in terms),
        apply=apply, extent=lambda site, machine: extent, noun="an unknown force",
        sentence="", evidence="", separation="", vector=count,
    )  # fmt: skip
    return Candidate(effect, Site("joint", joint), extent, np.full(count, 0.05))


def law_columns(linear: Linear, joint: str, terms: Sequence[Feature]) -> Float[np.ndarray, "W R k"]:
    """Return the projected response to each term of a law, per unit of the joint's force."""
    scale = linear.problem.machine.joints[joint].force
    forces = np.stack([scale * np.asarray(t.value(linear.along)) for t in terms], axis=-1)
    return response_to_forces(linear, joint, forces)


def _clues(linear: Linear, best: Fit) -> list[Clue]:
    problem = linear.problem
    y = project(linear.Q, best.residual)
    S = _normalised(project(linear.Q, best.jacobian.astype(float)))
    found = []
    for joint in problem.machine.names("joint"):
        terms = features(joint, problem.machine)
        columns = law_columns(linear, joint, terms)
        for dependence in dict.fromkeys(t.depends_on for t in terms):
            own = [k for k, t in enumerate(terms) if t.depends_on == dependence]
            law = _normalised(columns[..., own])
            gain, ridge = _cross_validated(law, y, problem.block, S, np.inf)
            found.append(Clue(joint, dependence, gain / problem.dof, ridge))
    return found


def _cross_validated(
    law: Float[np.ndarray, "W R k"],
    y: Float[np.ndarray, "W R"],
    block: np.ndarray,
    named: Float[np.ndarray, "W R j"],
    ridge_of_named: float = _NAMED,
) -> tuple[float, float]:
    """Return the gain of squared residual in left-out blocks, and the best ridge on the law."""
    A = np.concatenate([law, named], axis=-1)
    count, k = int(block.max()) + 1, A.shape[-1]
    G, b = np.zeros((count, k, k)), np.zeros((count, k))
    for i in range(count):
        part, z = A[block == i].reshape(-1, k), y[block == i].ravel()
        G[i], b[i] = part.T @ part, part.T @ z
    whole, sum_b = G.sum(axis=0), b.sum(axis=0)
    best, at = -np.inf, _RIDGES[0]
    for ridge in _RIDGES:
        penalty = np.concatenate(
            [np.full(law.shape[-1], ridge), np.full(named.shape[-1], min(ridge, ridge_of_named))]
        )
        gain = 0.0
        for i in range(count):
            x = np.linalg.solve(whole - G[i] + np.diag(penalty), sum_b - b[i])
            gain += float(2 * x @ b[i] - x @ G[i] @ x)
        if gain > best:
            best, at = gain, ridge
    return best, at


def _step(
    linear: Linear,
    hypothesis: Hypothesis,
    r: Float[np.ndarray, "W R"],
    count: int,
    joint: str,
    terms: Sequence[Feature],
    ridge: float,
) -> Hypothesis:
    """Return the hypothesis after one Gauss-Newton step on members and law together."""
    named = hypothesis.members[:-1]
    S = signatures(linear, named).astype(float) if named else np.zeros((*r.shape, 0))
    A = np.concatenate([S, law_columns(linear, joint, terms)], axis=-1)
    y = project(linear.Q, r)
    scale = np.sqrt((A**2).sum(axis=(0, 1))) + 1e-12
    flat = (A / scale).reshape(-1, A.shape[-1])
    penalty = np.concatenate([np.full(S.shape[-1], 1e-8), np.full(count, ridge)])
    now = np.concatenate([np.zeros(S.shape[-1]), hypothesis.x[-1]]) * scale
    G = flat.T @ flat + np.diag(penalty)
    step = np.linalg.solve(G, flat.T @ y.ravel() - penalty * now) / scale
    parts = np.split(step, np.cumsum([c.size for c in hypothesis.members])[:-1])
    x = tuple(
        np.clip(z + d, c.low, c.high)
        for c, z, d in zip(hypothesis.members, hypothesis.x, parts, strict=True)
    )
    return replace(hypothesis, x=x)


def _normalised(A: Float[np.ndarray, "W R k"]) -> Float[np.ndarray, "W R k"]:
    return np.asarray(A / (np.sqrt((A**2).sum(axis=(0, 1))) + 1e-9))


def _some(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """Return a problem of at most `_WINDOWS` windows, evenly chosen, and the fit on them."""
    count = len(problem.windows)
    if count <= _WINDOWS:
        return problem, fit
    keep = np.unique(np.linspace(0, count - 1, _WINDOWS).astype(int))
    return problem.rows(keep), replace(
        fit,
        start=fit.start.rows(keep),
        residual=fit.residual[keep],
        jacobian=fit.jacobian[keep],
    )
