"""Simulators: parameter vectors and windows in, predictions at the recorded instants out."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from bo_sysid.arrays import Points
from bo_sysid.mjcf import Edit, Loops, Model, parameter_edits
from bo_sysid.parameters import Parameter
from bo_sysid.simulation.activations import activations_of
from bo_sysid.simulation.bristles import bristle_motors, with_loaded_bristles
from bo_sysid.simulation.lockstep import Controller, ForceLaw
from bo_sysid.simulation.rollout import Engine
from bo_sysid.simulation.state import State
from bo_sysid.simulation.windows import Layout, Windows, predicted

MEMORY = 256 * 2**20  # bytes that the trajectories of one call may take
_TOGETHER = 4096  # simulations that one call should have, where there are candidates enough


@dataclass(frozen=True)
class Prediction:
    """What one candidate predicts.

    Attributes:
        values: `W x H x c`, in the order of the windows' channels.
        diverged: `W` flags of simulations that diverged; their values are finite but meaningless.
    """

    values: Float[np.ndarray, "W H c"]
    diverged: Bool[np.ndarray, " W"]


@runtime_checkable
class Simulator(Protocol):
    """Anything that predicts what candidates would have done."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The d parameters, in the order of the columns of `points`."""

    def predictions(
        self, points: Points, windows: Windows, starts: Sequence[State] | None = None
    ) -> Iterator[Prediction]:
        """Yield the prediction of each of the `C x d` points, in order.

        Args:
            points: parameter vectors.
            windows: `W` windows.
            starts: for each point its own `W` starts; by default the windows'.
        """

    def moved(self, start: State, tangent: Float[np.ndarray, "W n"]) -> State:
        """Return starts moved by `W x 2 nv` changes of position and velocity."""

    @property
    def following(self) -> Int[np.ndarray, " k"]:
        """Columns of `qvel` of joints that follow others through closed chains."""


@dataclass(frozen=True)
class MujocoSimulator:
    """A model whose parameters are set by editing its MJCF.

    Attributes:
        model: the model.
        parameters: what is uncertain in it.
        engine: runs the simulations.
        laws: controllers and force laws stepped with the simulation.
        timestep: of the simulation in [s]; None for the model's.
        memory: bytes that the trajectories of one call may take; longer work is cut in pieces.
    """

    model: Model
    parameters: tuple[Parameter, ...]
    engine: Engine
    laws: tuple[Controller | ForceLaw, ...] = ()
    timestep: float | None = None
    memory: int = MEMORY

    def compile(self, point: Float[np.ndarray, " d"]) -> mujoco.MjModel:
        """Return the compiled model with the parameters at `point`."""
        edits: Sequence[Edit] = parameter_edits(self.model, self.parameters, point)
        return self.model.compile(edits, timestep=self.timestep)

    def predictions(
        self, points: Points, windows: Windows, starts: Sequence[State] | None = None
    ) -> Iterator[Prediction]:
        """Yield the prediction of each point; many small ones are simulated in one call."""
        layout = self._layout
        size = self._windows_per_call(windows)
        together = max(min(size, _TOGETHER) // len(windows), 1)
        for first in range(0, len(points), together):
            group = points[first : first + together]
            models = [self.compile(p) for p in group]
            given = None if starts is None else starts[first : first + together]
            if len(windows) <= size:
                yield from self._group(layout, models, windows, given)
            else:
                yield self._pieces(layout, models[0], windows, given, size)

    def moved(self, start: State, tangent: Float[np.ndarray, "W n"]) -> State:
        """Return starts moved along the tangent space of the joints, loops closed."""
        return start.moved(self._structure, tangent).closed(self._loops)

    @property
    def following(self) -> Int[np.ndarray, " k"]:
        """Columns of `qvel` of joints that follow others through closed chains."""
        return self._loops.dofs

    @cached_property
    def _structure(self) -> mujoco.MjModel:
        return self.model.compile()

    @cached_property
    def _loops(self) -> Loops:
        return self.model.loops

    @cached_property
    def _layout(self) -> Layout:
        return Layout.of(self.model, self._structure)

    def _windows_per_call(self, windows: Windows) -> int:
        state = sum(a.shape[1] for a in (windows.start.qpos, windows.start.qvel, windows.start.act))
        inputs = windows.ctrl.shape[2] + len(windows.signals)
        sensed = self._structure.nsensordata if self._layout.sensor else 0
        row = 8 * (windows.steps + 1) * (2 * state + 2 * inputs + sensed)
        return max(self.memory // max(int(row), 1), 1)

    def _pieces(
        self,
        layout: Layout,
        model: mujoco.MjModel,
        windows: Windows,
        starts: Sequence[State] | None,
        size: int,
    ) -> Prediction:
        parts = []
        for first in range(0, len(windows), size):
            rows = slice(first, first + size)
            given = None if starts is None else [starts[0].rows(rows)]
            parts.extend(self._group(layout, [model], windows.rows(rows), given))
        return Prediction(
            np.concatenate([p.values for p in parts]), np.concatenate([p.diverged for p in parts])
        )

    def _group(
        self,
        layout: Layout,
        models: Sequence[mujoco.MjModel],
        windows: Windows,
        starts: Sequence[State] | None,
    ) -> list[Prediction]:
        """Simulate `len(models)` candidates at once and split their predictions."""
        count, times = len(windows), len(models)
        start = windows.start.repeat(times) if starts is None else State.concatenated(starts)
        if windows.sources:
            start = replace(start, act=self._activations(models, windows))
        start = _with_loaded_bristles(models, start, windows)
        run = models[0] if times == 1 else [m for m in models for _ in range(count)]
        if self._one_shot(windows, layout):
            return self._final(layout, run, start, windows, times)
        trajectory = self.engine.rollout(
            run,
            start,
            np.tile(windows.ctrl, (times, 1, 1)),
            laws=self.laws,
            signals={n: np.tile(s, (times, 1)) for n, s in windows.signals.items()},
            sensors=any(n in layout.sensor for n in windows.channels),
        )
        out = []
        for k in range(times):
            part = trajectory.rows(slice(k * count, (k + 1) * count))
            out.append(Prediction(predicted(layout, windows, part), part.diverged))
        return out

    def _activations(
        self, models: Sequence[mujoco.MjModel], windows: Windows
    ) -> Float[np.ndarray, "MW na"]:
        """Return the activations with which each candidate begins, one after another."""
        own = [
            activations_of(self.model, m, windows.sources, windows, windows.ctrl) for m in models
        ]
        return np.concatenate(own)

    def _one_shot(self, windows: Windows, layout: Layout) -> bool:
        """Whether only the last state is observed, under constant controls and no law.

        Channels that show a joint besides their own are read from the trajectory.
        """
        return (
            not any(n in layout.also for n in windows.channels)
            and windows.step.shape[1] == 1
            and windows.aligned
            and int(windows.step[0, 0]) == windows.steps
            and not self.laws
            and not any(n in layout.sensor for n in windows.channels)
            and (windows.steps == 1 or bool((windows.ctrl == windows.ctrl[:, :1]).all()))
        )

    def _final(
        self,
        layout: Layout,
        models: mujoco.MjModel | Sequence[mujoco.MjModel],
        start: State,
        windows: Windows,
        times: int,
    ) -> list[Prediction]:
        ctrl = np.tile(windows.ctrl[:, 0], (times, 1))
        states, diverged = self.engine.final(models, start, ctrl, windows.steps)
        nq = start.qpos.shape[1]
        columns = [
            layout.qpos[n] if n in layout.qpos else nq + layout.qvel[n] for n in windows.channels
        ]
        values = states[:, columns].reshape(times, len(windows), 1, len(columns))
        flags = diverged.reshape(times, len(windows))
        return [Prediction(v, f) for v, f in zip(values, flags, strict=True)]


def _with_loaded_bristles(
    models: Sequence[mujoco.MjModel], start: State, windows: Windows
) -> State:
    """Return the starts of each candidate, one after another, its bristles bent by their loads."""
    if not bristle_motors(models[0]).size:
        return start
    count, first = len(windows), windows.ctrl[:, 0]
    return State.concatenated(
        [
            with_loaded_bristles(m, start.rows(slice(k * count, (k + 1) * count)), first)
            for k, m in enumerate(models)
        ]
    )
