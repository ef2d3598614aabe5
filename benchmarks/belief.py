"""The belief at scale: time, memory and error of P over 10⁵ and 10⁶ candidates.

Δ is a smooth bowl in four dimensions with a floor. A search on a coarse grid has evaluated 40
candidates; the belief is then updated (surrogate fitted, P computed) on a fine grid that contains
them. Every update runs in a process of its own, whose peak memory counts whole, imports included.

- n1e5_*, n1e6_*: seconds, peak GiB, and total variation of P to a long exact run: the covariance of
  each member's 3 000 likeliest candidates factored exactly, 20 times the samples. `outside` is the
  share of P that the tool gives to other candidates. Beside it stands the total variation between
  two exact runs with as many samples as the tool's: what sampling alone does.
- exact, low_rank (as the tool does it), low_rank_by_variance (the usual pivots), pathwise (BoTorch:
  Matheron's rule with random Fourier features) and independent (the marginals alone), all on those
  candidates with as many samples.

    python benchmarks/belief.py [--quick]
"""

import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from common import Cases, benchmark

from bo_sysid.belief import joint
from bo_sysid.belief.argmin import SAMPLES_LARGE as SAMPLES
from bo_sysid.belief.argmin import argmin_probability, evaluated_rows, samples_per_member
from bo_sysid.belief.joint import contenders, dense_factor, nystrom_factor, posterior_moments
from bo_sysid.belief.stopping import StopRule
from bo_sysid.belief.surrogate import Surrogate, fit_surrogate
from bo_sysid.deviation import Evaluation
from bo_sysid.execution import LocalEngine, map_jobs
from bo_sysid.identify.search import History, Rules, search
from bo_sysid.parameters import CandidateSet, Parameter

COARSE, DIMENSIONS, EVALUATED = 7, 4, 40
SIDES = {"n1e5": 19, "n1e6": 31}  # values a parameter; 19⁴ = 130 321, 31⁴ = 923 521
LONG = 20 * SAMPLES
SEEDS = 3
LIKELIEST = 3000  # candidates of a member that the estimators are compared on
_BLOCK = 256  # joint samples drawn at a time


def bowl(points: np.ndarray, seed: int) -> np.ndarray:
    """Return Δ: a skew bowl in the unit cube with a floor, as recordings with noise give it."""
    rng = np.random.default_rng((seed, 5))
    centre, width = rng.uniform(0.25, 0.75, DIMENSIONS), rng.uniform(0.6, 2.0, DIMENSIONS)
    away = (points - centre) * width
    skew = away + 0.3 * np.roll(away, 1, axis=1) + 0.2 * away**2
    return np.asarray(np.sqrt(0.05**2 + (skew**2).sum(axis=1)))


def evaluated(seed: int) -> np.ndarray:
    """Return the steps on the coarse grid of what a search evaluated there."""
    parameters = [Parameter(f"x{k}", ("a",), 0.0, 1.0, COARSE) for k in range(DIMENSIONS)]
    coarse = CandidateSet.from_grid(parameters)
    delta = bowl(coarse.points, seed)

    def evaluate(row: int) -> Evaluation:
        return Evaluation(delta[[row]], np.zeros((1, 1)), np.zeros(1))

    rules = Rules("argmin-entropy", StopRule(EVALUATED, entropy=None), seed)
    rows = search(coarse, evaluate, rules, History.empty(1)).history.rows
    return np.stack(np.unravel_index(rows, (COARSE,) * DIMENSIONS), axis=1)


def prepared(name: str, steps: list[list[int]], seed: int) -> tuple[np.ndarray, np.ndarray, Any]:
    """Return the fine grid, the rows of it that were evaluated, and the bounds."""
    side = SIDES[name]
    axes = np.meshgrid(*[np.linspace(0.0, 1.0, side)] * DIMENSIONS, indexing="ij")
    points = np.stack([a.ravel() for a in axes], axis=1)
    every = (side - 1) // (COARSE - 1)
    rows = np.ravel_multi_index(tuple((np.array(steps) * every).T), (side,) * DIMENSIONS)
    return points, rows, np.array([[0.0] * DIMENSIONS, [1.0] * DIMENSIONS])


def update(job: tuple[str, list[list[int]], int]) -> dict[str, Any]:
    """Update the belief once, and return what it took; run in a process of its own."""
    name, steps, seed = job
    points, rows, bounds = prepared(name, steps, seed)
    delta = bowl(points[rows], seed)
    fit_surrogate(points[rows][:6], delta[:6], bounds)  # imports and allocations come first
    began = time.perf_counter()
    surrogate = fit_surrogate(points[rows], delta, bounds, seed=seed)
    belief = argmin_probability(surrogate, points, samples=SAMPLES, seed=seed)
    seconds = time.perf_counter() - began
    held = np.flatnonzero(belief.probabilities)
    return {
        "seconds": seconds,
        "gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "estimator": belief.estimator,
        "lost": belief.mass_lost,
        "held": held.tolist(),
        "probabilities": belief.probabilities[held].tolist(),
        "max_p": float(belief.probabilities.max()),
    }


def alone(job: tuple[str, list[list[int]], int]) -> dict[str, Any]:
    """Return `update` from a fresh process."""
    (outcome,) = map_jobs(update, {"update": job}, engine=LocalEngine(1))
    if outcome.error is not None:
        raise RuntimeError(outcome.error)
    return dict(outcome.result)


def variation(p: np.ndarray, q: np.ndarray) -> float:
    """Return the total variation between two distributions."""
    return float(0.5 * np.abs(p - q).sum())


class Field:
    """One member's likeliest candidates, as every estimator takes them."""

    def __init__(self, surrogate: Surrogate, points: np.ndarray, member: int) -> None:
        own = surrogate.members[member]
        x = surrogate.unit(points)
        known, values = evaluated_rows(surrogate, points)
        moments = posterior_moments(own, x, surrogate.standardised, known, values)
        rows, bound, _ = contenders(own, x, moments, joint.MASS)
        likely = np.sort(np.argsort(-bound, kind="stable")[:LIKELIEST])
        likely = likely[moments.variance[rows[likely]] > 0]
        self.survivors = len(rows)
        self.member, self.number = own, member
        self.rows, self.bound = rows[likely], bound[likely]
        self.x, self.mean = x[self.rows], moments.mean[self.rows]
        self.variance = moments.variance[self.rows]
        at = int(np.argmin(values))
        self.floor, self.holder = float(values[at]), int(known[at])

    def counted(self, draws: np.ndarray, size: int) -> np.ndarray:
        """Return how often each of `size` candidates is the arg-min of draws `b x s`."""
        below = draws.min(axis=1, initial=np.inf) < self.floor
        counts = np.bincount(self.rows[draws[below].argmin(axis=1)], minlength=size).astype(float)
        counts[self.holder] += (~below).sum()
        return counts


def by_factor(field: Field, factor: np.ndarray, samples: int, size: int, seed: Any) -> np.ndarray:
    """Return counts of arg-mins of joint samples with a given factor."""
    rng, counts = np.random.default_rng(seed), np.zeros(size)
    factor = factor.astype(np.float32)
    for start in range(0, samples, _BLOCK):
        normals = rng.standard_normal((min(_BLOCK, samples - start), len(factor)), np.float32)
        counts += field.counted(field.mean + normals @ factor, size)
    return counts


def exact(field: Field, samples: int, size: int, seed: int) -> np.ndarray:
    """Return counts with the exact factor."""
    factor = dense_factor(field.member, field.x, field.variance)
    return by_factor(field, factor, samples, size, (seed, field.number, 1))


def low_rank(field: Field, samples: int, size: int, seed: int) -> np.ndarray:
    """Return counts with the factor that the tool uses for large sets."""
    rng = np.random.default_rng((seed, field.number))
    factor = joint.covariance_factor(field.member, field.x, field.variance, field.bound, rng)
    return by_factor(field, factor, samples, size, (seed, field.number, 2))


def farthest(field: Field, samples: int, size: int, seed: int) -> np.ndarray:
    """Return counts with a low rank whose pivots are those with the most variance left."""
    rng = np.random.default_rng((seed, field.number))
    subset = rng.choice(len(field.x), min(joint.SUBSET, len(field.x)), replace=False)
    flat = np.ones(len(subset))
    chosen = joint._pivots(field.member, field.x[subset], field.variance[subset], flat, joint.RANK)
    factor = nystrom_factor(field.member, field.x, field.x[subset[chosen]])
    return by_factor(field, factor, samples, size, (seed, field.number, 3))


def pathwise(
    field: Field, samples: int, size: int, seed: int, model: Any, surrogate: Surrogate
) -> np.ndarray:
    """Return counts of arg-mins of paths drawn by Matheron's rule."""
    import torch
    from botorch.sampling.pathwise import draw_matheron_paths

    torch.manual_seed(seed * 100 + field.number)
    low, high = surrogate.bounds
    at = torch.tensor(low + field.x * (high - low))
    counts = np.zeros(size)
    for start in range(0, samples, _BLOCK):
        with torch.no_grad():
            paths = draw_matheron_paths(model, torch.Size([min(_BLOCK, samples - start)]))
            drawn = paths(at).squeeze(-1).numpy()
        counts += field.counted(surrogate.standardise(drawn), size)
    return counts


def independent(field: Field, samples: int, size: int, seed: int) -> np.ndarray:
    """Return counts of arg-mins of samples of the marginals, as if independent."""
    rng, counts = np.random.default_rng((seed, field.number, 4)), np.zeros(size)
    std = np.sqrt(field.variance)
    for start in range(0, samples, _BLOCK):
        normals = rng.standard_normal((min(_BLOCK, samples - start), len(std)))
        counts += field.counted(field.mean + normals * std, size)
    return counts


def estimators(name: str, steps: list[list[int]], seed: int, quick: bool) -> dict[str, Any]:
    """Return total variation to a long exact run, and seconds, of every estimator."""
    points, rows, bounds = prepared(name, steps, seed)
    delta = bowl(points[rows], seed)
    surrogate = fit_surrogate(points[rows], delta, bounds, seed=seed)
    size, found = len(points), {}
    fields = [Field(surrogate, points, m) for m in range(len(surrogate.members))]
    long = LONG // 20 if quick else LONG

    def total(samples: int, draw: Any, *more: Any) -> tuple[np.ndarray, float]:
        began, counts = time.perf_counter(), np.zeros(size)
        for field, share in zip(
            fields, samples_per_member(surrogate.weights, samples), strict=True
        ):
            counts += draw(field, int(share), size, *more)
        return counts / counts.sum(), time.perf_counter() - began

    truth, _ = total(long, exact, 10_000 + seed)
    for label, draw in (
        ("exact", exact),
        ("low_rank", low_rank),
        ("low_rank_by_variance", farthest),
        ("independent", independent),
    ):
        p, seconds = total(SAMPLES, draw, seed)
        found[label] = {"tv": variation(p, truth), "seconds": seconds}
    models = surrogate.models()

    def paths(field: Field, samples: int, size: int, seed: int) -> np.ndarray:
        return pathwise(field, samples, size, seed, models[field.number], surrogate)

    p, seconds = total(SAMPLES, paths, seed)
    found["pathwise"] = {"tv": variation(p, truth), "seconds": seconds}
    tool = argmin_probability(surrogate, points, samples=SAMPLES, seed=seed).probabilities
    considered = np.unique(np.concatenate([[f.holder, *f.rows] for f in fields]))
    first, _ = total(SAMPLES, exact, seed)
    again, _ = total(SAMPLES, exact, 20_000 + seed)
    return {
        "estimators": found,
        "tool_tv": variation(tool, truth),
        "outside": float(1 - tool[considered].sum()),
        "two_exact_runs": variation(first, again),
        "survivors": [f.survivors for f in fields],
        "max_p": float(truth.max()),
        "held": int((truth > 0).sum()),
    }


def run(quick: bool, cases: Cases) -> dict[str, Any]:
    """Update the belief on both grids, and compare the estimators on the smaller one."""
    seeds = range(1 if quick else SEEDS)
    steps = {s: cases.get(f"search {s}", lambda s=s: evaluated(s)) for s in seeds}
    figures: dict[str, Any] = {}
    for name in SIDES:
        told = [
            cases.get(f"{name} {s}", lambda s=s, n=name: alone((n, steps[s], s))) for s in seeds
        ]
        figures[f"{name}_s"] = float(np.median([t["seconds"] for t in told]))
        figures[f"{name}_gib"] = max(t["gib"] for t in told)
        figures[f"{name}_lost"] = max(t["lost"] for t in told)
        figures[f"{name}_candidates"] = SIDES[name] ** DIMENSIONS
    compared = [
        cases.get(f"estimators {s}", lambda s=s: estimators("n1e5", steps[s], s, quick))
        for s in seeds
    ]
    figures["n1e5_tv"] = max(c["tool_tv"] for c in compared)
    figures["n1e5_tv_of_two_exact_runs"] = max(c["two_exact_runs"] for c in compared)
    figures["n1e5_outside"] = max(c["outside"] for c in compared)
    figures["survivors_of_the_filter"] = [max(c["survivors"]) for c in compared]
    figures["max_p"] = [c["max_p"] for c in compared]
    for label in compared[0]["estimators"]:
        both = [c["estimators"][label] for c in compared]
        figures[label] = {k: float(np.median([b[k] for b in both])) for k in ("tv", "seconds")}
    return figures


if __name__ == "__main__":
    benchmark("belief", run)
