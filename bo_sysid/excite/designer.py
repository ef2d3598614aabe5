"""The search for informative controls of one machine, and the random tones they are compared with.

The cost of a trajectory is the logarithm of the widest predicted interval, in units of the
parameters' ranges (the worst parameter decides, as in E- and A-optimal designs; a high norm stands
for the largest, so that the second widest count too), plus a penalty for limits that any of several
drawn parameter vectors exceeds. Searching starts at the best of many random spectra.

[Pintelon2012] R. Pintelon, J. Schoukens. System Identification: A Frequency Domain Approach.
Wiley, 2012; random-phase multisines: chapter 5.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.stats import qmc

from bo_sysid.checks.sensitivity import Information, information
from bo_sysid.errors import StudyError
from bo_sysid.excite.evolution import minimise
from bo_sysid.excite.fourier import Series, ranges
from bo_sysid.excite.judge import Judge, largest
from bo_sysid.excite.limits import Limits
from bo_sysid.excite.splines import Splines
from bo_sysid.execution import threads
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.edits import parameter_edits
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, MujocoSimulator, State, Trajectory, cut
from bo_sysid.study.check import nominal

PROOF = 24
"""Drawn parameter vectors that must keep the limits at the end."""
_ROWS: tuple[int, ...] = (0, 1, 2)  # of these, the first to keep them while searching
_TONES = 0.5  # of the budget; splines have the rest
_ROUNDS = ((0.6, 0.3, 0.93), (0.4, 0.15, 0.98))  # of that; deviation at first; share of limits
_LEAST = 1e-9  # unit of corrections of controls that stand still
_CORRECTIONS = ((0.5, 0.15, 0.93), (0.5, 0.05, 0.98))  # the same, of splines
_ADDED = 4  # machines that the next round heeds, too
_HARMONICS, _BAND = 12, (0.15, 10.0)  # base frequencies, in [Hz]
_WINDOW = 0.5  # [s]
_NORM = 12  # of the intervals: stands for the largest
_PENALTY = 20.0
_SHARE, _HALVINGS = 0.25, 6  # of the budget for random spectra; simulations each
_SPREAD, _SLOPE = 1.2, 3.0  # of random spectra: deviation of log amplitudes; most that they fall
_OFFSPRING = 24  # of a generation
_FLOOR, _SHIFT = 0.02, 0.3  # of the units, for tones that are hardly there; of frequencies
_LARGEST = 4.0  # amplitude that random tones are tried from, in half ranges
_SHRINK = 0.98


@dataclass(frozen=True)
class _How:
    """How a plan is searched for: with what energy, seed, generation and report."""

    energy: float
    seed: int
    offspring: int
    report: Callable[[int, float], None] | None


class Designer:
    """Judges trajectories of controls of one machine, and looks for the best.

    Args:
        model: the nominal model.
        parameters: what is to be known.
        limits: what the machine bears.
        noise: standard deviation of every position, in its unit.
        seconds: length of the trajectory.
        interval: between two controls, and between two samples, in [s].
        seed: of the drawn parameter vectors.
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
    ) -> None:
        self.model, self.parameters = model, tuple(parameters)
        self.limits, self.noise = limits, noise
        compiled = model.compile()
        self._hold = max(round(interval / compiled.opt.timestep), 1)
        step = self._hold * float(compiled.opt.timestep)
        middle, half = ranges(*limits.commands(compiled))
        highest = min(_BAND[1], 0.2 / step)
        tones = np.geomspace(_BAND[0], highest, _HARMONICS)
        self.series = Series(middle, half, tones, seconds, step)
        self._engine = Engine(threads())
        self._simulator = MujocoSimulator(model, self.parameters, Engine(threads()))
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
        return self._engine.rollout(models, start, ctrl), ctrl

    def violation(
        self, controls: Float[np.ndarray, "R nu"], points: np.ndarray, margin: float
    ) -> float:
        """Return by how much the worst limit is exceeded by the worst machine."""
        return float(self._violations(controls, points, margin).max())

    def _violations(
        self, controls: Float[np.ndarray, "R nu"], points: np.ndarray, margin: float
    ) -> Float[np.ndarray, " W"]:
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
        ctrl = {n: controls[:, a] for a, n in enumerate(self.model.actuators)}
        return Recording.from_arrays(self.series.time, ctrl=ctrl, qpos=qpos, qvel=qvel)

    def judge(self, rows: tuple[int, ...]) -> Judge:
        """Return what judges many trajectories at once, with limits for rows of `machines`."""
        if rows not in self._judges:
            self._judges[rows] = Judge(
                self.model, self.parameters, self.point, self.machines[list(rows)], self.limits,
                self.noise, interval=self.series.interval, window=self._horizon,
            )  # fmt: skip
        return self._judges[rows]

    def energy(self, controls: Float[np.ndarray, "*K R nu"]) -> Float[np.ndarray, "*K"]:
        """Return the mean square of the controls in units of their half ranges."""
        unit = (controls - self.series.middle) / self.series.half
        return np.asarray((unit**2).mean(axis=(-2, -1)))

    def cost(
        self,
        controls: Float[np.ndarray, "K R nu"],
        energy: float,
        margin: float,
        rows: tuple[int, ...],
    ) -> Float[np.ndarray, " K"]:
        """Return the logarithm of the widest interval, with penalties for limits and energy."""
        found = self.judge(rows)(controls, margin)
        over = found.over + np.maximum(self.energy(controls) / energy - 1.0, 0.0)
        told = np.log((found.sigma**_NORM).sum(axis=1)) / _NORM
        return np.asarray(_PENALTY * over + np.where(over > 1.0, 0.0, told))

    def design(
        self,
        budget: int,
        seed: int,
        *,
        energy: float = np.inf,
        report: Callable[[int, float], None] | None = None,
    ) -> Float[np.ndarray, "R nu"]:
        """Return the most informative controls that were found, within all limits.

        Tones first, then splines that correct them.

        Args:
            budget: number of trajectories that are tried, in whole generations.
            seed: of the search.
            energy: most that the controls may have.
            report: told the number of trajectories tried and the lowest cost.
        """
        first = int(_TONES * budget)
        how = _How(energy, seed, min(_OFFSPRING, max(budget // 8, 4)), report)
        x, width, tried = self._start(first, how)
        x, rows = self._refined(how, self.series.controls, x, width, _ROUNDS, (tried, first), _ROWS)
        splines = Splines.on(self.series, self.series.controls(x[None])[0])
        width = np.full(splines.size, np.sqrt((splines.base**2).mean(axis=0)).max() + _LEAST)
        c, _ = self._refined(
            how,
            splines.controls,
            np.zeros(splines.size),
            width,
            _CORRECTIONS,
            (first, budget),
            rows,
        )
        return self.safe(splines.unit(c[None])[0])

    def _refined(
        self,
        how: _How,
        form: Callable[[Float[np.ndarray, "K p"]], Float[np.ndarray, "K R nu"]],
        x: Float[np.ndarray, " p"],
        width: Float[np.ndarray, " p"],
        rounds: Sequence[tuple[float, float, float]],
        tried: tuple[int, int],
        rows: tuple[int, ...],
    ) -> tuple[Float[np.ndarray, " p"], tuple[int, ...]]:
        """Return better coefficients and the rows of machines that were heeded at the end.

        Args:
            how: is searched.
            form: from coefficients to controls.
            x: coefficients at first.
            width: their units.
            rounds: share of the budget, deviation at first, share of the limits.
            tried: number of trajectories before and after.
            rows: of machines that keep the limits at first.
        """
        done = tried[0]
        for share, sigma, margin in rounds:
            count = int(share * (tried[1] - tried[0]))

            def cost(
                z: np.ndarray, margin: float = margin, rows: tuple[int, ...] = rows
            ) -> np.ndarray:
                return self.cost(form(z * width), how.energy, margin, rows)

            z, _ = minimise(
                cost, x / width, sigma, count, how.seed, offspring=how.offspring,
                report=how.report and partial(_later, how.report, done),
            )  # fmt: skip
            x, done = z * width, done + count
            rows = self._heeded(form(x[None])[0], rows)
        return x, rows

    def _heeded(
        self, controls: Float[np.ndarray, "R nu"], rows: tuple[int, ...]
    ) -> tuple[int, ...]:
        """Return rows of machines, with those that exceed the limits most."""
        over = self._violations(controls, self.machines, 1.0)
        worst = [int(k) for k in np.argsort(-over)[:_ADDED] if over[k] > 0]
        return tuple(sorted({*rows, *worst}))

    def tones(
        self, count: int, seed: int, band: tuple[float, float]
    ) -> Float[np.ndarray, "K R nu"]:
        """Return random-phase multisines, as large as the limits of all machines allow.

        All lines k / T in the band have the same amplitude and random phases [Pintelon2012];
        actuators move by the same share of their ranges.

        Args:
            count: number K of multisines.
            seed: of the phases.
            band: lowest and highest frequency in [Hz].
        """
        rng, s = np.random.default_rng(seed), self.series
        low, high = np.ceil(band[0] * s.seconds - 1e-9), np.floor(band[1] * s.seconds + 1e-9)
        turns = 2 * np.pi * s.time[:, None] * np.arange(max(low, 1), high + 1) / s.seconds
        phase = rng.uniform(0, 2 * np.pi, (count, len(s.half), 1, turns.shape[1]))
        unit = np.cos(turns + phase).sum(axis=3)
        unit /= np.sqrt((unit**2).mean(axis=2, keepdims=True))
        shape = s.fade[:, None] * np.swapaxes(unit, 1, 2)

        everyone = tuple(range(len(self.machines)))

        def over(size: np.ndarray) -> np.ndarray:
            return self.judge(everyone)(s.scaled(size[:, None, None] * shape), 1.0, told=False).over

        size = largest(over, np.full(count, _LARGEST), 10)
        unit = size[:, None, None] * shape
        return np.stack([self.safe(u) for u in unit])  # judges are coarse

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

    def _start(
        self, budget: int, how: _How
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"], int]:
        """Return the best of random spectra, the units of its coefficients, and what was tried."""
        rng, s = np.random.default_rng(how.seed), self.series
        count, tones, nu = max(int(_SHARE * budget / _HALVINGS), 4), len(s.frequencies), len(s.half)
        fall = rng.uniform(0, _SLOPE, (count, 1, 1)) * np.linspace(0, 1, tones)
        size = np.exp(_SPREAD * rng.standard_normal((count, nu, tones)) - fall)
        size /= size.max(axis=(1, 2), keepdims=True)
        unit = np.tile(size, 2).reshape(count, -1)
        shift = _SHIFT * rng.standard_normal((count, tones))
        shape = unit * rng.standard_normal(unit.shape)

        def coefficients(k: np.ndarray) -> np.ndarray:
            return np.concatenate([k[:, None] * shape, shift], axis=1)

        done = itertools.count(count, count)

        def over(k: np.ndarray) -> np.ndarray:
            controls = s.controls(coefficients(k))
            if how.report is not None:
                how.report(next(done), np.inf)
            exceeded = self.judge(_ROWS)(controls, _ROUNDS[0][2], told=False).over
            return np.asarray(np.maximum(exceeded, self.energy(controls) - how.energy))

        amplitude = largest(over, np.ones(count), _HALVINGS)
        x = coefficients(amplitude)
        best = int(np.argmin(self.cost(s.controls(x), how.energy, _ROUNDS[0][2], _ROWS)))
        width = np.full(s.size, _SHIFT)
        width[: s.waves] = amplitude[best] * (unit[best] + _FLOOR)
        return x[best], width, (_HALVINGS + 1) * count


def _later(report: Callable[[int, float], None], before: int, done: int, cost: float) -> None:
    report(before + done, cost)
