"""Separable CMA-ES: a random search that learns the scale of each coordinate.

[Ros2008] R. Ros, N. Hansen. A Simple Modification in CMA-ES Achieving Linear Time and Space
Complexity. PPSN X, 2008.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float


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
    """Return the best point that was evaluated and its cost.

    Args:
        cost: to be minimised, of n points at once.
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
    weight = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weight /= weight.sum()
    mass = 1.0 / float((weight**2).sum())
    c_sigma = (mass + 2) / (n + mass + 5)
    damping = 1 + c_sigma + 2 * max(0.0, float(np.sqrt((mass - 1) / (n + 1))) - 1)
    c_path = (4 + mass / n) / (n + 4 + 2 * mass / n)
    faster = (n + 2) / 3  # what a diagonal covariance may learn faster
    c_one = min(faster * 2 / ((n + 1.3) ** 2 + mass), 0.5)
    c_mass = min(1 - c_one, faster * 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass))
    expected = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
    mean, scale = start.copy(), np.ones(n)
    step_path, path = np.zeros(n), np.zeros(n)
    best, lowest, done = start.copy(), float(cost(start[None])[0]), 1
    while done < budget:
        z = rng.standard_normal((offspring, n))
        points = mean + sigma * np.sqrt(scale) * z
        costs = cost(points)
        done += offspring
        order = np.argsort(costs)
        if costs[order[0]] < lowest:
            best, lowest = points[order[0]].copy(), float(costs[order[0]])
        chosen = z[order[:parents]]
        shift = weight @ chosen
        mean = mean + sigma * np.sqrt(scale) * shift
        step_path = (1 - c_sigma) * step_path + np.sqrt(c_sigma * (2 - c_sigma) * mass) * shift
        length = float(np.linalg.norm(step_path))
        path = (1 - c_path) * path + np.sqrt(c_path * (2 - c_path) * mass) * np.sqrt(scale) * shift
        scale = (
            (1 - c_one - c_mass) * scale + c_one * path**2 + c_mass * scale * (weight @ chosen**2)
        )
        sigma *= float(np.exp(c_sigma / damping * (length / expected - 1)))
        if report is not None:
            report(done, lowest)
    return best, lowest
