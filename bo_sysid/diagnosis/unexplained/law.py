"""A force law of no name, learned beside a set of effects through the simulator."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.signatures import response_to_forces, signatures
from bo_sysid.diagnosis.unexplained.left_out import LeftOut
from bo_sysid.diagnosis.windows.candidate import Candidate, slices_of
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import Linear, linearise
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.settling import settle
from bo_sysid.effects import Component, Effect, Extent, Force, Machine, Site
from bo_sysid.effects.learned import Feature, features, learned_force
from bo_sysid.simulation import State

_RIDGE = 1e-8  # on names, in a step of theirs beside a law: only so that it can be solved
_ROUNDS = 8
_SHARES = (1.0, 0.5, 0.2)  # of a step that are tried
_SETTLED = 3  # steps of the starts after each
_LITTLE = 3e-3  # of what was left, to go on for


def terms_of(machine: Machine, joint: str, depends_on: Collection[str]) -> tuple[Feature, ...]:
    """Return the terms of a law at a joint that depends on some things only."""
    return tuple(f for f in features(joint, machine) if f.depends_on in depends_on)


def learn(
    problem: Problem, fit: Fit, joint: str, terms: Sequence[Feature]
) -> tuple[Hypothesis, State, float]:
    """Fit a force law beside the members of a fit, through the simulator.

    Args:
        problem: the windows.
        fit: the set beside which it acts.
        joint: where.
        terms: of the law.

    Returns:
        The hypothesis with the law as its last member, the starts, and the rms of what is left.
    """
    law = law_candidate(problem.machine, joint, terms)
    hypothesis = fit.hypothesis
    hypothesis = replace(
        hypothesis, members=(*hypothesis.members, law), x=(*hypothesis.x, np.zeros(len(terms)))
    )
    start, r = fit.start, fit.residual
    for _ in range(_ROUNDS):
        linear = linearise(problem, hypothesis, start)
        whole = _step(linear, hypothesis, r, terms)
        moved, begin, rn = _line_search(linear, hypothesis, whole, start)
        before, left = float((r**2).sum()), float((rn**2).sum())
        if left < before:
            hypothesis, start, r = moved, begin, rn
        if left > (1 - _LITTLE) * before:
            break
    return hypothesis, start, float(np.sqrt((r**2).sum() / problem.dof))


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
    """Return the projected response to each term of a law, per unit of the joint's force.

    Its terms are those of the recorded motion. There the true law acted: without one, the deviation
    δ of the truth from a prediction follows δ⁺ = A δ + B Σ wᵢ φᵢ(q + δ), which is linear in w.
    """
    scale = linear.problem.machine.joints[joint].force
    forces = np.stack([scale * np.asarray(t.value(linear.recorded)) for t in terms], axis=-1)
    return response_to_forces(linear, joint, forces)


def lengths(A: Float[np.ndarray, "W R k"]) -> Float[np.ndarray, " k"]:
    """Return the length of each column."""
    return np.asarray(np.sqrt((A**2).sum(axis=(0, 1))) + 1e-12)


def scales(L: Float[np.ndarray, "W R k"], terms: Sequence[Feature]) -> Float[np.ndarray, " k"]:
    """Return for each term the length of the longest column of its kind.

    A ridge on columns in these units holds back what was hardly visited: a law says nothing there.
    """
    found, kinds = lengths(L), [(t.of.name, t.times and t.times[0]) for t in terms]
    longest = {
        kind: max(f for f, k in zip(found, kinds, strict=True) if k == kind) for kind in kinds
    }
    return np.array([longest[kind] for kind in kinds])


def _step(
    linear: Linear, hypothesis: Hypothesis, r: Float[np.ndarray, "W R"], terms: Sequence[Feature]
) -> Hypothesis:
    """Return the hypothesis after one Gauss-Newton step on members and law together.

    The ridge on the law is the one with which it predicts best what was left out.
    """
    *named, law = hypothesis.members
    L = law_columns(linear, law.site.name, terms)
    S = signatures(linear, named).astype(float) if named else np.zeros((*r.shape, 0))
    A = np.concatenate([L, S], axis=-1)
    scale = np.concatenate([scales(L, terms), lengths(S)])
    now = np.concatenate([hypothesis.x[-1], np.zeros(S.shape[-1])]) * scale
    A = A / scale
    held = LeftOut.of(A, project(linear.Q, r) + A @ now, linear.problem.block)
    of_law, of_named = range(len(terms)), range(len(terms), A.shape[-1])
    penalty = np.full(A.shape[-1], _RIDGE)
    penalty[: len(terms)] = held.gain(of_law, of_named, _RIDGE)[1]
    G, b = held.G.sum(axis=0), held.b[..., 0].sum(axis=0)
    found = np.linalg.solve(G + np.diag(penalty), b) / scale
    steps = found[len(terms) :]
    x = [
        np.clip(z + steps[own], c.low, c.high)
        for c, z, own in zip(named, hypothesis.x[:-1], slices_of(named), strict=True)
    ]
    return replace(hypothesis, x=(*x, found[: len(terms)]))


def _line_search(
    linear: Linear, hypothesis: Hypothesis, whole: Hypothesis, start: State
) -> tuple[Hypothesis, State, Float[np.ndarray, "W R"]]:
    """Return the largest share of a step that leaves less, its starts and what it leaves.

    The smallest where none does.
    """
    before = (linear.residual**2).sum()
    for share in _SHARES:
        x = tuple(a + share * (b - a) for a, b in zip(hypothesis.x, whole.x, strict=True))
        moved = replace(hypothesis, x=x)
        begin, r = settle(linear.problem, linear, moved, start, _SETTLED, _SHARES)
        if (r**2).sum() < before:
            break
    return moved, begin, r
