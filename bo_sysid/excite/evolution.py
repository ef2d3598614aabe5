"""Separable CMA-ES: a random search that learns the scale of each coordinate.

[Ros2008] R. Ros, N. Hansen. A Simple Modification in CMA-ES Achieving Linear Time and Space
Complexity. PPSN X, 2008.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class _Rates:
    """How fast a search in n dimensions learns, from its number of parents.

    Attributes:
        weight: of the parents, the best first; their sum is 1.
        mass: number of equal parents that would be as good a mean.
        c_sigma: share of a new step in the path of the step's size.
        damping: of the changes of that size.
        c_path: share of a new step in the path of the scales.
        c_one: share of that path in new scales.
        c_mass: share of the parents in them.
        expected: length of a vector of n standard normal numbers.
    """

    weight: Float[np.ndarray, " k"]
    mass: float
    c_sigma: float
    damping: float
    c_path: float
    c_one: float
    c_mass: float
    expected: float

    @classmethod
    def of(cls, n: int, parents: int) -> "_Rates":
        """Return those of [Ros2008]."""
        weight = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
        weight /= weight.sum()
        mass = 1.0 / float((weight**2).sum())
        c_sigma = (mass + 2) / (n + mass + 5)
        faster = (n + 2) / 3  # what a diagonal covariance may learn faster
        c_one = min(faster * 2 / ((n + 1.3) ** 2 + mass), 0.5)
        c_mass = min(1 - c_one, faster * 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass))
        return cls(
            weight=weight,
            mass=mass,
            c_sigma=c_sigma,
            damping=1 + c_sigma + 2 * max(0.0, float(np.sqrt((mass - 1) / (n + 1))) - 1),
            c_path=(4 + mass / n) / (n + 4 + 2 * mass / n),
            c_one=c_one,
            c_mass=c_mass,
            expected=float(np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))),
        )


class _Draws:
    """The distribution that points are drawn from, which follows the best of them.

    Args:
        mean: of p coordinates, at first.
        sigma: standard deviation of all of them, at first.
        rates: how fast it follows.
    """

    def __init__(self, mean: Float[np.ndarray, " p"], sigma: float, rates: _Rates) -> None:
        self._mean, self._sigma, self._rates = mean, sigma, rates
        self._scale = np.ones(len(mean))
        self._step_path, self._path = np.zeros(len(mean)), np.zeros(len(mean))

    def points(self, z: Float[np.ndarray, "*n p"]) -> Float[np.ndarray, "*n p"]:
        """Return the points that standard normal numbers stand for."""
        return np.asarray(self._mean + self._sigma * np.sqrt(self._scale) * z)

    def follow(self, chosen: Float[np.ndarray, "k p"]) -> None:
        """Move towards the parents, given as what they were drawn from, the best first."""
        r, scale = self._rates, self._scale
        shift = r.weight @ chosen
        self._mean = self.points(shift)
        self._step_path = (1 - r.c_sigma) * self._step_path + (
            np.sqrt(r.c_sigma * (2 - r.c_sigma) * r.mass) * shift
        )
        self._path = (1 - r.c_path) * self._path + (
            np.sqrt(r.c_path * (2 - r.c_path) * r.mass) * np.sqrt(scale) * shift
        )
        self._scale = (
            (1 - r.c_one - r.c_mass) * scale
            + r.c_one * self._path**2
            + r.c_mass * scale * (r.weight @ chosen**2)
        )
        length = float(np.linalg.norm(self._step_path))
        self._sigma *= float(np.exp(r.c_sigma / r.damping * (length / r.expected - 1)))


def minimise(
    cost: Callable[[Float[np.ndarray, "n p"]], Float[np.ndarray, " n"]],
    start: Float[np.ndarray, " p"],
    sigma: float,
    budget: int,
    seed: int,
    *,
    offspring: int | None = None,
    report: Callable[[int, float], None] | None = None,
) -> tuple[Float[np.ndarray, " p"], float]:
    """Return the best point that was evaluated and its cost; `start` and infinity where none is.

    Args:
        cost: to be minimised, of n points at once; one that is NaN or infinite is worse than all.
        start: the mean at first.
        sigma: standard deviation at first.
        budget: number of evaluations.
        seed: of the draws.
        offspring: points a generation; by default 4 + 3 log p.
        report: told the number of evaluations and the lowest cost.
    """
    rng, n = np.random.default_rng(seed), len(start)
    offspring = offspring or 4 + int(3 * np.log(n))
    parents = offspring // 2
    draws = _Draws(start, sigma, _Rates.of(n, parents))
    best, lowest, done = start.copy(), float(_finite(cost(start[None]))[0]), 1
    while done < budget:
        z = rng.standard_normal((offspring, n))
        points = draws.points(z)
        costs = _finite(cost(points))
        done += offspring
        order = np.argsort(costs)
        if costs[order[0]] < lowest:
            best, lowest = points[order[0]].copy(), float(costs[order[0]])
        draws.follow(z[order[:parents]])
        if report is not None:
            report(done, lowest)
    return best, lowest


def _finite(costs: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return costs with infinity for what is no number: beside NaN nothing would be better."""
    return np.where(np.isfinite(costs), costs, np.inf)
