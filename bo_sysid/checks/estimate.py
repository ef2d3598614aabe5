r"""Delays and encoder zeros with their uncertainty, from the balance of forces.

About a hypothesis, the actuators' force along a degree of freedom is regressed on what the motion
needs and on what may be physics, so that a wrong mass or friction does not pose as a delay:

    f(t - d) - δ f'(t - d) = Σ_b m_b Y_b + i a + b v + c tanh(v / v₀) + c₀

with Y_b what the mass of body b needs, scaled by m_b. δ corrects the delay d; a zero enters by the
balance's change with the joint's position. The uncertainty is that of a jackknife over stretches
of the recordings, and for a delay what noise in the motion may do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.hypothesis import Wire, WiringHypothesis
from bo_sysid.checks.traces import blocks

_BLOCKS = 8
_STEPS = 4
_SHIFT = 1e-3  # [s] half width of the difference that gives f'
_STUCK = 0.2  # of the mean speed: slower motion does not tell a delay
_TURN = 1e-3  # [rad] or [m] of the difference that gives the change with a zero


@dataclass(frozen=True)
class Estimate:
    """A number and its standard deviation, in SI units."""

    value: float
    sigma: float


def delay(evidence: WiringEvidence, h: WiringHypothesis, control: str) -> Estimate:
    """Return how much later than stamped one control acts, in [s]."""
    j, terms = evidence.dof(control), evidence.terms(h)
    speed = np.abs(terms.velocity[:, j])
    moving = speed > _STUCK * speed.mean()  # a joint that sticks needs less than it is given
    if not moving.any():  # a joint that never moves says nothing of when its control acts
        return Estimate(h.delay, np.inf)
    late, sigma = h.delay, 0.0
    for _ in range(_STEPS):
        found, sigma = _jackknife(*_delayed(evidence, h, j, late, moving))
        step = float(np.clip(found, -0.02, 0.02))
        late += step
        if abs(step) < 1e-5:
            break
    return Estimate(late, float(np.hypot(sigma, _by_noise(evidence, h, j, late, moving))))


def _delayed(
    evidence: WiringEvidence,
    h: WiringHypothesis,
    j: int,
    late: float,
    moving: Bool[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "m p"], Float[np.ndarray, " m"]]:
    """Return regressors (the delay's first) and the actuators' force along a degree of freedom."""
    terms = evidence.terms(h)
    force, later, earlier = (
        terms.actuated(evidence.controls(h, late + s))[:, j] for s in (0.0, _SHIFT, -_SHIFT)
    )
    columns = np.column_stack([-(later - earlier) / (2 * _SHIFT), evidence.physics(h)[:, j]])
    return columns[moving], force[moving]


def _by_noise(
    evidence: WiringEvidence,
    h: WiringHypothesis,
    j: int,
    late: float,
    moving: Bool[np.ndarray, " n"],
) -> float:
    """Return how far noise in what is regressed on may have moved a delay, in [s].

    Regressors with noise count for less than they do, and the delay for more: a servo that follows
    its command moves much as one that is late and less damped. Where each half of the samples is
    the other's instrument, noise has no say.
    """
    if not evidence.halves:
        return 0.0
    without = late
    for _ in range(_STEPS):
        (a, ya), (b, yb) = (_delayed(e, h, j, without, moving) for e in evidence.halves)
        size = np.sqrt((a**2).mean(axis=0)) + 1e-300
        a, b, p = a / size, b / size, a.shape[1]
        gram, right = a.T @ b + b.T @ a, a.T @ yb + b.T @ ya
        ridge = 1e-9 * np.trace(gram) / p * np.eye(p)
        without += float(np.clip(np.linalg.solve(gram + ridge, right)[0] / size[0], -0.02, 0.02))
    return abs(without - late)


def zero(evidence: WiringEvidence, h: WiringHypothesis, names: Sequence[str]) -> Estimate:
    """Return by how much the zero of some channels, together, is still wrong, in [rad] or [m]."""
    offset, sigma = 0.0, np.inf
    for _ in range(_STEPS):
        base, right, left = (
            _excess(evidence, with_zero(h, names, offset + s)) for s in (0.0, _TURN, -_TURN)
        )
        slope = (right - left) / (2 * _TURN)
        found, sigma = _jackknife(*_stacked(evidence, with_zero(h, names, offset), base, slope))
        step = float(np.clip(-found, -0.3, 0.3))
        offset += step
        if abs(step) < 1e-4:
            break
    return Estimate(offset, sigma)


def with_zero(h: WiringHypothesis, names: Sequence[str], value: float) -> WiringHypothesis:
    """Return a hypothesis with the zero of some channels moved by `value`."""
    wires: dict[str, Wire] = {
        n: replace(h.wires[n], offset=h.wires[n].offset + value) for n in names
    }
    return replace(h, wires={**h.wires, **wires})


def _excess(evidence: WiringEvidence, h: WiringHypothesis) -> Float[np.ndarray, "n nv"]:
    """Return the force needed less the actuators' force."""
    terms = evidence.terms(h)
    return np.asarray(terms.required_force - terms.actuated(evidence.controls(h, h.delay)))


def _stacked(
    evidence: WiringEvidence, h: WiringHypothesis, base: np.ndarray, slope: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return regressors (the slope first) and target of all degrees of freedom, scaled alike."""
    used = np.flatnonzero(evidence.weights)
    physics = evidence.physics(h)[..., :-1]  # without the constant, which a zero resembles
    count, size = len(base), physics.shape[2]
    columns = np.zeros((count, len(used), 1 + size * len(used)))
    target = np.zeros((count, len(used)))
    for place, j in enumerate(used):
        spare = base[:, j] - physics[:, j] @ np.linalg.lstsq(physics[:, j], base[:, j])[0]
        scale = max(float(spare.std()), 1e-12)
        first = 1 + size * place
        columns[:, place, 0] = slope[:, j] / scale
        columns[:, place, first : first + size] = physics[:, j] / scale
        target[:, place] = base[:, j] / scale
    return columns, target


def _jackknife(columns: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Return the first coefficient of a regression and its deviation.

    Args:
        columns: `n x ... x p` regressors.
        target: `n x ...`.
    """
    p = columns.shape[-1]
    if not columns[..., 0].any():  # a control that never changes, or nothing that moved, tells none
        return 0.0, float("inf")
    size = np.sqrt((columns.reshape(-1, p) ** 2).mean(axis=0)) + 1e-300
    grams, rights = [], []
    for mask in blocks(len(columns), _BLOCKS):
        a, b = (columns[mask] / size).reshape(-1, p), target[mask].ravel()
        grams.append(a.T @ a)
        rights.append(a.T @ b)
    gram, right = np.sum(grams, axis=0), np.sum(rights, axis=0)
    ridge = 1e-9 * np.trace(gram) / p * np.eye(p)
    whole = np.linalg.solve(gram + ridge, right)[0] / size[0]
    without = [
        np.linalg.solve(gram - g + ridge, right - r)[0] / size[0]
        for g, r in zip(grams, rights, strict=True)
    ]
    spread = np.sqrt((_BLOCKS - 1) / _BLOCKS * np.sum((np.array(without) - np.mean(without)) ** 2))
    return float(whole), float(spread)
