"""What a machine does under controls, and what a recording of that would say of its parameters."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

from bo_sysid.checks.sensitivity import Information, information
from bo_sysid.errors import StudyError
from bo_sysid.excite.fourier import Series, ranges
from bo_sysid.excite.judge import Judge
from bo_sysid.excite.limits import Limits
from bo_sysid.execution import threads
from bo_sysid.mjcf import Model, nominal
from bo_sysid.mjcf.commands import units
from bo_sysid.mjcf.edits import parameter_edits
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, ForceLaw, MujocoSimulator, State, Trajectory, cut

PROOF = 24
"""Drawn parameter vectors that must keep the limits at the end."""
_HARMONICS, _BAND = 12, (0.15, 10.0)  # base frequencies, in [Hz]
_WINDOW = 0.5  # [s]
_SHRINK = 0.98


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
        self.limits, self.noise = limits, noise
        compiled = model.compile()
        self._hold = max(round(interval / compiled.opt.timestep), 1)
        step = self._hold * float(compiled.opt.timestep)
        middle, half = ranges(*limits.commands(compiled))
        highest = min(_BAND[1], 0.2 / step)
        tones = np.geomspace(_BAND[0], highest, _HARMONICS)
        self.series = Series(middle, half, tones, seconds, step)
        self._engine = Engine(threads())
        self._simulator = MujocoSimulator(model, self.parameters, Engine(threads()), self.laws)
        self._compiled = compiled
        self.point = np.array([nominal(model, p) for p in self.parameters])
        sobol = qmc.Sobol(len(self.parameters), seed=seed).random(32)
        low = np.array([p.low for p in self.parameters])
        high = np.array([p.high for p in self.parameters])
        self.draws = low + (high - low) * sobol
        self._judges: dict[tuple[int, ...], Judge] = {}
        self._horizon = max(round(_WINDOW / step), 1)

    @property
    def machines(self) -> Float[np.ndarray, "M d"]:
        """The nominal machine and those that are drawn: all must keep the limits."""
        return np.vstack([self.point[None], self.draws[:PROOF]])

    def run(
        self, controls: Float[np.ndarray, "R nu"], points: Float[np.ndarray, "W d"]
    ) -> tuple[Trajectory, Float[np.ndarray, "W S nu"]]:
        """Return what machines with some parameters do, from rest at the reference."""
        count = len(points)
        models = [
            self.model.compile(parameter_edits(self.model, self.parameters, p)) for p in points
        ]
        ctrl = np.repeat(np.repeat(controls, self._hold, axis=0)[None], count, axis=0)
        start = State(
            np.tile(self._compiled.qpos0, (count, 1)),
            np.zeros((count, self._compiled.nv)),
            np.zeros((count, self._compiled.na)),
        )
        return self._engine.rollout(models, start, ctrl, laws=self.laws), ctrl

    def violation(
        self, controls: Float[np.ndarray, "R nu"], points: np.ndarray, margin: float
    ) -> float:
        """Return by how much the worst limit is exceeded by the worst machine."""
        return float(self.violations(controls, points, margin).max())

    def violations(
        self, controls: Float[np.ndarray, "R nu"], points: np.ndarray, margin: float
    ) -> Float[np.ndarray, " W"]:
        """Return by how much each machine exceeds its worst limit."""
        trajectory, ctrl = self.run(controls, points)
        return self.limits.violation(self._compiled, trajectory, ctrl, margin)

    def information(self, controls: Float[np.ndarray, "R nu"]) -> Information:
        """Return what a recording of the nominal machine under the controls would say."""
        windows = cut(self.model, [self.recorded(controls)], horizon=self._horizon)
        return information(self._simulator, self.point, windows, self.noise)

    def recorded(self, controls: Float[np.ndarray, "R nu"]) -> Recording:
        """Return the recording of the nominal machine under the controls, without noise."""
        trajectory, _ = self.run(controls, self.point[None])
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
                self.noise, interval=self.series.interval, window=self._horizon, laws=self.laws,
            )  # fmt: skip
        return self._judges[rows]

    def energy(self, controls: Float[np.ndarray, "*K R nu"]) -> Float[np.ndarray, "*K"]:
        """Return the mean square of the controls in units of their half ranges."""
        unit = (controls - self.series.middle) / self.series.half
        return np.asarray((unit**2).mean(axis=(-2, -1)))

    def safe(self, unit: Float[np.ndarray, "R nu"]) -> Float[np.ndarray, "R nu"]:
        """Return controls, made smaller until every drawn machine keeps every limit.

        Args:
            unit: in units of the half widths of the controls' ranges.

        Raises:
            StudyError: standing still exceeds a limit.
        """
        return self._kept(partial(self._shrunk, unit))

    def _shrunk(self, unit: Float[np.ndarray, "R nu"], size: float) -> Float[np.ndarray, "R nu"]:
        return self.series.scaled(size * unit)

    def _kept(self, scaled: Callable[[float], np.ndarray]) -> Float[np.ndarray, "R nu"]:
        size = 1.0
        while self.violation(scaled(size), self.machines, 1.0) > 0:
            if size == 1.0 and self.violation(scaled(0.0), self.machines, 1.0) > 0:
                raise StudyError("limits: even standing still exceeds them at the reference")
            size *= _SHRINK
        return scaled(size)
