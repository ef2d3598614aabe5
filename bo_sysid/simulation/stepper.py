"""Stepping one simulation in plain MuJoCo with what stands beside its model file."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np

from bo_sysid.effects import Filter, catalogue
from bo_sysid.effects.beside import read_beside
from bo_sysid.effects.learned import ELAPSED
from bo_sysid.errors import ModelError
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.commands import controlled
from bo_sysid.recording import Channel, control_steps
from bo_sysid.simulation.lockstep import LockStep, force_laws, live_arrays, steps_held

_MEMORY = 2.0  # [s] of commands that filters look back on
_ROUNDING = 1e-6  # of a step: stamps that are sums of steps are not exactly multiples of one


class Stepper:
    """Steps an `MjData` as `mj_step` does, with forces on joints and filters on its controls.

    Forces of the laws come on top of `data.qfrc_applied`, which stays as it was set; they are held
    as long as they were when they were learned. Filters that look back see what was in `data.ctrl`
    at the last steps. Forces that read recorded channels cannot be stepped here.

    Args:
        model: path of the model file.
        beside: path of the file beside it.
        effect_files: of the study, where effects of one's own are in the file beside.

    Attributes:
        model: the compiled model.
        data: the simulation.
    """

    def __init__(
        self, model: str | Path, beside: str | Path, effect_files: Iterable[str | Path] = ()
    ) -> None:
        source, effects = Model.from_file(Path(model)), catalogue(map(Path, effect_files))
        parts = read_beside(Path(beside), source.compile()).parts(source, effects)
        self.model: mujoco.MjModel = source.compile()
        self.data = mujoco.MjData(self.model)
        place = {self.model.actuator(a).name: i for i, a in enumerate(controlled(self.model))}
        self._filters: dict[int, list[Filter]] = {}  # of each control, in the order they act
        for p in parts:
            if isinstance(p, Filter):
                self._filters.setdefault(place[p.actuator], []).append(p)
        self._laws = force_laws(parts)
        self._time: list[float] = []
        self._past: list[np.ndarray] = []
        self._state: dict[tuple[int, int], float] = {}  # of a control's filters at the oldest
        self._made: dict[tuple[int, int], Channel] = {}  # what each filter made of it last
        self._step, self._every = 0, 1
        self._held: np.ndarray = np.zeros(self.model.nv)
        self._lockstep: LockStep | None = None

    def step(self) -> None:
        """Advance the simulation by one time step."""
        m, d = self.model, self.data
        if self._lockstep is None or (self._time and d.time <= self._time[-1]):
            self._restart()
        commanded, applied = d.ctrl.copy(), d.qfrc_applied.copy()
        self._remember(commanded)
        for i, filters in self._filters.items():
            values = np.array([c[i] for c in self._past])
            channel = Channel(np.array(self._time), values, "", "", "zero")
            for k, f in enumerate(filters):
                if (i, k) in self._state:  # it was there one step before the oldest
                    before = channel.time[0] - m.opt.timestep
                    time = np.concatenate([[before], channel.time])
                    begun = np.concatenate([[self._state[i, k]], channel.values])
                    channel = replace(channel, time=time, values=begun)
                channel = self._made[i, k] = f.change(channel, m.opt.timestep)
            # as in the search: a change that comes within a step counts for its part of it
            d.ctrl[i] = control_steps(channel, np.array([d.time]), 1, m.opt.timestep)[0, 0]
        d.qfrc_applied[:] = applied + self._forces()
        mujoco.mj_step(m, d)
        d.ctrl[:], d.qfrc_applied[:] = commanded, applied

    def _forces(self) -> np.ndarray:
        """Return the forces of the laws, evaluated anew where they are not held."""
        assert self._lockstep is not None  # noqa: S101 - made by the first step
        if self._step % self._every == 0:
            self._signals[ELAPSED][0, 0] = self.data.time
            try:
                self._lockstep.apply(self._step, column=0)
            except KeyError as channel:
                raise ModelError(
                    f"a force reads {channel}, which is recorded: it cannot be stepped on"
                ) from None
            self._held = self.data.qfrc_applied.copy()
        self._step += 1
        return self._held

    def _restart(self) -> None:
        """Forget the past: the simulation was reset."""
        d = self.data
        views = live_arrays(self.model, lambda name: getattr(d, name)[None])
        self._signals = {ELAPSED: np.zeros((1, 1))}
        self._every = steps_held(self._laws, self.model.opt.timestep)
        self._lockstep = LockStep(self.model, self._laws, self._signals, views, None, self._every)
        self._time, self._past = [], []
        self._state, self._made = {}, {}
        self._step = 0

    def _remember(self, commanded: np.ndarray) -> None:
        now = float(self.data.time)
        if not self._time:  # the first command held before
            self._time, self._past = [now - self.model.opt.timestep], [commanded]
        self._time.append(now)
        self._past.append(commanded)
        while self._time[-1] - self._time[0] > _MEMORY:
            # an output is the mean over a step: between two of them it is that of their middle
            for place, made in self._made.items():
                at = np.array(self._time[:2]) + _ROUNDING * self.model.opt.timestep
                self._state[place] = float(made.at(at).mean())
            del self._time[0], self._past[0]
