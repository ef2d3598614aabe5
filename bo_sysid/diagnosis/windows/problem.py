"""The recordings cut into windows, and what a hypothesis predicts for them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from bo_sysid.deviation.measure import blocks_of
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.commanded import Told, changed_activations, commanded
from bo_sysid.diagnosis.windows.coordinates import Coordinates, transmitted
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.windows.kept_fits import NO_CACHE, FitCache
from bo_sysid.diagnosis.windows.observation import observe, undone
from bo_sysid.diagnosis.windows.process_noise import ProcessNoise
from bo_sysid.diagnosis.windows.recent import Recent
from bo_sysid.diagnosis.windows.timestep import refined
from bo_sysid.effects import Machine, Part
from bo_sysid.effects.readings import readings
from bo_sysid.errors import ModelError
from bo_sysid.mjcf import Loops, Model
from bo_sysid.recording import Recording
from bo_sysid.simulation import Controller, Engine, ForceLaw, State, Trajectory
from bo_sysid.simulation.activations import activations_of
from bo_sysid.simulation.bristles import with_loaded_bristles
from bo_sysid.simulation.lockstep import force_laws
from bo_sysid.simulation.windows import Layout, Windows

BLOCKS = 20
ROUGH = 3.0  # [sigma] of predictions that are far from the recordings
_SPEEDS = (0.0, -0.1, 0.1, -0.3, 0.3, -1.0, 1.0)  # of the joints', tried for an added one
_FAR = 1e7  # residuals are cut off here, in sigma


@dataclass(frozen=True)
class Simulated:
    """What a hypothesis does over all windows.

    Attributes:
        trajectory: the nominal model's coordinates, as its encoders show them.
        whole: all coordinates of the edited model.
        parts: of the hypothesis that MJCF cannot express.
        windows: at the time step of the simulation.
        model: the edited model.
        coordinates: how the two trajectories belong together.
        ctrl: `W x S x nu` controls after filters, as handed to the simulation.
    """

    trajectory: Trajectory
    whole: Trajectory
    parts: tuple[Part, ...]
    windows: Windows
    model: mujoco.MjModel
    coordinates: Coordinates
    ctrl: Float[np.ndarray, "W S nu"]


@dataclass(frozen=True)
class Problem:
    """Windows of recordings, in units of the sensor noise.

    Attributes:
        model: the nominal model.
        machine: the scales of its sites.
        recordings: what was recorded, for filters over whole inputs.
        windows: cut from them, observing positions.
        layout: where the model keeps the channels.
        weight: `W x H x c` one over the standard deviation of each observation, 0 where there is
            none.
        block: `W` number of the block of time that each window belongs to; none spans two
            recordings.
        nuisances: the study's parameters.
        correction: `W x R` projected difference that a finer time step makes, or None.
        engine: simulates.
        laws: controllers and force laws that belong to the nominal model.
        loops: closed chains of the nominal model, on which starts lie.
        kept: long fits of a diagnosis that was killed.
        input_noise: standard deviation of what recorded controls show and the machine did not get,
            by actuator, in the control's unit; nothing for those that are not named.
        process: what that does to the windows; None where it does nothing, or is not known yet.
        recent: the last simulations.
    """

    model: Model
    machine: Machine
    recordings: tuple[Recording, ...]
    windows: Windows
    layout: Layout
    weight: Float[np.ndarray, "W H c"]
    block: Int[np.ndarray, " W"]
    nuisances: tuple[Candidate, ...]
    correction: Float[np.ndarray, "W R"] | None
    engine: Engine
    laws: tuple[Controller | ForceLaw, ...]
    loops: Loops
    kept: FitCache = NO_CACHE
    input_noise: Mapping[str, float] = field(default_factory=dict)
    process: ProcessNoise | None = None
    recent: Recent[Simulated] = field(default_factory=Recent)

    @cached_property
    def identity(self) -> tuple[object, ...]:
        """What a fit hangs on beside files and versions, for `FitCache`."""
        w = self.windows
        return (
            float(w.timestep), w.channels, w.recording, w.time, w.start.qpos, w.start.qvel,
            self.weight, self.block, self.correction,
            *(() if self.process is None else (self.process.response, self.process.controls)),
        )  # fmt: skip

    @property
    def count(self) -> int:
        """Number R of entries that a window has for observations; some may have none."""
        return int(self.windows.observed.shape[1] * self.windows.observed.shape[2])

    @cached_property
    def seen_in_each(self) -> Int[np.ndarray, " W"]:
        """Number of observations that each window has, 1 at least.

        Windows of a slow recording have few beside those of a fast one, and so have those of
        channels with stamps of their own.
        """
        return np.asarray(np.maximum((self.weight > 0).sum(axis=(1, 2)), 1))

    def mean_square(self, r: Float[np.ndarray, "W R"]) -> Float[np.ndarray, " W"]:
        """Return the mean square of each window over its observations."""
        return np.asarray((r**2).sum(axis=1) / self.seen_in_each)

    @property
    def dof(self) -> int:
        """Observations minus fitted starts."""
        return max(int((self.weight > 0).sum() - self.start_size * len(self.windows)), 1)

    @property
    def start_size(self) -> int:
        """Numbers that a start has: positions and speeds of the joints that are free."""
        return int(2 * (self.machine.model.nv - len(self.loops.dofs)))

    def moved(self, start: State, change: Float[np.ndarray, "W n"]) -> State:
        """Return starts moved along their tangent space, loops closed."""
        return start.moved(self.machine.model, change).closed(self.loops)

    def smoothed(self, hypothesis: Hypothesis) -> State:
        """Return a smoother's starts, as the readings of a hypothesis leave them."""
        start = self.windows.start
        if not any(c.effect.family == "sensing" for c in hypothesis.members):
            return start
        _, parts = self.compiled(hypothesis)
        return undone(self.layout, start, parts).closed(self.loops)

    def rows(self, keep: np.ndarray) -> "Problem":
        """Return the problem with some of its windows, blocks numbered anew."""
        windows = self.windows.rows(keep)
        return replace(
            self,
            windows=windows,
            weight=self.weight[keep],
            block=blocks_of(windows.recording, BLOCKS)[0],
            correction=None if self.correction is None else self.correction[keep],
            process=None if self.process is None else self.process.rows(keep),
        )

    def beginning(self, instants: int) -> "Problem":
        """Return the problem with the first instants of every window."""
        own = slice(0, instants * len(self.windows.channels))
        windows = self.windows.beginning(instants)
        steps = windows.ctrl.shape[1]
        return replace(
            self,
            windows=windows,
            weight=self.weight[:, :instants],
            correction=None if self.correction is None else self.correction[:, own],
            process=None if self.process is None else self.process.beginning(own.stop, steps),
        )

    def compiled(
        self, hypothesis: Hypothesis, timestep: float | None = None
    ) -> tuple[mujoco.MjModel, list[Part]]:
        """Return the model of a hypothesis and the parts that MJCF cannot express.

        Raises:
            ModelError: it does not compile with the effects that the message names.
        """
        edits, parts = edits_and_parts(hypothesis, self.machine)
        try:
            return self.model.compile(edits, timestep=timestep or self.windows.timestep), parts
        except ModelError as error:
            tried = ", ".join(f"{c.effect.id} at {c.site}" for c in hypothesis.members)
            raise ModelError(f"{error}; tried was {tried}" if tried else str(error)) from None

    @cached_property
    def told(self) -> Told:
        """What the actuators were told, as recorded and behind filters."""
        with_law = [w.actuator for w in self.laws if isinstance(w, Controller)]
        return Told(self.model, self.machine.model, self.recordings, with_law)

    def controls(self, parts: Sequence[Part], windows: Windows) -> Float[np.ndarray, "W S nu"]:
        """Return the windows' controls after the filters among `parts`, less noise of theirs."""
        ctrl = self.told.filtered(parts, windows, windows.ctrl, windows.time)
        if self.process is None:
            return ctrl
        finer = ctrl.shape[1] // self.process.controls.shape[1]
        return np.asarray(ctrl + np.repeat(self.process.controls, finer, axis=1))

    def _activated(
        self, model: mujoco.MjModel, parts: Sequence[Part], windows: Windows, start: State,
        ctrl: Float[np.ndarray, "W S nu"], coordinates: Coordinates,
    ) -> State:  # fmt: skip
        """Return starts with the activations that a hypothesis has led to."""
        if not changed_activations(self.machine.model, model, parts):
            return start
        recordings = commanded(self.recordings, parts, windows.timestep)
        act = activations_of(self.model, model, recordings, windows, ctrl)
        return replace(start, act=act[:, coordinates.act])

    def simulate(self, hypothesis: Hypothesis, start: State, finer: int = 1) -> "Simulated":
        """Simulate all windows; `finer` divides the time step."""
        windows = self.windows if finer == 1 else refined(self.windows, finer)
        inputs = (
            float(windows.timestep), windows.ctrl.shape[1], windows.recording, windows.time,
            *(() if self.process is None else (self.process.controls,)),
        )  # fmt: skip
        found = self.recent.of(
            hypothesis, start, inputs, lambda: self._simulated(hypothesis, start, windows)
        )
        return replace(found, windows=windows)  # of which some are observed otherwise

    def _simulated(self, hypothesis: Hypothesis, start: State, windows: Windows) -> "Simulated":
        model, parts = self.compiled(hypothesis, windows.timestep)
        ctrl = self.controls(parts, windows)
        start = self.told.remembered(model, parts, windows, start)
        coordinates = Coordinates.between(self.machine.model, model, parts)
        start = self._activated(model, parts, windows, start, ctrl, coordinates)
        torque = self._transmitted(hypothesis, start, ctrl, coordinates)
        whole = self.engine.rollout(
            model,
            with_loaded_bristles(model, coordinates.expand(start, torque), ctrl[:, 0]),
            ctrl,
            laws=(*self.laws, *force_laws(parts)),
            signals=windows.signals,
        )
        return Simulated(
            coordinates.reduce(whole), whole, tuple(parts), windows, model, coordinates, ctrl
        )

    def _transmitted(
        self, hypothesis: Hypothesis, start: State, ctrl: np.ndarray, coordinates: Coordinates
    ) -> Float[np.ndarray, "W nv"] | None:
        """Return the torques that hold added joints at the start, None where there are none."""
        if not coordinates.second:
            return None
        model, parts = self.compiled(hypothesis.rigid)
        whole = Coordinates.between(self.machine.model, model, parts).expand(start, None)
        return transmitted(model, whole, ctrl[:, 0])

    def starts(self, hypothesis: Hypothesis, start: State, *, moving: bool = False) -> list[State]:
        """Return other starts, where joints that a hypothesis adds begin elsewhere.

        Args:
            hypothesis: may add joints.
            start: of the nominal coordinates.
            moving: also with speeds of their own.
        """
        if not any(c.effect.hidden for c in hypothesis.members):
            return []
        model, parts = self.compiled(hypothesis)
        coordinates = Coordinates.between(self.machine.model, model, parts)
        torque = self._transmitted(
            hypothesis, start, self.controls(parts, self.windows), coordinates
        )
        if torque is None:
            return []
        fast = max(j.speed for j in self.machine.joints.values())
        speeds = [fast * share for share in (_SPEEDS if moving else (0.0,))]
        return [replace(start, added=a) for a in coordinates.elsewhere(torque, speeds)]

    def loose(self, hypothesis: Hypothesis) -> bool:
        """Whether a hypothesis has a joint that moves in a gap."""
        model, parts = self.compiled(hypothesis)
        return Coordinates.between(self.machine.model, model, parts).loose

    def residual(
        self, hypothesis: Hypothesis, start: State, finer: int = 1
    ) -> Float[np.ndarray, "W R"]:
        """Return recorded minus predicted for every observation, in units of all noise."""
        r = self.deviation(hypothesis, start, finer)
        if self.process is not None:
            r = self.process.whiten(r + self.process.drawn_response)
        if self.correction is not None and hypothesis.numerics:
            r = r - hypothesis.numerics * self.correction
        return r

    def deviation(
        self, hypothesis: Hypothesis, start: State, finer: int = 1
    ) -> Float[np.ndarray, "W R"]:
        """Return recorded minus simulated for every observation, in sigma of the sensors."""
        s = self.simulate(hypothesis, start, finer)
        shown = observe(self.layout, s.windows, s.trajectory, s.parts)
        return self.weighted(np.where(self.seen(s.parts), s.windows.residual(shown), 0.0))

    def as_recorded(
        self, hypothesis: Hypothesis, start: State, finer: int = 1
    ) -> Float[np.ndarray, "W R"]:
        """Return the residual of quaternions with the sign that they were recorded with.

        That of `residual` is of the sign nearer to the prediction, so that it moves with this.
        """
        r = self.residual(hypothesis, start, finer)
        if not self.windows.quaternions:
            return r
        s = self.simulate(hypothesis, start, finer)
        signs = s.windows.signs(observe(self.layout, s.windows, s.trajectory, s.parts))
        return np.asarray(r * signs.reshape(len(signs), -1))

    def seen(self, parts: Sequence[Part]) -> Bool[np.ndarray, "W H c"]:
        """Return which observations count: none of what a delayed reading has from before its log.

        How the machine moved before a recording began is not known.
        """
        seen, windows = self.weight > 0, self.windows
        for reading in readings(parts).values():
            if reading.delay and reading.channel in windows.channels:
                began = np.array([r.span[0] for r in self.recordings])[windows.recording]
                at = windows.time[:, None] + (windows.step + windows.fraction) * windows.timestep
                known = at - began[:, None] >= reading.delay
                seen[..., windows.channels.index(reading.channel)] &= known
        return seen

    def whitened(self, r: Float[np.ndarray, "W R *c"]) -> Float[np.ndarray, "W R *c"]:
        """Return residuals, or columns, in units of all noise where the inputs have some too."""
        return r if self.process is None else self.process.whiten(r)

    def weighted(self, values: Float[np.ndarray, "W H c"]) -> Float[np.ndarray, "W R"]:
        """Return values in sigma, one row a window; what is not finite counts as far away."""
        scaled = np.nan_to_num(values * self.weight, nan=_FAR, posinf=_FAR, neginf=-_FAR)
        return np.asarray(np.clip(scaled, -_FAR, _FAR)).reshape(len(values), -1)
