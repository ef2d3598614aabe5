# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A real machine, from its raw file to a repaired model
#
# EMPS: a motor moves a load along a ball screw; the command of the drive and the load's position
# were recorded. The model is a bare mass. The authors' files are read from `$BO_SYSID_DATA`, or
# downloaded once and checked; without either the notebook says where to get them. `RUN` says which
# run is shown, one that is made here or a finished one.

# %%
RUN = None  # made here; or that of bo-sysid diagnose studies/real/emps_bare.yaml: "../runs/emps"
EFFECTS = "all"  # the whole catalogue takes some minutes

# %%
# %matplotlib inline
import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

from bo_sysid import Study, diagnose
from bo_sysid.checks.check import check
from bo_sysid.recording.datasets import load_dataset
from bo_sysid.report import diagnosis_figures, interactive
from bo_sysid.runs import Run

# %%
above = (Path.cwd(), *Path.cwd().parents)
ROOT = next((p for p in above if (p / "studies" / "real").is_dir()), None)
if ROOT is None:
    raise FileNotFoundError(
        f"{Path.cwd()} is in no copy of the project (no studies/real above it): start Jupyter in "
        "one, where the study and its model are"
    )
if RUN is not None:
    run_folder = Path(RUN).resolve()
    if not (run_folder / "summary.json").is_file():
        raise FileNotFoundError(
            f"RUN: {run_folder} is no finished run of bo-sysid diagnose; it has no summary.json"
        )
data = load_dataset("emps")
recording = data.train[0]
frame = recording.to_frame()
frame.describe().loc[["count", "mean", "std", "min", "max"]]

# %% [markdown]
# ## What was recorded

# %%
figure, axes = plt.subplots(2, 1, figsize=(8, 4), sharex=True)
for axis, name in zip(axes, ("qpos.x", "ctrl.vir"), strict=True):
    channel = recording.channels[name]
    axis.plot(channel.time, channel.values, linewidth=0.8)
    axis.set_ylabel(f"{name} [{channel.unit}]")
axes[-1].set_xlabel("time [s]")

# %% [markdown]
# ## Before anything is fitted
#
# `check` looks at signs, units, clocks and excitation, and says what these recordings can tell
# about each parameter at best.

# %%
study = Study.load(ROOT / "studies" / "real" / "emps_bare.yaml", {"diagnosis.effects": EFFECTS})
checked = check(study)
checked.parameters

# %% [markdown]
# ## What does a bare mass lack?
#
# The answer is made from the estimation file alone, written and hashed; then the other file, with
# its force pulses, is read once.

# %%
if RUN is None:
    run_folder = Path(tempfile.mkdtemp()) / "emps"
    with Run.open(run_folder, study.resolved(relative_to=run_folder), "diagnose") as run:
        diagnose(study, run)
for sentence in json.loads((run_folder / "summary.json").read_text())["sentences"]:
    print(sentence)

# %%
found = json.loads((run_folder / "diagnosis.json").read_text())["findings"]
pd.DataFrame(found, columns=["effect", "site", "value", "unit", "interval", "probability"])

# %% [markdown]
# The published values are 203.5 N s/m of viscous damping, 20.39 N of dry friction and a constant
# force of 3.16 N.

# %% [markdown]
# ## What would have to be added to the model's forces
#
# Computed before any name is given: a step at zero speed, a slope, and an offset.

# %%
diagnosis_figures.forces(pd.read_parquet(run_folder / "forces.parquet"))

# %% [markdown]
# ## Does the repaired model predict what it has never seen?

# %%
pd.read_parquet(run_folder / "holdout.parquet")

# %%
traces = pd.read_parquet(run_folder / "traces.parquet")
interactive.held_out(traces, traces["channel"].iloc[0], "m")

# %% [markdown]
# `model_repaired.xml` is plain MJCF, and `study_repaired.yaml` has the findings' magnitudes as
# parameters: `identify` and `learn` run on it.

# %%
print((run_folder / "model_repaired.xml").read_text())

# %%
names = {finding["effect"] for finding in found}
assert {"viscous_damping", "dry_friction"} <= names
