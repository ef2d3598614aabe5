"""Does the search find the full grid's arg-min, and how far is it from the truth?

On each dm-control study and for each seed a plant is recorded anew, Δ is computed on the whole
grid, and the search is run with 60 evaluations, by arg-min entropy and by random picks. Success:
the grid's arg-min is among the three candidates with the largest P. Beside it stand the errors of
the parameters for a plant with the model's step and for one with a step four times finer.
"""

from pathlib import Path

import numpy as np
from common import Cases, benchmark

from bo_sysid.belief.stopping import StopRule
from bo_sysid.deviation import Deviation, Evaluation, Whitening
from bo_sysid.identify.search import History, Rules, search, update_belief
from bo_sysid.parameters import CandidateSet
from bo_sysid.plants.build import build_plant, record
from bo_sysid.simulation import cut
from bo_sysid.simulation.of_study import make_simulator
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.study.overview import candidate_set

STUDIES = Path(__file__).parents[1] / "studies"
NAMES = ("cheetah", "hopper", "swimmer")
RULES = ("argmin-entropy", "random")
BUDGET = 60


def tabulated(name: str, seed: int, fine: bool) -> tuple[CandidateSet, Evaluation, np.ndarray]:
    """Return B, Δ on all of it for a newly recorded plant, and the plant's parameters."""
    study = Study.load(STUDIES / f"{name}.yaml")
    model = load_model(study)
    timestep = float(model.compile().opt.timestep)
    if fine:
        study = Study.load(STUDIES / f"{name}.yaml", {"plant.timestep": timestep / 4})
    parameters = study.parameter_set(model)
    recordings = record(build_plant(study, seed=seed), model, 2, duration=3.0, seed=seed)
    windows = cut(model, recordings, horizon=1)
    deviation = Deviation(make_simulator(study, model, parameters), windows, Whitening.of(windows))
    candidates = candidate_set(study, parameters)
    assert study.plant is not None
    truth = np.array([study.plant.parameters[p.name] for p in parameters])
    return candidates, deviation(candidates.points), truth


def row_of(table: Evaluation, row: int) -> Evaluation:
    return Evaluation(table.deviation[[row]], table.contributions[[row]], table.diverged[[row]])


def one_case(name: str, seed: int, fine: bool) -> dict[str, object]:
    """Search the same table with every rule."""
    candidates, table, truth = tabulated(name, seed, fine)
    target = int(table.deviation.argmin())
    case: dict[str, object] = {
        "error_of_grid": np.abs(candidates.points[target] - truth),
        "spacing": [float(np.diff(p.grid)[0]) for p in candidates.parameters],
    }
    rules = Rules("argmin-entropy", StopRule(BUDGET, entropy=None), seed)
    empty = History.empty(table.contributions.shape[1])
    outcome = search(candidates, lambda row: row_of(table, row), rules, empty)
    blind = at_random(candidates, table, rules)
    for rule, history, belief in (
        ("argmin-entropy", outcome.history, outcome.belief),
        ("random", blind, update_belief(candidates, blind, rules)[1]),
    ):
        order = np.argsort(-belief.probabilities, kind="stable")
        best = history.rows[history.evaluation.deviation.argmin()]
        case[rule] = {
            "top3": bool(target in order[:3]),
            "top1": bool(target == order[0]),
            "max_p": float(belief.probabilities.max()),
            "evaluations": len(history),
            "regret": float(history.evaluation.deviation.min() / table.deviation[target] - 1),
            "error": np.abs(candidates.points[best] - truth),
        }
    return case


def at_random(candidates: CandidateSet, table: Evaluation, rules: Rules) -> History:
    """Return a whole budget of random picks; their belief is computed once, at the end."""
    rows = np.random.default_rng(rules.seed).permutation(len(candidates))[:BUDGET]
    history = History.empty(table.contributions.shape[1])
    for row in rows.tolist():
        history = history.with_evaluation(row, row_of(table, row))
    return history


def run(quick: bool, cases: Cases) -> dict[str, object]:
    """Search with ten seeds on each study, for a plant with the same and with a finer step."""
    seeds = range(1 if quick else 10)
    figures: dict[str, object] = {}
    for name in NAMES:
        for fine in (False, True):
            count = seeds if not fine else range(min(len(seeds), 4))
            found = [
                cases.get(
                    f"{name} {'finer step' if fine else 'same step'} {s}",
                    lambda name=name, s=s, fine=fine: one_case(name, s, fine),
                )
                for s in count
            ]
            figures[f"{name}{'_fine' if fine else ''}"] = {
                "seeds": len(found),
                **{rule: summary([f[rule] for f in found]) for rule in RULES},
                "spacing": found[0]["spacing"],
                "median_error_of_grid": np.median([f["error_of_grid"] for f in found], axis=0),
            }
    return figures


def summary(results: list[dict[str, object]]) -> dict[str, object]:
    return {
        "top3": sum(bool(r["top3"]) for r in results),
        "top1": sum(bool(r["top1"]) for r in results),
        "median_evaluations": float(np.median([r["evaluations"] for r in results])),
        "median_regret": float(np.median([r["regret"] for r in results])),
        "median_error": np.median([r["error"] for r in results], axis=0),
    }


if __name__ == "__main__":
    benchmark("recovery", run)
