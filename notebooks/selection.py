# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Which candidate next? The selection study, from its Parquet files
#
# `bo-sysid compare studies/selection/inner.yaml` runs every rule on every problem with paired
# seeds: same plant, same recordings, same initial design. It leaves tables that this notebook
# reads: `RUN` says from which run. Where the project has none yet, a small one is made first.

# %%
RUN = None  # the project's runs/selection-inner; or a folder of your own: "../runs/selection"
SEEDS = 6  # of the small run
ARMS = ["argmin-entropy", "greedy", "minimum-mean", "thompson", "random"]

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import plotly.io as pio
from matplotlib import pyplot as plt

from bo_sysid import Study
from bo_sysid.compare.compare import compare
from bo_sysid.report.comparison import cost_bars, regret_curves
from bo_sysid.runs import Run

pio.renderers.default = "notebook"  # with its script, so that a rendered page needs no network

# %%
if RUN is None:
    above = (Path.cwd(), *Path.cwd().parents)
    ROOT = next((p for p in above if (p / "studies" / "selection").is_dir()), None)
    if ROOT is None:
        raise FileNotFoundError(
            f"{Path.cwd()} is in no copy of the project (no studies/selection above it): start "
            "Jupyter in one, or name a run of bo-sysid compare in RUN"
        )
    run_folder = ROOT / "runs" / "selection-inner"
else:
    run_folder = Path(RUN).resolve()
    if not (run_folder / "paths.parquet").is_file():
        raise FileNotFoundError(
            f"RUN: {run_folder} is no finished run of bo-sysid compare; it has no paths.parquet"
        )

# %%
if not (run_folder / "paths.parquet").is_file():
    smaller = {"compare.seeds": SEEDS, "compare.arms": ARMS, "search.budget": 22}
    smaller |= {"compare.problems": ["wrong_physics.yaml"]}
    study = Study.load(ROOT / "studies" / "selection" / "inner.yaml", smaller)
    run_folder = Path(tempfile.mkdtemp()) / "selection"
    with Run.open(run_folder, study.resolved(relative_to=run_folder), "compare") as run:
        compare(study, run)

paths = pd.read_parquet(run_folder / "paths.parquet")
summary = pd.read_parquet(run_folder / "summary.parquet")
paired = pd.read_parquet(run_folder / "paired.parquet")
agreement = pd.read_parquet(run_folder / "agreement.parquet")
ends = pd.read_parquet(run_folder / "ends.parquet")
print(
    len(ends),
    "searches of",
    ends["arm"].nunique(),
    "rules on",
    ends["problem"].nunique(),
    "problems",
)

# %% [markdown]
# ## Regret against evaluations
#
# The regret of a search is the excess of the lowest $\Delta$ so far over the minimum on $B$, in
# shares of the excess of the median candidate: 1 is a candidate like any other, 0 is the arg-min.
# Lines are medians over seeds, bands quartiles.

# %%
regret_curves(paths, "evaluations")

# %% [markdown]
# ## What a rule needs
#
# Mean evaluations until the regret is at most a level, with 95 % bootstrap intervals. A search that
# does not get there counts as the longest one of the problem.

# %%
cost_bars(summary, "evaluations")

# %% [markdown]
# ## Against the original rule, seed by seed
#
# The ratio is the geometric mean over pairs: below 1 the rule needs fewer evaluations than
# $-P\log P$. `p` is Wilcoxon's signed-rank test.

# %%
overall = "all" if (paired["problem"] == "all").any() else paired["problem"].iloc[0]
versus = paired[(paired["unit"] == "evaluations") & (paired["problem"] == overall)]
level = sorted(versus["level"].unique())[len(versus["level"].unique()) // 2]
shown = versus[versus["level"] == level].sort_values("ratio")
forest = go.Figure(
    go.Scatter(
        x=shown["ratio"],
        y=shown["arm"],
        mode="markers",
        error_x={
            "type": "data",
            "array": shown["high"] - shown["ratio"],
            "arrayminus": shown["ratio"] - shown["low"],
        },
        customdata=shown[["p", "pairs"]],
        hovertemplate="%{y}: %{x:.2f}<br>p = %{customdata[0]:.2g}, %{customdata[1]} pairs",
    )
)
forest.add_vline(1, line_dash="dash")
forest.update_xaxes(type="log", title=f"evaluations to regret {level:g}, over those of −P log P")
forest.update_layout(height=120 + 40 * len(shown), margin={"l": 10, "r": 10, "t": 30, "b": 10})
forest

# %% [markdown]
# ## Who knows the answer first?
#
# To touch the best candidate is not to know it. `cost`: evaluations until $P \ge 0.95$ at the
# arg-min of $B$, or the longest search of the problem where that never happens; `certain`: how
# many get there.

# %%
sure = paths[(paths["max_p"] >= 0.95) & paths["right"].fillna(False).astype(bool)]
of = ["problem", "arm", "seed"]
first = sure.groupby(of, observed=True)["evaluations"].min().rename("cost")
known = ends.set_index(of)[[]].join(first)
known["certain"] = known["cost"].notna()
longest = paths.groupby("problem", observed=True)["evaluations"].max()
known["cost"] = known["cost"].fillna(longest.reindex(known.index, level="problem"))
table = known.groupby("arm", observed=True).agg({"cost": "mean", "certain": "mean"})
table.sort_values("cost").round(2)

# %% [markdown]
# ## Do the rules pick alike?
#
# $-P\log P$ grows with $P$ up to $P = 1/e$, and candidates that were evaluated are excluded. So it
# differs from greedy only where one candidate that was not evaluated holds more than 1/e of $P$.

# %%
both = agreement[(agreement["arm"] == "argmin-entropy") & (agreement["other"] == "greedy")]
both[["problem", "pairs", "identical", "identical_low", "identical_high", "step", "overlap"]]

# %% [markdown]
# ## Is max P true?
#
# Where the belief says that one candidate has probability $p$ to be the arg-min on $B$, it should
# be right in a share $p$ of the cases.

# %%
stated = paths[paths["right"].notna() & paths["max_p"].notna() & (paths["arm"] != "random")]
bins = pd.cut(stated["max_p"], [0, 0.2, 0.4, 0.6, 0.8, 1.0])
curve = stated.groupby(bins, observed=True).agg(
    stated=("max_p", "mean"), right=("right", "mean"), cases=("right", "size")
)
figure, axis = plt.subplots(figsize=(4.2, 4))
axis.plot([0, 1], [0, 1], "k--", linewidth=1, label="calibrated")
axis.plot(curve["stated"], curve["right"].astype(float), "o-", label="measured")
for row in curve.itertuples():
    axis.annotate(f"{row.cases}", (row.stated, float(row.right)), xytext=(6, -10),
                  textcoords="offset points", fontsize="small")  # fmt: skip
axis.set(xlabel="stated max P", ylabel="share that is right", xlim=(0, 1.02), ylim=(0, 1.05))
legend = axis.legend(loc="upper left")

# %% [markdown]
# ## And the machine?
#
# $P_\text{boot}$ says what these recordings tell about the plant. Its 95 % intervals should hold
# the plant's parameters; where the model lacks physics they cannot, and where $B$ is a sparse
# design they are coarse.

# %%
own = ends[(ends["arm"] == "argmin-entropy") & (ends["uncertain"] > 0)]
covered = own.groupby("problem", sort=False)[["covered", "uncertain"]].sum()
covered.assign(share=covered["covered"] / covered["uncertain"]).round(2)

# %%
assert np.isfinite(summary["evaluations"]).all()
assert (paths["regret"] >= -1e-9).all()
