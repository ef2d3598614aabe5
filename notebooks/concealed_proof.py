# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # The concealed proof: what was hidden, what was found
#
# `bo-sysid conceal` draws machines that lack physics and seals what it is; `bo-sysid reveal`
# diagnoses them, opens the seals and scores. This notebook reads the two tables of a revealed run:
# `RUN` says which. Where the project has none yet, three small cases are concealed and answered
# first (a minute or two).

# %%
RUN = None  # the project's runs/proof-conceal; or a folder of your own: "../runs/proof"
CASES = 3  # where there is none

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from bo_sysid.proof.conceal import conceal, suite_record
from bo_sysid.proof.proof import prove
from bo_sysid.proof.score import Scores
from bo_sysid.proof.statistics import clopper_pearson
from bo_sysid.runs import Run

# %%
if RUN is None:
    above = (Path.cwd(), *Path.cwd().parents)
    ROOT = next((p for p in above if (p / "studies" / "concealed").is_dir()), None)
    if ROOT is None:
        raise FileNotFoundError(
            f"{Path.cwd()} is in no copy of the project (no studies/concealed above it): start "
            "Jupyter in one, or name a run of bo-sysid conceal in RUN"
        )
    run_folder = ROOT / "runs" / "proof-conceal"
else:
    run_folder = Path(RUN).resolve()
    if not (run_folder / "cases.parquet").is_file():
        raise FileNotFoundError(
            f"RUN: {run_folder} is no revealed run of bo-sysid conceal; it has no cases.parquet"
        )

# %%
if not (run_folder / "cases.parquet").is_file():
    suite = ROOT / "studies" / "concealed" / "quick.yaml"
    few = {"cases": CASES}
    run_folder = Path(tempfile.mkdtemp()) / "proof"
    with Run.open(run_folder, suite_record(suite, few), "conceal") as run:
        conceal(run, suite, overrides=few)
        prove(run)

cases = pd.read_parquet(run_folder / "cases.parquet")
effects = pd.read_parquet(run_folder / "effects.parquet")
shown = ["tier", "machine", "missing", "detected", "right", "flagged", "probability", "seconds"]
cases[shown].head(8)

# %% [markdown]
# ## Right, cannot tell, wrong
#
# A case is right where names and sites are those that were concealed, members of one equivalence
# class counted as one. Where nothing is concealed, saying so is right. No answer is never right.

# %%
rows = []
for tier, part in cases.groupby("tier"):
    for label, some in (("missing", part[part["missing"]]), ("nothing", part[~part["missing"]])):
        if len(some):
            good = some["right"]
            low, high = clopper_pearson(int(good.sum()), len(good))
            rows.append((f"tier {tier}, {label}", len(good), good.mean(), low, high))
rates = pd.DataFrame(rows, columns=["cases", "n", "right", "low", "high"])
figure, axis = plt.subplots(figsize=(5.5, 0.5 * len(rates) + 1))
error = np.array([rates["right"] - rates["low"], rates["high"] - rates["right"]])
axis.errorbar(rates["right"], np.arange(len(rates)), xerr=error, fmt="o", capsize=3)
labels = [f"{row.cases} (n = {row.n})" for row in rates.itertuples()]
axis.set_yticks(np.arange(len(rates)), labels)
axis.set(xlim=(-0.02, 1.02), xlabel="share that is right, 95 % interval")
axis.set_ylim(len(rates) - 0.5, -0.5)

# %% [markdown]
# ## Does the size decide?
#
# Sizes are in sensor sigmas that an effect leaves in a window after everything else was refitted.
# What is below two cannot be told from the noise, and is not asked for. What the catalogue does not
# have is left out, since no name is right for it.

# %%
nameable = effects[effects["known"]]
figure, axis = plt.subplots(figsize=(6, 3))
for k, (_, part) in enumerate(nameable.groupby("effect")):
    found = part["found"].to_numpy(bool)
    axis.plot(part["size"][found], np.full(found.sum(), k), "o", color="tab:blue")
    axis.plot(part["size"][~found], np.full((~found).sum(), k), "x", color="tab:red")
axis.set_yticks(range(nameable["effect"].nunique()), sorted(nameable["effect"].unique()))
axis.set(xscale="log", xlabel="size [sensor sigma]", title="found (o) and not found (x)")
axis.axvline(2, color="k", linestyle=":", linewidth=1)

# %% [markdown]
# ## Magnitudes
#
# Relative error of the magnitudes that were found, and how often the 95 % interval holds the truth.

# %%
found = effects[effects["found"]]
pd.DataFrame(
    {
        "found": found.groupby("effect").size(),
        "median relative error": found.groupby("effect")["error"].median(),
        "covered": found.groupby("effect")["covered"].mean(),
    }
).round(3)

# %% [markdown]
# ## Are the probabilities true, and do the repaired models predict?
#
# Left: stated probability against how often it was right, of all answers that state one. Right:
# error of forecasts on recordings that no diagnosis saw, over the noise floor; the oracle knows
# what was concealed.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
told = Scores.of(cases, effects).calibration
left.plot([0, 1], [0, 1], "k--", linewidth=1)
left.plot(told.bins["stated"], told.bins["right"], "o-")
left.set(xlabel="stated probability", ylabel="share that is right", xlim=(0, 1.05), ylim=(0, 1.05))
models = ["nominal", "refitted", "repaired", "oracle"]
over = cases[cases["missing"]]
ratios = [(over[m] / over["noise_floor"]).dropna().to_numpy(float) for m in models]
right.boxplot([r if len(r) else [np.nan] for r in ratios], tick_labels=models)
right.set(yscale="log", ylabel="forecast error / noise floor")
right.axhline(1, color="k", linestyle=":", linewidth=1)
figure.tight_layout()

# %%
assert len(cases)
assert set(effects.index) <= set(cases.index)
