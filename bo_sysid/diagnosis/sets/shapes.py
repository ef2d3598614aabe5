"""The shapes of effects, such as a period or presliding: fitted between points of their grids.

A candidate holds its shapes fixed, so that its magnitudes are nearly linear in the predictions.
Here those of the leading set are fitted as well, and how sure they are is added to what the
magnitudes' own covariance says.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.sets.fit import Fit, by_block, sandwich
from bo_sysid.diagnosis.sets.refit import FINAL, Effort, refit
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.effects import Machine

_LOBE = 1.5  # [rad] of phase over the range of the joint within which a residual has one minimum
_PRESLIDING_FACTOR = 1.8  # times a presliding that is fitted
_SLOWER, _FASTER = (
    0.25,
    2.0,
)  # times a speed of friction, beside a presliding that changes what is best
UNIFORM = 12.0
"""The square of a range over the variance of what is uniform in it."""

_PROBE = 0.03  # of the range of a shape, for its column
_RESHAPINGS, _WORTH = 3, 1e-3  # steps on the shapes; share of the squares one must gain
_HOPED = 0.1  # times that, which a step must promise
_HALVINGS = 2

Place = tuple[int, int]
"""A member of a fit, and one of its shapes."""


def ranges(c: Candidate, machine: Machine) -> Mapping[int, tuple[float, float]]:
    """Return where the shapes of a member may lie, by their places; only those that are fitted."""
    if not (c.extent.refine and len(c.shapes)):
        return {}
    first, last = float(c.shapes[0]), float(c.shapes[-1])
    if c.may_preslide:
        found = {0: (_SLOWER * first, _FASTER * first)} if c.extent.grid else {}
        place = len(c.shapes) - 1
        most = max(float(c.extent.high[c.size + place]), last)
        return found | (
            {place: (last / _PRESLIDING_FACTOR, min(last * _PRESLIDING_FACTOR, most))}
            if c.preslides
            else {}
        )
    if c.effect.vector < 2 or len(c.shapes) != 1:
        return {}
    joint = machine.joint_of(c.site.kind, c.site.name)
    assert joint is not None  # noqa: S101 - what repeats with position is at a joint
    reach = _LOBE / joint.span
    low, high = float(c.extent.low[-1]), float(c.extent.high[-1])
    return {0: (max(first - reach, low), min(first + reach, high))}


def reshaped(
    linear: Linear, fit: Fit, effort: Effort = FINAL, *, friction_alone: bool = False
) -> Fit:
    """Fit the shapes of a set together, by Gauss-Newton steps beside which magnitudes follow.

    Args:
        linear: the model linearised at the fit.
        fit: the set.
        effort: how hard to fit the magnitudes.
        friction_alone: leave the shapes of other members, which may be none.
    """
    for _ in range(_RESHAPINGS):
        bounds = _places(fit, linear.problem.machine)
        if friction_alone:
            bounds = {at: b for at, b in bounds.items() if fit.members[at[0]].may_preslide}
        if not bounds:
            break
        profiled = profile(linear.problem, linear.Q, fit, bounds)
        if profiled.gain < _HOPED * _WORTH * fit.rss:
            break
        before, fit = fit, _stepped(linear, fit, bounds, profiled.step, effort)
        if fit.rss > (1 - _WORTH) * before.rss:
            break
    return fit


def _stepped(
    linear: Linear,
    fit: Fit,
    bounds: Mapping[Place, tuple[float, float]],
    step: Float[np.ndarray, " s"],
    effort: Effort,
) -> Fit:
    """Return the fit after a step on its shapes, the fit itself where none leaves less.

    Starts follow as far as slopes lead: those of joints at rest were tried before, and a step that
    changes a presliding by a few percent is no reason to try them again, which takes most of a fit.
    """
    effort = replace(effort, resting=False)
    for halving in range(_HALVINGS):
        values = {
            at: float(np.clip(_shape(fit, at) + 0.5**halving * d, *bounds[at]))
            for at, d in zip(bounds, step, strict=True)
        }
        made = refit(
            linear, reshaped_members(fit, values), fit.x, groups=fit.groups, start=fit.start,
            guess=fit.hypothesis, effort=effort,
        )  # fmt: skip
        if made.rss < fit.rss:
            return made
    return fit


def with_shapes_unsure(problem: Problem, Q: Float[np.ndarray, "W R k"], fit: Fit) -> Fit:
    """Return a fit whose covariance holds that its shapes are fitted, with their deviations.

    With S the columns of the magnitudes and C those of the shapes, both without what a start can
    do, K = (S'S)⁻¹S'C is how the magnitudes give way to the shapes, C⊥ = C - SK what is left to
    tell the shapes by, V their covariance by it; the magnitudes' covariance grows by KVK'.
    """
    bounds = _places(fit, problem.machine)
    if not bounds:
        return fit
    profiled = profile(problem, Q, fit, bounds)
    V, K = profiled.covariance, profiled.following
    deviations = dict(zip(bounds, np.sqrt(np.diag(V)), strict=True))
    spread = tuple(
        np.array([deviations.get((k, i), 0.0) for i in range(len(c.shapes))])
        for k, c in enumerate(fit.members)
    )
    return replace(fit, covariance=fit.covariance + K @ V @ K.T, spread=spread)


@dataclass(frozen=True)
class _Profile:
    """What the recordings say of the shapes of a fit, whose magnitudes follow.

    Attributes:
        step: the Gauss-Newton step of the shapes.
        gain: of the squared residual, that the step promises.
        covariance: V of the shapes.
        following: K, how the magnitudes give way to the shapes.
    """

    step: Float[np.ndarray, " s"]
    gain: float
    covariance: Float[np.ndarray, "s s"]
    following: Float[np.ndarray, "p s"]


def profile(
    problem: Problem,
    Q: Float[np.ndarray, "W R k"],
    fit: Fit,
    bounds: Mapping[Place, tuple[float, float]],
) -> _Profile:
    """Return what the recordings say of some shapes.

    Before the recordings are seen a shape is uniform within its bounds.
    """
    S = project(Q, fit.jacobian.astype(float))
    width = np.array([high - low for low, high in bounds.values()])
    C = project(Q, _columns(problem, fit, bounds)) * width
    A = S.reshape(-1, S.shape[-1])
    K = np.linalg.lstsq(A, C.reshape(-1, len(width)), rcond=1e-10)[0]
    blocks, g, _ = by_block(C - S @ K, project(Q, fit.residual), problem.block)
    G, gradient = blocks.sum(axis=0), g.sum(axis=0)
    variance = max(fit.rms, 1.0) ** 2
    prior = UNIFORM * variance
    V = sandwich(G, g, variance, prior) * np.outer(width, width)
    step = np.linalg.solve(G + prior * np.eye(len(width)), gradient)
    gain = float(step @ (2.0 * gradient - G @ step))
    return _Profile(step * width, gain, V, K / width)


def _columns(
    problem: Problem, fit: Fit, bounds: Mapping[Place, tuple[float, float]]
) -> Float[np.ndarray, "W R s"]:
    """Return the response of the predictions to each shape."""
    columns = []
    for at, (low, high) in bounds.items():
        h = _PROBE * (high - low)
        members = reshaped_members(fit, {at: _shape(fit, at) + h})
        moved = problem.residual(replace(fit.hypothesis, members=members), fit.start)
        columns.append((fit.residual - moved) / h)
    return np.stack(columns, axis=-1)


def _places(fit: Fit, machine: Machine) -> dict[Place, tuple[float, float]]:
    """Return the shapes of a fit that are fitted, with their bounds."""
    return {
        (k, i): bounds
        for k, c in enumerate(fit.members)
        for i, bounds in ranges(c, machine).items()
    }


def _shape(fit: Fit, at: Place) -> float:
    return float(fit.members[at[0]].shapes[at[1]])


def reshaped_members(fit: Fit, values: Mapping[Place, float]) -> tuple[Candidate, ...]:
    """Return the members of a fit with other values of some of their shapes."""
    members = list(fit.members)
    for (k, i), value in values.items():
        shapes = members[k].shapes.copy()
        shapes[i] = value
        members[k] = members[k].with_shapes(shapes)
    return tuple(members)
