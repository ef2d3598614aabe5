# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # The inner loop, on a pendulum
#
# A motor swings a pendulum. The rod is heavier than the model says and its bearing is rougher. We
# have recordings, and a discrete set $B$ of candidates $\beta = (\text{mass}, \text{damping})$.
#
# For each candidate the deviation $\Delta(\beta)$ says how far the model predicts from what was
# recorded. A Gaussian process over a power of $\Delta$ (log, root or as it is) gives $P(\beta)$,
# the probability that $\beta$ is the arg-min of $\Delta$ over $B$. Here the next candidate is the
# one that contributes most to the entropy of that distribution,
# $\arg\max_\beta -P(\beta)\log P(\beta)$; `bo-sysid identify` takes max-value entropy unless the
# study says otherwise.
#
# This notebook shows no run and reads no file: machine, recordings and search are made here, with
# so many evaluations on so many values of each parameter.

# %%
BUDGET = 30
STEPS = 31

# %%
import matplotlib.pyplot as plt
import numpy as np

from bo_sysid.belief.bootstrap import bootstrap_argmin
from bo_sysid.belief.stopping import StopRule
from bo_sysid.deviation import Deviation, Whitening
from bo_sysid.identify.search import History, Rules, search, update_belief
from bo_sysid.mjcf import Model, parameter_edits
from bo_sysid.parameters import CandidateSet, Parameter
from bo_sysid.plants.excitation import smooth_random
from bo_sysid.plants.plant import Plant
from bo_sysid.simulation import Engine, MujocoSimulator, cut

# %% [markdown]
# ## The model and the machine
#
# The machine is simulated, with four times the model's steps and noisy sensors.

# %%
MODEL = Model.from_xml(
    """
<mujoco>
  <option timestep="0.004"/>
  <worldbody><body name="rod">
    <joint name="hinge" axis="0 1 0" damping="0.05"/>
    <geom name="rod" type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass=".5"/>
  </body></worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>""",
    name="pendulum",
)
PARAMETERS = (
    Parameter("mass", ("geom[rod].mass",), 0.4, 0.8, STEPS, unit="kg"),
    Parameter("damping", ("joint[hinge].damping",), 0.0, 0.1, STEPS, unit="N m s/rad"),
)
TRUTH = np.array([0.613, 0.037])

machine = Plant(
    MODEL,
    parameter_edits(MODEL, PARAMETERS, TRUTH),
    timestep=0.001,
    noise={"qpos": 0.001, "qvel": 0.01},
)
controls = smooth_random(MODEL.compile(), 10.0, machine.control_timestep, correlation=0.3)
recording = machine.record(controls)
recording.to_frame().iloc[:3]

# %% [markdown]
# ## The deviation
#
# The recording is cut into windows of ten samples, and the model predicts each window from its
# recorded start. Here $B$ is small enough to compute $\Delta$ everywhere, so that we can look at
# what the search cannot see.

# %%
candidates = CandidateSet.from_grid(PARAMETERS)
windows = cut(MODEL, [recording], horizon=10)
simulator = MujocoSimulator(MODEL, PARAMETERS, Engine())
deviation = Deviation(simulator, windows, Whitening.of(windows, {"qpos": 0.001, "qvel": 0.01}))
table = deviation(candidates.points)
target = int(table.deviation.argmin())


def on_grid(values: np.ndarray) -> np.ndarray:
    return values.reshape(STEPS, STEPS).T


figure, axis = plt.subplots(figsize=(5.5, 4))
ends = np.array([p.grid[[0, -1]] for p in PARAMETERS])
half = np.diff(ends) / (STEPS - 1) / 2
extent = np.ravel(ends + half * [-1, 1])  # a candidate is in the middle of its cell
picture = axis.imshow(
    on_grid(table.deviation), origin="lower", extent=extent, aspect="auto", cmap="viridis"
)
figure.colorbar(picture, label="Δ [sensor sigma]")
axis.plot(*TRUTH, "r*", markersize=12, label="the machine")
axis.set(xlabel="mass [kg]", ylabel="damping [N m s/rad]", title="Δ on the whole of B")
legend = axis.legend()

# %% [markdown]
# ## Ask, simulate, tell

# %%
steps: list[History] = []
outcome = search(
    candidates,
    lambda row: deviation(candidates.points[[row]]),
    Rules("argmin-entropy", StopRule(BUDGET), seed=0),
    History.empty(len(deviation.blocks.weight)),
    steps.append,
)
print(outcome.reason.sentence)
print(f"{len(outcome.history)} of {len(candidates)} candidates were tried")

# %%
shown = np.unique(np.linspace(6, len(outcome.history), 4).astype(int))
figure, axes = plt.subplots(1, len(shown), figsize=(3 * len(shown), 3), sharey=True)
for axis, count in zip(np.atleast_1d(axes), shown, strict=True):
    history = next(h for h in steps if len(h) == count)
    _, belief = update_belief(
        candidates, history, Rules("argmin-entropy", StopRule(BUDGET), seed=0)
    )
    axis.imshow(
        on_grid(belief.probabilities), origin="lower", extent=extent, aspect="auto", cmap="magma"
    )
    axis.plot(*candidates.points[history.rows].T, "wo", markersize=5, markerfacecolor="none")
    axis.plot(*TRUTH, "c*", markersize=10)
    axis.set(title=f"P after {count} evaluations", xlabel="mass [kg]")

# %% [markdown]
# ## What the search knows, and what the recordings say
#
# $P$ says where the minimum of $\Delta$ on *these* recordings lies, and shrinks to a point as
# candidates are tried. $P_\text{boot}$ is the arg-min over bootstraps of the recordings: what they
# say about the machine.

# %%
blocks = deviation.blocks
bootstrap = bootstrap_argmin(
    outcome.surrogate,
    candidates.points,
    outcome.history.rows,
    outcome.history.evaluation.contributions,
    blocks.weight,
    groups=blocks.session,
)
figure, axes = plt.subplots(1, 2, figsize=(8, 3))
for k, (axis, parameter) in enumerate(zip(axes, PARAMETERS, strict=True)):
    for p, label, width in (
        (bootstrap.probabilities, "P_boot", 0.9),
        (outcome.belief.probabilities, "P", 0.4),
    ):
        mass = [p[candidates.points[:, k] == v].sum() for v in parameter.grid]
        axis.bar(parameter.grid, mass, width=width * np.diff(parameter.grid)[0], label=label)
    axis.axvline(TRUTH[k], color="k", linestyle="--", label="the machine")
    axis.set_xlabel(f"{parameter.name} [{parameter.unit}]")
legend = axes[0].legend()

# %%
assert outcome.belief.probabilities[target] >= np.sort(outcome.belief.probabilities)[-3]
