"""Screening: what every candidate would do at a fit, so that sets are scored by linear algebra."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import clean
from bo_sysid.diagnosis.sets.signatures import signatures
from bo_sysid.diagnosis.sets.subsets import Gram, gram
from bo_sysid.diagnosis.windows.candidate import Candidate, free_parameters, slices_of
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.timestep import SHARE_BOUNDS

_ADDS = 0.7  # cosine of a member's column with its slope, from which adding it adds more of it
_NUISANCE, _SPENT = -1, -2  # owners of columns that belong to no candidate


@dataclass(frozen=True)
class Screen:
    """The signatures of all candidates and nuisances at a fit, and their inner products.

    Attributes:
        candidates: what may be missing.
        signatures: `W x R x a` projected responses, nuisances last.
        owner: number of the candidate of each column, negative for nuisances.
        G: inner products of the columns.
        b: inner products with the fit's residual.
        parameters: of the study.
        nuisances: those of them that the fit has.
    """

    candidates: tuple[Candidate, ...]
    signatures: Float[np.ndarray, "W R a"]
    owner: Int[np.ndarray, " a"]
    G: Float[np.ndarray, "a a"]
    b: Float[np.ndarray, " a"]
    parameters: tuple[Candidate, ...]
    nuisances: tuple[Candidate, ...]

    @classmethod
    def at(cls, fit: Fit, frame: Linear, candidates: Sequence[Candidate]) -> "Screen":
        """Return the screen of a fit; `frame` is the linear model there.

        A parameter, or share of a finer time step, at its bound gives way no further: its column
        takes nothing over. Joints that are not in the fit are not added to one that leaves
        nothing: each has to be simulated.
        """
        problem, nuisances = frame.problem, fit.hypothesis.nuisances
        held = [*candidates, *nuisances]
        owner = np.repeat(np.arange(len(held)), [c.size for c in held])
        joints = [c for c in candidates if c.effect.hidden and c not in fit.members]
        corrected = problem.correction is not None
        S = np.zeros((*frame.Q.shape[:2], len(owner) + corrected), np.float32)
        signatures(frame, held, left_out=joints if clean(fit) else (), out=S[..., : len(owner)])
        _as_fitted(S, owner, fit, frame, candidates)
        owner[owner >= len(candidates)] = np.where(fit.hypothesis.bound, _SPENT, _NUISANCE)
        if problem.correction is not None:
            S[..., -1] = project(frame.Q, problem.correction)
            spent = fit.hypothesis.numerics in SHARE_BOUNDS
            owner = np.append(owner, _SPENT if spent else _NUISANCE)
        A = S.reshape(-1, S.shape[-1])
        G, b = (A.T @ A).astype(float), _products(S, project(frame.Q, fit.residual))
        return cls(tuple(candidates), S, owner, G, b, problem.nuisances, nuisances)

    def gram(self, fixed: Sequence[int], now: dict[int, np.ndarray]) -> Gram:
        """Return the table that sets are scored from; see `subsets.gram`."""
        able = self.owner != _SPENT
        G, b, owner = self.G[np.ix_(able, able)], self.b[able], self.owner[able]
        return gram(self.candidates, G, b, owner, now, fixed)

    def without(self, members: Sequence[Candidate], x: Sequence[np.ndarray]) -> "Screen":
        """Return the screen for the residual before some members explained their part of it."""
        b = self.b.copy()
        for c, z in zip(members, x, strict=True):
            b = b + self.G[:, self._columns(c)] @ z
        return replace(self, b=b)

    def explaining(self, residual: Float[np.ndarray, "W R"]) -> "Screen":
        """Return the screen for another projected residual, with the signatures of this fit."""
        return replace(self, b=_products(self.signatures, residual))

    def jacobian(self, members: Sequence[Candidate]) -> Float[np.ndarray, "W R p"] | None:
        """Return the columns of members and nuisances, None where one is not among them."""
        known = {id(c) for c in self.candidates if not c.moved}  # no slope to a place is known
        if any(id(c) not in known for c in members):
            return None
        if free_parameters(self.parameters, members) != self.nuisances:
            return None
        own = [self._columns(c) for c in members]
        if any(
            c.effect.hidden and not self.G[k, k].any() for c, k in zip(members, own, strict=True)
        ):
            return None
        columns = [*own, np.flatnonzero(self.owner < 0)]
        return np.asarray(self.signatures[..., np.concatenate(columns)])

    def _columns(self, candidate: Candidate) -> Int[np.ndarray, " k"]:
        return np.flatnonzero(self.owner == self.candidates.index(candidate))


def _products(
    signatures: Float[np.ndarray, "W R a"], y: Float[np.ndarray, "W R"]
) -> Float[np.ndarray, " a"]:
    A = signatures.reshape(-1, signatures.shape[-1])
    return np.asarray((A.T @ y.ravel().astype(np.float32)).astype(float))


def _as_fitted(
    S: Float[np.ndarray, "W R _"],
    owner: Int[np.ndarray, " a"],
    fit: Fit,
    frame: Linear,
    candidates: Sequence[Candidate],
) -> None:
    """Give members the column of what they do where adding one once more is not adding more of it.

    What limits a torque or a rate is as it was beside a looser limit, and gives way to a tighter
    one; what it does is simulated, the model without it. A joint that is added has no column: it is
    there already.
    """
    for j, (c, own) in enumerate(zip(fit.members, slices_of(fit.members), strict=True)):
        x = fit.x[j]
        if c.effect.hidden or c.size > 1 or not x[0] or c not in candidates:
            continue
        (k,) = np.flatnonzero(owner == candidates.index(c))
        slope = project(frame.Q, fit.jacobian[..., own].astype(float))[..., 0]
        both = float((S[..., k] * slope).sum())
        if both <= _ADDS * np.linalg.norm(S[..., k]) * np.linalg.norm(slope):
            without = frame.problem.residual(_without(fit, j), fit.start)
            S[..., k] = project(frame.Q, without - fit.residual) / x[0]


def _without(fit: Fit, j: int) -> Hypothesis:
    """Return the hypothesis of a fit without one of its members."""
    h = fit.hypothesis
    return replace(h, members=h.members[:j] + h.members[j + 1 :], x=h.x[:j] + h.x[j + 1 :])
