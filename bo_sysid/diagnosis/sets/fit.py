"""What a fit says: how well it explains, how sure its magnitudes are, how much each is needed."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.optimize import lsq_linear

from bo_sysid.diagnosis.windows.candidate import Candidate, slices_of
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.diagnosis.windows.timestep import SHARE_BOUNDS
from bo_sysid.simulation import State

_CV_RIDGE = 0.02  # on unit columns: an effect that acts in one block only gains nothing
_TINY = 1e-12
_UNSEEN = 1e-3  # of what the bounds say of a magnitude: recordings that say less say nothing

Names: TypeAlias = frozenset[tuple[str, str]]
"""Effects and sites of a set, whatever the shapes."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A set of effects fitted through the simulator.

    Attributes:
        hypothesis: members, magnitudes and nuisances.
        groups: for each member the id of the effect that a group shares, None outside a group.
        start: the fitted starts.
        residual: `W x R` recorded minus predicted, in sigma.
        jacobian: `W x R x p` response of the prediction to each magnitude: members, then the
            study's parameters, then the share of the finer step.
        rms: root mean square of the projected residual per degree of freedom, in sigma.
        cv: squared residual of each block when the magnitudes come from the other blocks.
        cost: squared residual of each block.
        unique: size of each member in sigma that no other member or nuisance can take over.
        covariance: `p x p` of the magnitudes, from the scatter of blocks.
        spread: standard deviation of each member's shapes, 0 of those that are held; empty until
            it was asked for (`shapes`).
        simulated: whether `cv` is what the simulator leaves, or what slopes at the fit foretell.
    """

    hypothesis: Hypothesis
    groups: tuple[str | None, ...]
    start: State
    residual: Float[np.ndarray, "W R"]
    jacobian: Float[np.ndarray, "W R p"]
    rms: float
    cv: Float[np.ndarray, " b"]
    cost: Float[np.ndarray, " b"]
    unique: tuple[float, ...]
    covariance: Float[np.ndarray, "p p"]
    spread: tuple[Float[np.ndarray, " _"], ...] = ()
    simulated: bool = False

    @property
    def members(self) -> tuple[Candidate, ...]:
        """What is supposed to be missing."""
        return self.hypothesis.members

    @property
    def x(self) -> tuple[Float[np.ndarray, " _"], ...]:
        """The magnitudes of each member."""
        return self.hypothesis.x

    @property
    def size(self) -> int:
        """Number of effects, a group counted as one and a refinement as two."""
        return size_of(self.members, self.groups)

    @property
    def width(self) -> int:
        """Number of magnitudes."""
        return sum(c.size for c in self.members)

    @property
    def key(self) -> frozenset[tuple[object, ...]]:
        """What is supposed, without magnitudes."""
        return set_key(self.members)

    @property
    def names(self) -> Names:
        """Effects and sites, an effect that contains a simpler one as that one."""
        return frozenset((c.effect.nested or c.effect.id, c.site.name) for c in self.members)

    @property
    def effects(self) -> Names:
        """Effects and sites as they are, whatever an effect contains (`names`)."""
        return frozenset(c.key for c in self.members)

    def exchanges_one(self, other: "Fit") -> bool:
        """Whether the set differs from another of its size in one member."""
        shared = len(self.effects & other.effects)
        return len(self.members) == len(other.members) == shared + 1

    @cached_property
    def linear_rms(self) -> tuple[float, ...]:
        """What each member does, by the slope at all that it is, as an rms in sigma.

        It is nothing where more of it would do no more, as of a friction that holds a joint.
        """
        whole = (c.total(x) for c, x in zip(self.members, self.x, strict=True))
        own = zip(slices_of(self.members), whole, strict=True)
        return tuple(float(np.sqrt(np.mean((self.jacobian[..., s] @ x) ** 2))) for s, x in own)

    @property
    def excess(self) -> float:
        """What stays unexplained: rms² - 1, at least 0."""
        return max(self.rms**2 - 1.0, 0.0)

    @property
    def rss(self) -> float:
        """Sum of the squared projected residuals."""
        return float(self.cost.sum())


def size_of(members: Sequence[Candidate], groups: Sequence[str | None]) -> int:
    """Return as how many effects a set counts: a group as one and a refinement as two."""
    units = {(g or i): c for i, (c, g) in enumerate(zip(members, groups, strict=True))}
    return sum(c.effect.weight for c in units.values())


def set_key(members: Sequence[Candidate]) -> frozenset[tuple[object, ...]]:
    """Return the identity of a set of candidates: effects, sites and shapes."""
    return frozenset((*c.key, *np.round(c.shapes, 9).tolist()) for c in members)


def assess(
    problem: Problem,
    Q: Float[np.ndarray, "W R k"],
    hypothesis: Hypothesis,
    groups: tuple[str | None, ...],
    start: State,
    residual: Float[np.ndarray, "W R"],
    jacobian: Float[np.ndarray, "W R p"],
) -> Fit:
    """Return the fit with its statistics.

    Leave-one-block-out steps are computed from the blocks' normal equations, with a ridge on unit
    columns. The covariance is the sandwich of the blocks' gradients, at least the one of white
    noise of the observed size, all magnitudes being uniform within their bounds: what cannot be
    seen, such as a shift out of the plane of motion, may lie anywhere between them. The
    unique size of a member is the rms of its columns times its magnitudes (`Candidate.total`) after
    the other columns took over what they can, parameters and the share of a finer time step within
    their bounds.
    """
    y = project(Q, residual)
    SP = project(Q, jacobian.astype(float))
    dof, p = problem.dof, SP.shape[-1]
    variance = float((y**2).sum()) / dof
    prior = np.sqrt(12.0 * variance) / _widths(hypothesis, p)
    scale = np.maximum(np.sqrt((SP**2).sum(axis=(0, 1))), _UNSEEN * prior) + _TINY
    SP = SP / scale
    G, g, cost = by_block(SP, y, problem.block)
    total, cv = G.sum(axis=0), cost.copy()
    if p:
        ridge = _CV_RIDGE * np.eye(p)
        whole = np.linalg.solve(total + ridge, g.sum(axis=0))
        for k in range(len(cost)):
            step = np.linalg.solve(total - G[k] + ridge, g.sum(axis=0) - g[k]) - whole
            cv[k] = cost[k] - 2 * step @ g[k] + step @ G[k] @ step
    low, high = _room(hypothesis, p)
    covariance = sandwich(total, g, variance, (prior / scale) ** 2) / np.outer(scale, scale)
    unique = _unique(hypothesis, total, scale, (low * scale, high * scale), dof)
    rms = float(np.sqrt(cost.sum() / dof))
    return Fit(
        hypothesis=hypothesis,
        groups=groups,
        start=start,
        residual=residual,
        jacobian=jacobian.astype(np.float32),
        rms=rms,
        cv=cv,
        cost=cost,
        unique=unique,
        covariance=covariance,
    )


def by_block(
    S: Float[np.ndarray, "W R p"], y: Float[np.ndarray, "W R"], block: np.ndarray
) -> tuple[Float[np.ndarray, "b p p"], Float[np.ndarray, "b p"], Float[np.ndarray, " b"]]:
    """Return S'S, S'y and y'y of each block."""
    count, p = int(block.max()) + 1, S.shape[-1]
    G, g, cost = np.zeros((count, p, p)), np.zeros((count, p)), np.zeros(count)
    for k in range(count):
        z = y[block == k].ravel()
        A = S[block == k].reshape(z.size, p)
        G[k], g[k], cost[k] = A.T @ A, A.T @ z, z @ z
    return G, g, cost


def sandwich(
    G: Float[np.ndarray, "p p"],
    g: Float[np.ndarray, "b p"],
    variance: float,
    prior: Float[np.ndarray, " p"] | float = 0.0,
) -> Float[np.ndarray, "p p"]:
    """Return the covariance by the scatter of the blocks' gradients, at least that of white noise.

    (G + Λ)⁻¹(M + σ²Λ)(G + Λ)⁻¹ with M the sum over blocks of their gradients' squares about the
    mean.

    Args:
        G: the normal matrix.
        g: the gradient of each block.
        variance: σ² of the noise.
        prior: diagonal of Λ, what was known before, over 1/σ².
    """
    p, blocks = len(G), len(g)
    known = np.diag(np.broadcast_to(prior, p))
    inverse = np.linalg.pinv(G + known + 1e-9 * np.eye(p), hermitian=True)
    if blocks < 2:
        return np.asarray(inverse * variance)
    centred = g - g.mean(axis=0)
    meat = centred.T @ centred * blocks / (blocks - 1) + variance * known
    robust, white = inverse @ meat @ inverse, inverse * variance
    least = np.diag(white) / np.maximum(np.diag(robust), 1e-12 * np.diag(white) + 1e-300)
    grow = np.sqrt(np.clip(np.nan_to_num(least, posinf=1e12), 1.0, 1e12))
    return np.asarray(robust * np.outer(grow, grow))


def _widths(hypothesis: Hypothesis, p: int) -> Float[np.ndarray, " p"]:
    """Return the distance between the bounds of each of `p` columns, a time step's share last."""
    held = [c.high - c.low for c in (*hypothesis.members, *hypothesis.nuisances)]
    found = np.full(p, SHARE_BOUNDS[1] - SHARE_BOUNDS[0])
    found[: sum(map(len, held))] = np.concatenate([*held, []])
    return found


def _room(hypothesis: Hypothesis, p: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how far each of `p` columns may move down and up: within bounds but for members."""
    low, high = np.full(p, -np.inf), np.full(p, np.inf)
    known, slices = len(hypothesis.members), hypothesis.slices
    parameters = zip(hypothesis.nuisances, hypothesis.nuisance_x, slices[known:], strict=True)
    for c, x, own in parameters:
        low[own], high[own] = np.minimum(c.low - x, 0.0), np.maximum(c.high - x, 0.0)
    first = slices[-1].stop if slices else 0  # of the finer step
    low[first:] = min(SHARE_BOUNDS[0] - hypothesis.numerics, 0.0)
    high[first:] = max(SHARE_BOUNDS[1] - hypothesis.numerics, 0.0)
    return low, high


def _unique(
    hypothesis: Hypothesis,
    G: Float[np.ndarray, "p p"],
    scale: Float[np.ndarray, " p"],
    room: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]],
    dof: int,
) -> tuple[float, ...]:
    sizes, slices = [], slices_of(hypothesis.members)
    for candidate, x, at in zip(hypothesis.members, hypothesis.x, slices, strict=True):
        # an effect that contains a simpler one must be needed beyond it
        own = 1 if candidate.effect.nested else candidate.size
        a = np.arange(at.start, at.start + own)
        rest = np.setdiff1d(np.arange(len(G)), a)
        z = candidate.total(x)[:own] * scale[a]
        N, c = G[np.ix_(rest, rest)] + 1e-9 * np.eye(len(rest)), G[np.ix_(rest, a)] @ z
        y = _nearest(N, c, (room[0][rest], room[1][rest]))
        left = z @ G[np.ix_(a, a)] @ z - 2 * y @ c + y @ N @ y
        sizes.append(float(np.sqrt(max(left, 0.0) / dof)))
    return tuple(sizes)


def _nearest(
    N: Float[np.ndarray, "r r"],
    c: Float[np.ndarray, " r"],
    room: tuple[Float[np.ndarray, " r"], Float[np.ndarray, " r"]],
) -> Float[np.ndarray, " r"]:
    """Return the y within its bounds at which y'Ny/2 - c'y is least."""
    y = np.linalg.solve(N, c)
    if ((y >= room[0]) & (y <= room[1])).all():
        return np.asarray(y)
    L = np.linalg.cholesky(N)
    return np.asarray(lsq_linear(L.T, np.linalg.solve(L, c), room).x)
