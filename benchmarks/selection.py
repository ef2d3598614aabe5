"""Which candidate to try next, which model to trust: arms compared with paired seeds.

Runs `bo-sysid compare` on `studies/selection/inner.yaml` (searches on recordings: dm-control plants
with 2, 4 and 8 unknown parameters, one with wrong physics, EMPS), on `confirm.yaml` (the winner on
fresh seeds) and on `outer.yaml` (the outer loop, by real trajectories), and gathers what they say.
Every seed has a plant of its own.

- cost: mean evaluations until the excess of Δ over its minimum on B is at most a level (in shares
  of the median excess), with bootstrap intervals; a run that does not get there counts as the
  longest one of the problem.
- ratio: geometric mean of paired costs against the original rule, interval, Wilcoxon's p.
- certain: the same ratio for evaluations until max P >= .95 at the full grid's arg-min, and the
  share of searches that get there. The tool's answer is P: its searches end when P is a point.
- confirmed: that ratio again on thirty fresh seeds, for the one rule that won the first thirty.
- agreement: share of seeds on which two rules take one and the same path.
- reliability: how often argmax P is the full grid's arg-min where max P >= .8, on the searches of
  the original rule: at every evaluation, and when it is first said in a search. With averaging as
  the tool does it; and, on the same histories, without: one Gaussian process on log Δ whose
  hyperparameters are those of largest evidence (BoTorch's default).
- coverage: share of the plants' parameters inside the 95 % intervals of P_boot.

Lists below are a value with its 95 % interval, then what the function's docstring names, then the
number of cases. Figures and tables are left in runs/selection-*.

    python benchmarks/selection.py [--quick] [--stored]
"""

import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import wilcoxon

sys.path.insert(0, str(Path(__file__).parent))

from common import Cases, benchmark

from bo_sysid.compare.arms import ComparedProblem, problems_of, remade
from bo_sysid.compare.compare import Comparison, compare, so_far
from bo_sysid.compare.statistics import bootstrap, share
from bo_sysid.compare.table import Table
from bo_sysid.execution import Progress
from bo_sysid.report.comparison import write_comparison_figures
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_model
from bo_sysid.study.overview import candidate_set

ROOT = Path(__file__).parent.parent
SEED_RULE = "argmin-entropy"
STATED = 0.8
CERTAIN = 0.95
FRESH = 30  # seeds before that number were seen when the rule to confirm was picked
EVERY, POINT_SEEDS = 4, 12  # without averaging: every fourth evaluation of the first twelve seeds
SAMPLES = 2048
QUICK: dict[str, dict[str, Any]] = {
    "inner": {
        "compare.seeds": 2,
        "compare.problems": ["wrong_physics.yaml"],
        "compare.arms": [SEED_RULE, "greedy", "random"],
        "search.budget": 15,
    },
    "confirm": {
        "compare.seeds": 2,
        "compare.problems": ["wrong_physics.yaml"],
        "search.budget": 15,
    },
    "outer": {"compare.seeds": 1, "policy.steps": 8000, "learn.trajectories": 2},
}


def folder_of(name: str, quick: bool) -> Path:
    """Return the run folder of a comparison."""
    return ROOT / "runs" / f"selection-{name}{'-quick' if quick else ''}"


def study_of(name: str, quick: bool) -> Study:
    """Return the study of a comparison."""
    return Study.load(ROOT / "studies" / "selection" / f"{name}.yaml", QUICK[name] if quick else {})


def compared(name: str, quick: bool, stored: bool) -> Comparison:
    """Return a comparison, gone on with unless only what is stored is asked for."""
    study, folder = study_of(name, quick), folder_of(name, quick)
    if stored:
        return so_far(study, folder)

    def told(progress: Progress) -> None:
        print(f"  {name} {progress.step}/{progress.of}: {progress.message}", flush=True)

    with Run.open(folder, study.resolved(relative_to=folder), "compare") as run:
        found = compare(study, run, progress=told)
        write_comparison_figures(run)
    return found


def costs(found: Comparison, unit: str, level: float) -> dict[str, Any]:
    """Return mean cost with its interval, share reached and runs, by problem and arm."""
    out: dict[str, Any] = {}
    for row in found.summary[found.summary["level"] == level].to_dict("records"):
        told = [row[unit], row[f"{unit}_low"], row[f"{unit}_high"], row["reached"], row["runs"]]
        out.setdefault(row["problem"], {})[row["arm"]] = told
    return out


def ratios(found: Comparison, unit: str) -> dict[str, Any]:
    """Return paired ratios against the first arm over all problems: ratio, low, high, p, pairs."""
    part = found.paired[found.paired["unit"] == unit]
    everywhere = part[part["problem"] == "all"]
    if everywhere.empty:
        everywhere = part
    out: dict[str, Any] = {}
    for row in everywhere.to_dict("records"):
        told = [row[k] for k in ("ratio", "low", "high", "p", "pairs")]
        out.setdefault(row["arm"], {})[f"regret {row['level']:g}"] = told
    return out


def certain(found: Comparison, first: int = 0) -> dict[str, Any]:
    """Return paired ratios of evaluations until the right answer is certain.

    A search that does not get there counts as the longest one of its problem.

    Returns:
        Arm -> ratio, low, high, p, share of searches that get there, pairs.
    """
    paths = found.paths[found.paths["seed"] >= first]
    if paths.empty:
        return {}
    of = ["problem", "arm", "seed"]
    sure = paths[(paths["max_p"] >= CERTAIN) & paths["right"].fillna(False).astype(bool)]
    reached = sure.groupby(of, observed=True)["evaluations"].min()
    longest = paths.groupby("problem", observed=True)["evaluations"].max()
    spent = paths.groupby(of, observed=True).size().to_frame("rows").join(reached)
    most = longest.loc[spent.index.get_level_values("problem")].to_numpy()
    spent["cost"] = spent["evaluations"].fillna(pd.Series(most, index=spent.index))
    own = spent["cost"].xs(SEED_RULE, level="arm")
    out: dict[str, Any] = {}
    for arm, part in spent.groupby(level="arm", observed=True, sort=False):
        logs = np.log(part["cost"].droplevel("arm") / own).dropna().to_numpy()
        mean, low, high = (float(np.exp(v)) for v in bootstrap(logs))
        p = float(wilcoxon(logs).pvalue) if logs.any() else 1.0
        there = float(part["evaluations"].notna().mean())
        out[str(arm)] = [mean, low, high, p, there, len(logs)]
    return out


def agreement(found: Comparison) -> dict[str, Any]:
    """Return on which share of seeds the original rule and greedy take one path, by problem."""
    both = found.agreement
    both = both[(both["arm"] == SEED_RULE) & (both["other"] == "greedy")]
    columns = ["identical", "identical_low", "identical_high", "pairs", "overlap"]
    return {row["problem"]: [row[c] for c in columns] for row in both.to_dict("records")}


def rate(right: pd.Series) -> list[float]:
    """Return how often something was right, with Wilson's interval, and among how many."""
    told = share(int(right.sum()), len(right))
    return [*told, len(right)]


def averaged(found: Comparison) -> dict[str, Any]:
    """Return the reliability of max P as the tool computes it."""
    own = found.paths[(found.paths["arm"] == SEED_RULE) & found.paths["right"].notna()]
    sure = own[own["max_p"] >= STATED]
    first = sure.groupby(["problem", "seed"], sort=False).head(1)
    bins = pd.cut(own["max_p"], [0, 0.2, 0.4, 0.6, 0.8, 1.0])
    curve = own.groupby(bins, observed=True).agg(
        stated=("max_p", "mean"), right=("right", "mean"), cases=("right", "size")
    )
    return {
        "every_evaluation": rate(sure["right"]),
        "first_time": rate(first["right"]),
        "by_problem": {
            str(name): rate(part["right"]) for name, part in sure.groupby("problem", sort=False)
        },
        "curve": {str(k): list(v.values()) for k, v in curve.to_dict("index").items()},
    }


def without(found: Comparison, quick: bool, cases: Cases) -> dict[str, Any]:
    """Return the reliability of max P from one Gaussian process, on the same histories."""
    problems = {p.name: p for p in problems_of(study_of("inner", quick), trust_code=False)}
    own = found.paths[(found.paths["arm"] == SEED_RULE) & found.paths["right"].notna()]
    rows: list[dict[str, Any]] = []
    for (name, seed), path in own.groupby(["problem", "seed"], sort=False):
        key = f"point {name} {seed} of {len(path)}"
        if seed >= POINT_SEEDS or (cases.stored and key not in cases):
            continue
        whole = found.paths[
            (found.paths["arm"] == SEED_RULE)
            & (found.paths["problem"] == name)
            & (found.paths["seed"] == seed)
        ]
        rows += cases.get(key, lambda p=problems[name], w=whole: pointwise(p, w, quick))
    table = pd.DataFrame(rows, columns=["problem", "seed", "evaluations", "max_p", "right"])
    sure = table[table["max_p"] >= STATED]
    both = own.merge(table[["problem", "seed", "evaluations"]])
    return {
        "point_estimate": rate(sure["right"]),
        "averaged_on_the_same_histories": rate(both[both["max_p"] >= STATED]["right"]),
    }


def pointwise(problem: ComparedProblem, path: pd.DataFrame, quick: bool) -> list[dict[str, Any]]:
    """Return max P of one Gaussian process after every fourth evaluation of a search."""
    seed = int(path["seed"].iloc[0])
    study = remade(problem.seeded(seed), str(problem.study.folder))
    points = candidate_set(study, study.parameter_set(load_model(study))).points
    data = seed if problem.fresh else 0
    table = Table.read(folder_of("inner", quick) / f"tables/{problem.name}/{data:03d}.npz")
    deviation = table.evaluation.deviation
    rows, design = path["row"].to_numpy(int), int((~path["chosen"]).sum())
    out = []
    for count in range(design, len(rows) + 1, EVERY):
        p = point_belief(points, rows[:count], deviation[rows[:count]], seed)
        right = deviation[p.argmax()] == deviation.min()
        out.append(
            {
                "problem": problem.name,
                "seed": seed,
                "evaluations": count,
                "max_p": float(p.max()),
                "right": bool(right),
            }
        )
    return out


def point_belief(
    points: np.ndarray, rows: np.ndarray, deviation: np.ndarray, seed: int
) -> np.ndarray:
    """Return P over B from BoTorch's `SingleTaskGP` on log Δ, fitted by its evidence."""
    import torch
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from botorch.models.transforms import Normalize, Standardize
    from gpytorch.mlls import ExactMarginalLogLikelihood

    torch.manual_seed(seed)
    B = torch.tensor(points)
    y = torch.tensor(np.log(deviation))[:, None]
    bounds = torch.stack([B.min(dim=0).values, B.max(dim=0).values])
    model = SingleTaskGP(
        B[rows], y, torch.full_like(y, 1e-6),
        input_transform=Normalize(B.shape[1], bounds=bounds), outcome_transform=Standardize(1),
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
        with torch.no_grad():
            draws = model.posterior(B).rsample(torch.Size([SAMPLES])).squeeze(-1)
    counts = np.bincount(draws.argmin(dim=1).numpy(), minlength=len(points))
    return np.asarray(counts / counts.sum())


def coverage(found: Comparison) -> dict[str, Any]:
    """Return the share of parameters that the intervals of P_boot cover, by problem."""
    own = found.ends[(found.ends["arm"] == SEED_RULE) & (found.ends["uncertain"] > 0)]
    out: dict[str, Any] = {}
    for name, part in own.groupby("problem", sort=False):
        told = bootstrap((part["covered"] / part["uncertain"]).to_numpy(float))
        out[str(name)] = [*told, len(part)]
    return out


def seconds(found: Comparison) -> dict[str, float]:
    """Return the median seconds that an arm thinks per pick, over all problems."""
    rows: dict[str, float] = {}
    for arm, part in found.paths.groupby("arm", sort=False):
        picks = part[part["chosen"]].groupby(["problem", "seed"], sort=False)["seconds"]
        each = (picks.last() - picks.first()) / (picks.size() - 1).clip(lower=1)
        rows[str(arm)] = float(each.median())
    return rows


def run(quick: bool, cases: Cases) -> dict[str, Any]:
    """Carry out both comparisons and return their figures."""
    inner = compared("inner", quick, cases.stored)
    figures: dict[str, Any] = {
        "seeds": inner.ends.groupby("problem", sort=False)["seed"].nunique().to_dict(),
        "skipped": dict(inner.skipped),
        "reliability": averaged(inner) | without(inner, quick, cases),
        "coverage": coverage(inner),
        "agreement": agreement(inner),
        "ratio": ratios(inner, "evaluations"),
        "certain": certain(inner),
        "confirmed": certain(compared("confirm", quick, cases.stored), 0 if quick else FRESH),
        "evaluations_to_regret_0.01": costs(inner, "evaluations", 0.01),
        "evaluations_to_regret_0": costs(inner, "evaluations", 0.0),
        "seconds_per_pick": seconds(inner),
    }
    outer = compared("outer", quick, cases.stored)
    figures["outer"] = {
        "seeds": int(outer.paths["seed"].nunique()),
        "final_regret": final(outer),
        "trajectories_to_regret_0.05": costs(outer, "trajectories", 0.05),
        "ratio": ratios(outer, "trajectories"),
    }
    return figures


def final(found: Comparison) -> dict[str, Any]:
    """Return what each arm ended with: regret of the last policy, trajectories, with intervals."""
    last = found.paths.groupby(["arm", "problem", "seed"], sort=False).tail(1)
    best = found.paths.groupby(["problem", "seed"])["plant_return"].max()
    out = {}
    for arm, part in last.groupby("arm", sort=False):
        top = best.loc[pd.MultiIndex.from_frame(part[["problem", "seed"]])].to_numpy()
        regret = bootstrap(1 - part["plant_return"].to_numpy() / top)
        spent = bootstrap(part["trajectories"].to_numpy(float))
        out[str(arm)] = {"regret": list(regret), "trajectories": list(spent)}
    return out


if __name__ == "__main__":
    benchmark("selection", run, partial=True)
