r"""Many trajectories of controls judged at once: what they tell, and which limits they exceed.

For the search only: the simulation's step is as coarse as the controls', unless the machine is too
stiff for that, differences are one-sided, all candidates share two roll-outs. `checks.sensitivity`
says the same for the plan that is chosen.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.excite.limits import Limits
from bo_sysid.execution import threads
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.edits import parameter_edits
from bo_sysid.parameters import Parameter
from bo_sysid.simulation import Engine, ForceLaw, State

_STEP = 1e-3  # of a parameter's range
_MOVE = (1e-6, 1e-4)  # of positions in [rad] or [m], of velocities
COARSEST = 0.01
"""Longest simulation step, in s."""
_PRIOR = 12.0  # information of a uniform prior over a range
_MEMORY = 2**26  # bytes of trajectories at once


def coarse(
    model: Model, parameters: Sequence[Parameter], point: Float[np.ndarray, " d"], step: float
) -> mujoco.MjModel:
    """Return a machine that is simulated by coarse steps, in [s].

    Damping of servos is then implicit, too: by Euler's steps they would diverge.
    """
    made = model.compile(parameter_edits(model, parameters, point), timestep=step)
    if made.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        made.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return made


@dataclass(frozen=True)
class Judgement:
    """Of K trajectories.

    Attributes:
        sigma: `K x d` least standard deviations in units of the parameters' ranges.
        over: `K`, by how much the worst limit is exceeded by the worst machine.
    """

    sigma: Float[np.ndarray, "K d"]
    over: Float[np.ndarray, " K"]


class Judge:
    """Simulates K trajectories of controls for several machines, and windows of the first.

    Args:
        model: the model.
        parameters: what is to be known.
        point: the nominal machine, whose recording tells.
        machines: `M x d` that keep the limits; the nominal one comes first.
        limits: what the machines bear.
        noise: standard deviation of each position, in its unit.
        interval: between two controls, and between two samples, in [s].
        steps: of the simulation in an interval.
        window: instants of a window, whose start is a nuisance.
        start: how all machines start, one row.
        laws: forces that are stepped with the model.
    """

    def __init__(
        self,
        model: Model,
        parameters: Sequence[Parameter],
        point: Float[np.ndarray, " d"],
        machines: Float[np.ndarray, "M d"],
        limits: Limits,
        noise: dict[str, float],
        *,
        interval: float,
        steps: int,
        window: int,
        start: State,
        laws: Sequence[ForceLaw],
    ) -> None:
        self._hold = steps
        self._window, self._limits, self._laws = window, limits, tuple(laws)
        self._start = start

        def compiled(point: np.ndarray) -> mujoco.MjModel:
            return coarse(model, parameters, point, interval / steps)

        low = np.array([p.low for p in parameters])
        width = np.array([p.high for p in parameters]) - low
        inside = np.clip(point, low + _STEP * width, low + (1 - _STEP) * width)
        self._nominal = compiled(inside)
        self._varied = [compiled(inside + row) for row in np.diag(_STEP * width)]
        self._machines = [compiled(p) for p in machines]
        self._weight = np.array([1.0 / noise[n] for n in model.qpos_channels])
        self._whole, self._pieces = Engine(threads()), Engine(threads())

    def __call__(
        self, controls: Float[np.ndarray, "K R nu"], margin: float, *, information: bool = True
    ) -> Judgement:
        """Return what the controls tell and exceed, each held for one interval.

        Args:
            controls: of the K trajectories.
            margin: share of each limit that may be used.
            information: whether to evaluate what they tell; else sigma is that of no recording.
        """
        width = 1 + len(self._varied) + 2 * self._nominal.nv
        rows = max(width, len(self._machines)) * controls.shape[1] * self._hold
        size = max(_MEMORY // (rows * 8 * 3 * (2 * self._nominal.nv + self._nominal.na)), 1)
        parts = [
            self._some(controls[k : k + size], margin, information)
            for k in range(0, len(controls), size)
        ]
        return Judgement(
            np.concatenate([p.sigma for p in parts]), np.concatenate([p.over for p in parts])
        )

    def _some(
        self, controls: Float[np.ndarray, "K R nu"], margin: float, information: bool
    ) -> Judgement:
        count, machines = len(controls), len(self._machines)
        models = self._machines * count
        ctrl = np.repeat(np.repeat(controls, self._hold, axis=1), machines, axis=0)
        start = self._start.repeat(len(ctrl))
        run = self._whole.rollout(models, start, ctrl, laws=self._laws)
        over = self._limits.violation(models, run, ctrl, margin).reshape(count, -1).max(axis=1)
        if not information:
            return Judgement(np.full((count, len(self._varied)), _PRIOR**-0.5), over)
        first = np.arange(0, controls.shape[1] - self._window, self._window)
        at = (slice(None, None, machines), first * self._hold)
        starts = State(
            *(x[at].reshape(count * len(first), x.shape[2]) for x in (run.qpos, run.qvel, run.act))
        )
        held = np.stack([controls[:, k : k + self._window] for k in first], axis=1)
        held = held.reshape(-1, *held.shape[2:]).repeat(self._hold, axis=1)
        fisher = self._fisher(starts, held).reshape(count, len(first), *2 * [len(self._varied)])
        prior = _PRIOR * np.eye(len(self._varied))
        variance = np.diagonal(np.linalg.inv(fisher.sum(axis=1) + prior), axis1=1, axis2=2)
        return Judgement(np.sqrt(variance), over)

    def _fisher(
        self, start: State, ctrl: Float[np.ndarray, "W S nu"]
    ) -> Float[np.ndarray, "W d d"]:
        """Return the information of each window, its start projected out."""
        count, nv, d = len(ctrl), self._nominal.nv, len(self._varied)
        runs = 1 + d + 2 * nv
        qpos, qvel = (np.tile(x, (runs, 1, 1)) for x in (start.qpos, start.qvel))
        for k in range(nv):
            qpos[1 + d + k, :, k] += _MOVE[0]
            qvel[1 + d + nv + k, :, k] += _MOVE[1]
        moved = State(qpos.reshape(-1, nv), qvel.reshape(-1, nv), np.tile(start.act, (runs, 1)))
        models = [self._nominal, *self._varied, *2 * nv * [self._nominal]]
        run = self._pieces.rollout(
            [m for m in models for _ in range(count)], moved, np.tile(ctrl, (runs, 1, 1)),
            laws=self._laws,
        )  # fmt: skip
        seen = (run.qpos[:, self._hold :: self._hold] * self._weight).reshape(runs, count, -1)
        change = np.moveaxis(seen[1:] - seen[0], 0, -1)
        effect, nuisance = change[..., :d] / _STEP, change[..., d:]
        length = np.linalg.norm(nuisance, axis=1, keepdims=True)
        q, _ = np.linalg.qr(nuisance / np.maximum(length, 1e-300))
        effect = effect - q @ (np.swapaxes(q, 1, 2) @ effect)
        effect[run.diverged.reshape(runs, count).any(axis=0)] = 0.0
        return np.asarray(np.swapaxes(effect, 1, 2) @ effect)


def largest(
    over: Callable[[Float[np.ndarray, " K"]], Float[np.ndarray, " K"]],
    highest: Float[np.ndarray, " K"],
    halvings: int,
) -> Float[np.ndarray, " K"]:
    """Return sizes that exceed nothing, by bisection of their logarithms down to a hundredth."""
    low, high = 0.01 * highest, highest.copy()
    for _ in range(halvings):
        middle = np.sqrt(low * high)
        kept = over(middle) <= 0
        low, high = np.where(kept, middle, low), np.where(kept, high, middle)
    return low
