"""EMPS from the authors' raw files: does the search reach the published physics?

For each seed: 80 evaluations over 14 641 candidates with fitted starts; the best one is compared
with the published values and with the candidate nearest to them; then the held-out errors on the
pulses file.
"""

from pathlib import Path

import numpy as np
from common import Cases, benchmark

from bo_sysid.arrays import Point
from bo_sysid.belief.stopping import StopRule
from bo_sysid.identify.errors import compared
from bo_sysid.identify.identify import evaluation
from bo_sysid.identify.problem import Problem, make_problem
from bo_sysid.identify.search import History, Rules, search
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_holdout

STUDY = Path(__file__).parents[1] / "studies" / "real" / "emps.yaml"
PUBLISHED = np.array([95.1089, 203.5034, 20.3935, 3.1648])  # kg, N s/m, N, N


def nearest(problem: Problem) -> Point:
    """Return the candidate nearest to the published values, in units of the grid's steps."""
    low, high = problem.candidates.bounds
    distance = ((problem.candidates.points - PUBLISHED) / (high - low)) ** 2
    return problem.candidates.points[distance.sum(axis=1).argmin()]


def one_seed(problem: Problem, seed: int, budget: int) -> dict[str, object]:
    """Search once and compare with what was published."""
    rules = Rules("argmin-entropy", StopRule(budget), seed)
    empty = History.empty(len(problem.deviation.blocks.weight))
    candidates = problem.candidates
    outcome = search(candidates, evaluation(problem, candidates), rules, empty)
    deviations = outcome.history.evaluation.deviation
    best = candidates.points[outcome.history.rows[deviations.argmin()]]
    steps = np.array([np.diff(p.grid)[0] for p in problem.parameters])
    reference = nearest(problem)
    reference_deviation = float(problem.deviation(reference[None]).deviation[0])
    within = bool((np.abs(best - PUBLISHED) <= steps).all())
    errors = compared(problem, best, {"holdout": load_holdout(problem.study)})
    held = errors.set_index("kind")
    return {
        "best": best,
        "evaluations": len(deviations),
        "stopped": outcome.reason.value,
        "within_one_step": within,
        "lower_deviation": bool(deviations.min() <= reference_deviation),
        "reached": within or bool(deviations.min() <= reference_deviation),
        "deviation": float(deviations.min()),
        "deviation_nearest_published": reference_deviation,
        "fit_m": float(held.loc["fit", "identified"]),
        "fit_nominal_m": float(held.loc["fit", "nominal"]),
        "forecast_m": float(held.loc["forecast", "identified"]),
        "forecast_nominal_m": float(held.loc["forecast", "nominal"]),
    }


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Search with several seeds."""
    problem = make_problem(Study.load(STUDY))
    budget = 30 if quick else 80
    seeds = range(1 if quick else 3)
    found = [
        cases.get(f"seed {s}, {budget}", lambda s=s: one_seed(problem, s, budget)) for s in seeds
    ]
    return {
        "candidates": len(problem.candidates),
        "budget": budget,
        "seeds": len(found),
        "reached": sum(f["reached"] for f in found),
        "within_one_step": sum(f["within_one_step"] for f in found),
        "fit_m": [f["fit_m"] for f in found],
        "fit_nominal_m": found[0]["fit_nominal_m"],
        "forecast_m": [f["forecast_m"] for f in found],
        "forecast_nominal_m": found[0]["forecast_nominal_m"],
        "best": [f["best"] for f in found],
    }


if __name__ == "__main__":
    benchmark("emps", run)
