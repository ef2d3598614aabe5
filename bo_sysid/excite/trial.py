"""What a machine does under controls, and what a recording of that would say of its parameters."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

from bo_sysid.checks.sensitivity import Information, information
from bo_sysid.errors import StudyError
from bo_sysid.excite.evolution import minimise
from bo_sysid.excite.exceeded import first_exceeded, why_not_held, why_not_moved, why_unstable
from bo_sysid.excite.fourier import Series, ranges
from bo_sysid.excite.judge import COARSEST, Judge, coarse
from bo_sysid.excite.limits import Limits
from bo_sysid.excite.rest import Hold, corners, held, holding
from bo_sysid.execution import threads
from bo_sysid.mjcf import Model, nominal
from bo_sysid.mjcf.commands import units
from bo_sysid.mjcf.edits import parameter_edits
from bo_sysid.mjcf.extremes import actuator_extremes
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, ForceLaw, MujocoSimulator, Trajectory, cut

PROOF = 24
"""Drawn parameter vectors that must keep the limits at the end."""
STANDS = 1e-4
"""Distance within which a machine stands at its reference, in [rad] or [m]."""
_HARMONICS, _BAND = 12, (0.15, 10.0)  # base frequencies, in [Hz]
_WINDOW = 0.5  # [s]
_SHRINK, _SMALLEST = 0.98, 1e-3  # of controls that exceed limits: factor, and least size
_NUDGE = 1e-4  # [rad] or [m] beside the reference, far less than a machine is placed to
_UNSTABLE = 100.0  # growth of that
_NEAR, _CALMING = 0.03, 50  # of controls that hold: half widths that are tried; trials of each


class Run(NamedTuple):
    """What W machines did.

    Attributes:
        models: the compiled model of each.
        trajectory: their motion.
        ctrl: `W x S x nu` controls at each step of the simulation.
    """

    models: list[mujoco.MjModel]
    trajectory: Trajectory
    ctrl: Float[np.ndarray, "W S nu"]


class Trial:
    """Tries controls on a machine whose parameters are not known.

    Args:
        model: the nominal model.
        parameters: what is to be known.
        limits: what the machine bears.
        noise: standard deviation of every position, in its unit.
        seconds: length of the trajectory.
        interval: between two controls, and between two samples, in [s].
        seed: of the drawn parameter vectors.
        laws: forces that are stepped with the model.

    Attributes:
        commands: least and largest control of every actuator for all machines within the bounds
            of the parameters, and the nominal one; infinite where unlimited.
        hold: the controls that hold the machine at its reference, where those in the middle of
            their ranges do not.

    Raises:
        StudyError: a machine exceeds a limit where it should stand at its reference.
    """

    def __init__(
        self,
        model: Model,
        parameters: Sequence[Parameter],
        limits: Limits,
        noise: dict[str, float],
        *,
        seconds: float,
        interval: float,
        seed: int = 0,
        laws: Sequence[ForceLaw] = (),
    ) -> None:
        self.model, self.parameters, self.laws = model, tuple(parameters), tuple(laws)
        self.limits, self.noise, self._seed = limits, noise, seed
        compiled = model.compile()
        self._hold = max(round(interval / compiled.opt.timestep), 1)
        step = self._hold * float(compiled.opt.timestep)
        self.commands = limits.commands([compiled, *actuator_extremes(model, parameters)])
        middle, half = ranges(*self.commands)
        highest = min(_BAND[1], 0.2 / step)
        tones = np.geomspace(_BAND[0], highest, _HARMONICS)
        self.series = Series(middle, half, tones, seconds, step)
        self.start = held(compiled, middle)
        self.hold: Hold | None = None
        self._engine = Engine(threads())
        self._simulator = MujocoSimulator(model, self.parameters, Engine(threads()), self.laws)
        self.point = np.array([nominal(model, p) for p in self.parameters])
        sobol = qmc.Sobol(len(self.parameters), seed=seed).random(32)
        low = np.array([p.low for p in self.parameters])
        high = np.array([p.high for p in self.parameters])
        self.draws = low + (high - low) * sobol
        self.machines = np.vstack([self.point[None], self.draws[:PROOF]])
        self._corners = corners(low, high, sobol)
        self._judges: dict[tuple[int, ...], Judge] = {}
        self._horizon = max(round(_WINDOW / step), 1)
        if self.violation(self._still, self.machines, 1.0) > 0:
            self._rest_held(self._corners)
        elif self.left > STANDS:
            self._prefer_held()
        self._require_stable()

    @property
    def proof(self) -> Float[np.ndarray, "M d"]:
        """The machines with which a plan must keep the limits: `machines`, and corners."""
        return np.vstack([self.machines, self._corners])

    @property
    def left(self) -> float:
        """How far the nominal machine leaves its reference at rest, in [rad] or [m]."""
        run = self.run(self._still, self.point[None])
        return float(np.abs(run.trajectory.qpos - self.start.qpos).max())

    @property
    def _still(self) -> Float[np.ndarray, "R nu"]:
        return np.tile(self.series.at_rest, (len(self.series.time), 1))

    def _rest_held(self, further: Float[np.ndarray, "c d"]) -> None:
        """Let controls rest where they hold the nominal machine at the reference.

        Where other machines exceed limits there, they rest where all use least of them.

        Args:
            further: machines that must keep the limits as well, since what is held drifts.

        Raises:
            StudyError: the limits are exceeded even so.
        """
        self.hold = hold = self._held()
        self.machines = np.vstack([self.machines, further])
        if self.violation(self._still, self.machines, 1.0) > 0:
            self._rest_at(self._calmest(len(further)))
        run = self.run(self._still, self.machines)
        if self.limits.violation(*run, 1.0).max() > 0:
            worst = first_exceeded(self.limits, *run)
            context = self.model.joints, hold, self.parameters, self.machines
            raise StudyError(why_not_held(worst, *context))

    def _prefer_held(self) -> None:
        """Let controls rest where they hold the machine, if they do better and keep the limits."""
        left, hold = self.left, self._held()
        if self.left < left and self.violation(self._still, self.proof, 1.0) == 0:
            self.hold = hold
        else:
            self._rest_at(np.zeros_like(self.series.half))

    def _held(self) -> Hold:
        """Let controls rest where they come nearest to holding the nominal machine."""
        s, model = self.series, self._models(self.point[None])[0]
        hold = holding(model, self.laws, s.middle - s.half, s.middle + s.half)
        self._rest_at((hold.ctrl - s.middle) / s.half)
        return hold

    def _rest_at(self, rest: Float[np.ndarray, " nu"]) -> None:
        """Let controls rest at distances from their middles, in half widths, and lags with them."""
        self.series = replace(self.series, rest=rest)
        self.start = held(self.model.compile(), self.series.at_rest)
        self._judges.clear()

    def _calmest(self, last: int) -> Float[np.ndarray, " nu"]:
        """Return where controls rest so that machines use least of their limits.

        Args:
            last: number of machines that count beside the nominal one, from the last on.
        """
        s, count = self.series, len(self.machines)
        judge = self.judge((0, *range(count - last, count)))

        def used(rest: np.ndarray) -> np.ndarray:
            still = np.repeat(rest[:, None], len(s.time), axis=1)
            return judge(replace(s, rest=0.0).scaled(still), 0.0, information=False).over

        start = np.broadcast_to(s.rest, s.half.shape)
        found, _ = minimise(used, start, _NEAR, _CALMING * len(s.half), self._seed)
        return np.asarray(np.clip(found, -1.0, 1.0))

    def _require_stable(self) -> None:
        """Refuse a machine that leaves its limits when it starts a hair beside its reference."""
        run = self._nudged(self._models([self.point]), self._hold)
        beside = Run(run.models[:1], run.trajectory.rows(slice(1, 2)), run.ctrl[1:])
        over = self.limits.violation(*beside, 1.0)[0]
        if over > 0 and _growth(run.trajectory) > _UNSTABLE:
            worst = first_exceeded(self.limits, *beside)
            raise StudyError(why_unstable(worst, _NUDGE))

    def _nudged(self, models: Sequence[mujoco.MjModel], steps: int) -> Run:
        """Return what machines do at rest, and then what each does from a hair beside it.

        Args:
            models: the compiled models.
            steps: of the simulation in an interval.
        """
        both = [*models, *models]
        inwards = np.where(self.start.qpos < self.limits.middle, _NUDGE, -_NUDGE)
        start = self.start.repeat(len(both))
        start.qpos[len(models) :] += inwards[0]
        ctrl = np.repeat(np.repeat(self._still, steps, axis=0)[None], len(both), axis=0)
        return Run(both, self._engine.rollout(both, start, ctrl, laws=self.laws), ctrl)

    @cached_property
    def _judged_steps(self) -> int:
        """Steps of the simulation in an interval that are enough to judge by.

        By coarser ones a stiff machine shakes itself to pieces that stands still by its own.
        """
        own = _growth(self._nudged(self._models([self.point]), self._hold).trajectory)
        interval = self.series.interval
        steps = int(np.ceil(interval / COARSEST - 1e-9))
        while steps < self._hold:
            step = interval / steps
            models = [coarse(self.model, self.parameters, p, step) for p in self.machines]
            if _growth(self._nudged(models, steps).trajectory) < _UNSTABLE * max(own, 1.0):
                break
            steps = min(2 * steps, self._hold)
        return steps

    def _models(self, points: Iterable[np.ndarray]) -> list[mujoco.MjModel]:
        edits = [parameter_edits(self.model, self.parameters, p) for p in points]
        return [self.model.compile(e) for e in edits]

    def run(self, controls: Float[np.ndarray, "R nu"], points: Float[np.ndarray, "W d"]) -> Run:
        """Return what machines with some parameters do, from rest at the reference."""
        count = len(points)
        ctrl = np.repeat(np.repeat(controls, self._hold, axis=0)[None], count, axis=0)
        start = self.start.repeat(count)
        models = self._models(points)
        return Run(models, self._engine.rollout(models, start, ctrl, laws=self.laws), ctrl)

    def violation(
        self, controls: Float[np.ndarray, "R nu"], points: np.ndarray, margin: float
    ) -> float:
        """Return by how much the worst limit is exceeded by the worst machine."""
        return float(self.violations(controls, points, margin).max())

    def violations(
        self, controls: Float[np.ndarray, "R nu"], points: np.ndarray, margin: float
    ) -> Float[np.ndarray, " W"]:
        """Return by how much each machine exceeds its worst limit."""
        return self.limits.violation(*self.run(controls, points), margin)

    def information(self, controls: Float[np.ndarray, "R nu"]) -> Information:
        """Return what a recording of the nominal machine under the controls would say."""
        windows = cut(
            self.model,
            [self.recorded(controls)],
            horizon=self._horizon,
            parameters=self.parameters,
        )
        return information(self._simulator, self.point, windows, self.noise)

    def recorded(self, controls: Float[np.ndarray, "R nu"]) -> Recording:
        """Return the recording of the nominal machine under the controls, without noise."""
        trajectory = self.run(controls, self.point[None]).trajectory
        rows = slice(0, -1, self._hold)
        qpos, qvel = (
            {
                name.split(".", 1)[1]: values[0, rows, k]
                for k, name in enumerate(getattr(self.model, f"{kind}_channels"))
            }
            for kind, values in (("qpos", trajectory.qpos), ("qvel", trajectory.qvel))
        )
        ctrl = {n: controls[:, a] for a, n in enumerate(self.model.controlled)}
        return Recording.from_arrays(
            self.series.time, name="plan", units=units(self.model.compile()),
            ctrl=ctrl, qpos=qpos, qvel=qvel,
        )  # fmt: skip

    def judge(self, rows: tuple[int, ...]) -> Judge:
        """Return what judges many trajectories at once, with limits for rows of `machines`."""
        if rows not in self._judges:
            self._judges[rows] = Judge(
                self.model, self.parameters, self.point, self.machines[list(rows)], self.limits,
                self.noise, interval=self.series.interval, steps=self._judged_steps,
                window=self._horizon, laws=self.laws, start=self.start,
            )  # fmt: skip
        return self._judges[rows]

    def energy(self, controls: Float[np.ndarray, "*K R nu"]) -> Float[np.ndarray, "*K"]:
        """Return the mean square of the controls about rest in units of their half ranges."""
        return np.asarray((self.series.unit(controls) ** 2).mean(axis=(-2, -1)))

    def safe(self, unit: Float[np.ndarray, "R nu"]) -> Float[np.ndarray, "R nu"]:
        """Return controls, made smaller until every machine of `proof` keeps every limit.

        Args:
            unit: distances to rest in units of the half widths of the controls' ranges.

        Raises:
            StudyError: even a thousandth of them exceeds a limit.
        """
        size, worst, machines = 1.0, 0, self.proof
        while size > _SMALLEST:
            controls = self.series.scaled(size * unit)
            if self.violation(controls, machines[[worst]], 1.0) == 0:
                over = self.violations(controls, machines, 1.0)
                if over.max() == 0:
                    return controls
                worst = int(over.argmax())
            size *= _SHRINK
        run = self.run(self.series.scaled(size * unit), machines)
        raise StudyError(why_not_moved(first_exceeded(self.limits, *run)))


def _growth(trajectory: Trajectory) -> float:
    """Return by how much what began a hair beside the first half of some machines grew."""
    half = len(trajectory.qpos) // 2
    if trajectory.diverged.any():
        return np.inf
    return float(np.abs(trajectory.qpos[half:] - trajectory.qpos[:half]).max()) / _NUDGE
