"""What the simulation itself adds: its time step, and whether anything touches."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pandas as pd

from bo_sysid.arrays import Point
from bo_sysid.checks.flags import Flag, Level
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.recording import Recording
from bo_sysid.simulation import MujocoSimulator, Windows

_WORTH = 1.0  # standard deviations that a step may cost
_TWICE = 1.5  # from which a ratio is told as a number
_MOSTLY = 0.5  # of the windows that diverge, from which nothing can be fitted
_FAR = 100.0  # standard deviations
_INSTANTS = 400
_ALWAYS, _OFTEN = 0.95, 0.2  # of the recordings
_GROUND = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))


def step_effect(
    simulator: MujocoSimulator, point: Point, coarse: Windows, fine: Windows
) -> pd.DataFrame:
    """Return how much predictions change with half the step, and how far off they are.

    Args:
        simulator: at the model's step.
        point: the parameter values.
        coarse: windows cut for the model's step.
        fine: the same windows cut for half of it.

    Returns:
        One row a channel: channel, change and left (root mean squares over the windows in which
        neither diverges, in the channel's unit), and diverged, the share of the windows in which
        the model does at its own step.
    """
    half = replace(simulator, timestep=fine.timestep)
    a = next(iter(simulator.predictions(point[None], coarse)))
    b = next(iter(half.predictions(point[None], fine)))
    good = ~(a.diverged | b.diverged)

    def rms(difference: np.ndarray) -> np.ndarray:
        if not good.any():
            return np.full(len(coarse.channels), np.nan)
        seen = np.where(np.isfinite(coarse.observed), difference, np.nan)[good]
        return np.asarray(np.sqrt(np.nanmean(seen**2, axis=(0, 1))))

    change, left = rms(a.values - b.values), rms(coarse.residual(a.values))
    share = float(a.diverged.mean())
    return pd.DataFrame(
        {"channel": coarse.channels, "change": change, "left": left, "diverged": share}
    )


def divergence_flags(table: pd.DataFrame, timestep: float) -> list[Flag]:
    """Return a flag where the model diverges from recorded states."""
    share = float(table["diverged"].max())
    if not share > 0:
        return []
    sentence = (
        f"The model as it is diverges in {max(100 * share, 1):.0f} % of the windows of 0.3 s that "
        f"begin at recorded states, at its step of {1e3 * timestep:g} ms; these say nothing of "
        "parameters. "
        'A smaller timestep or integrator="implicitfast" in the model\'s <option> helps where '
        "gains, stiffness or damping are large for the step; otherwise masses or units are wrong."
    )
    level: Level = "wrong" if share > _MOSTLY else "look"
    return [Flag(level, "divergence", (), sentence, {"share": share})]


def step_flags(table: pd.DataFrame, noise: dict[str, float], timestep: float) -> list[Flag]:
    """Return a flag where half the step changes predictions by more than the noise."""
    worst, ratio = _worst(table, "change", noise)
    if ratio < _WORTH:
        return []
    times = "about" if ratio < _TWICE else f"{ratio:.2g} times"
    return [
        Flag(
            "look",
            "step",
            (worst,),
            f"Half the model's step of {1e3 * timestep:g} ms changes the prediction of {worst} by "
            f"{times} what can be told apart: too coarse for small effects. A smaller timestep in "
            "the model's <option> is what helps; diagnose takes one by itself.",
            {"ratio": ratio},
        )
    ]


def far_flags(table: pd.DataFrame, noise: dict[str, float]) -> list[Flag]:
    """Return a flag where the model is so far off that its sensitivities are another machine's."""
    worst, ratio = _worst(table, "left", noise)
    if ratio < _FAR:
        return []
    sentence = (
        f"The model as it is misses {worst} by {ratio:,.0f} standard deviations of its noise "
        "within 0.3 s: what is said here of parameters and of the time step is of that model, and "
        "changes with it. Check the study of the identified model again."
    )
    return [Flag("look", "far", (worst,), sentence, {"ratio": ratio})]


def _worst(table: pd.DataFrame, column: str, noise: dict[str, float]) -> tuple[str, float]:
    """Return the position in which a column of `step_effect` is largest, over its noise."""
    ratio = {
        n: float(c / noise[n]) for n, c in zip(table["channel"], table[column], strict=True)
        if n.startswith("qpos.") and noise.get(n) and np.isfinite(c)
    }  # fmt: skip
    worst = max(ratio, key=ratio.__getitem__, default="")
    return worst, ratio.get(worst, 0.0)


def contact_flags(model: mujoco.MjModel, recordings: Sequence[Recording]) -> list[Flag]:
    """Return which geoms touch along the recorded positions, and for how much of the time."""
    if model.ngeom < 2:
        return []
    data = mujoco.MjData(model)
    names = [model.joint(j).name for j in range(model.njnt)]
    if not np.isin(model.jnt_type, SCALAR).all():
        return _floating(model)
    touched: dict[tuple[int, int], int] = {}
    count = 0
    for r in recordings:
        first, last = r.span
        mujoco.mj_resetData(model, data)
        for t in np.linspace(first, last, max(_INSTANTS // len(recordings), 10)):
            for j, name in enumerate(names):
                channel = r.channels.get(f"qpos.{name}")
                if channel is not None:
                    value = np.interp(t, channel.time, channel.values)
                    data.qpos[model.jnt_qposadr[j]] = value
            mujoco.mj_fwdPosition(model, data)
            count += 1
            for pair in {_pair(data, c) for c in range(data.ncon)}:
                touched[pair] = touched.get(pair, 0) + 1
    most = sorted(touched.items(), key=lambda item: -item[1])[:5]
    return [_touching(model, pair, n / count) for pair, n in most]


def _touching(model: mujoco.MjModel, geoms: tuple[int, int], share: float) -> Flag:
    """Return how long two geoms touch; where they hardly can on the machine, what to do about it.

    Those of two moving bodies that touch often rub and push in the simulation. Those that a joint
    joins and that always touch overlap: MuJoCo leaves out contact between a body and its parent,
    but not where that is fixed to the world.
    """
    names = sorted(model.geom(g).name or f"geom_{g}" for g in geoms)
    sentence = f"{names[0]} touches {names[1]} during {100 * share:.0f} % of the recordings."
    bodies = [int(model.body_weldid[model.geom_bodyid[g]]) for g in geoms]
    parents = [int(model.body_weldid[model.body_parentid[b]]) for b in bodies]
    joined = share >= _ALWAYS and (bodies[0] == parents[1] or bodies[1] == parents[0])
    if not joined and (share < _OFTEN or 0 in bodies):
        return Flag("note", "contact", tuple(names), sentence, {"share": share})
    first, second = (model.body(int(model.geom_bodyid[g])).name or "world" for g in geoms)
    leave_out = (
        f'out of contact (MJCF: <contact><exclude body1="{first}" body2="{second}"/></contact>, or '
        'contype="0" conaffinity="0").'
    )
    if not joined:
        more = f" Where {first} and {second} do not touch on the machine, leave them {leave_out}"
        return Flag("look", "contact", tuple(names), sentence + more, {"share": share})
    more = (
        f" A joint joins their bodies, {first} and {second}: geoms that overlap there rub and push "
        f"in the simulation as they do in no machine. Leave them {leave_out}"
    )
    if any(int(model.geom_type[g]) in _GROUND for g in geoms):
        more = (
            " Where the machine drives or walks on it, its base must be free, with its pose "
            f"recorded, or unrecorded: {{<joint>: null}} under the model. Else:{more}"
        )
    return Flag("look", "contact", tuple(names), sentence + more, {"share": share})


def _floating(model: mujoco.MjModel) -> list[Flag]:
    if not can_touch(model):
        return []
    sentence = "The model floats and can touch: windows with contact tell less about it."
    return [Flag("note", "contact", (), sentence)]


def _pair(data: mujoco.MjData, contact: int) -> tuple[int, int]:
    first, second = sorted(int(g) for g in data.contact[contact].geom)
    return first, second
