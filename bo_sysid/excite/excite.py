"""An informative trajectory within limits, before there are data.

The cost of a trajectory is the logarithm of the widest predicted interval, in units of the
parameters' ranges (the worst parameter decides, as in E- and A-optimal designs), from the Fisher
information through the simulator with the starts of windows as nuisances
(`checks.sensitivity`), plus a penalty for limits that any of several drawn parameter vectors
exceeds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.stats import qmc

from bo_sysid.checks.sensitivity import Information, information
from bo_sysid.errors import StudyError
from bo_sysid.excite.evolution import minimise
from bo_sysid.excite.fourier import Series
from bo_sysid.excite.limits import Limits
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.edits import parameter_edits
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.simulation import Engine, MujocoSimulator, State, Trajectory, cut
from bo_sysid.study import Study
from bo_sysid.study.check import nominal
from bo_sysid.study.inputs import load_model

MARGIN = 0.9
"""Share of each limit that the optimiser uses."""
NOISE = 1e-3  # [rad] or [m], where the study says nothing
_HARMONICS = 6
_BAND = (0.2, 2.5)  # [Hz]
_WINDOW = 0.5  # [s]
_DRAWS, _PROOF = 4, 24  # parameter vectors that must keep the limits: while searching, at the end
_PENALTY = 20.0
_SHRINK = 0.93
_UNBOUNDED = 1.0  # control range of an actuator that says none


@dataclass(frozen=True)
class Excitation:
    """A trajectory to be run on the machine.

    Attributes:
        controls: time [s] and one column an actuator, held between rows.
        parameters: one row a parameter: name, unit, sigma and of_range as predicted.
        predicted: what the nominal model does under them.
        widest: the largest predicted standard deviation, in units of its range.
        used: largest share of a limit that is used, over the drawn parameter vectors.
        energy: mean square of the controls in units of their half ranges.
        notes: what was assumed.
    """

    controls: pd.DataFrame
    parameters: pd.DataFrame
    predicted: Recording
    widest: float
    used: float
    energy: float
    notes: tuple[str, ...]


class Designer:
    """Judges trajectories of controls of one machine.

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
        self.model, self.parameters, self.limits, self.noise = (
            model,
            tuple(parameters),
            limits,
            noise,
        )
        compiled = model.compile()
        self._hold = max(round(interval / compiled.opt.timestep), 1)
        middle, half = _ranges(compiled)
        self.series = Series(
            middle,
            half,
            np.geomspace(*_BAND, _HARMONICS),
            seconds,
            self._hold * float(compiled.opt.timestep),
        )
        self._engine = Engine(0)
        self._simulator = MujocoSimulator(model, self.parameters, Engine(0))
        self._compiled = compiled
        self.point = np.array([nominal(model, p) for p in self.parameters])
        sobol = qmc.Sobol(len(self.parameters), seed=seed).random(32)
        low = np.array([p.low for p in self.parameters])
        high = np.array([p.high for p in self.parameters])
        self.draws = low + (high - low) * sobol

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
        trajectory, ctrl = self.run(controls, points)
        return float(self.limits.violation(self._compiled, trajectory, ctrl, margin).max())

    def information(self, controls: Float[np.ndarray, "R nu"]) -> Information:
        """Return what a recording of the nominal machine under the controls would say."""
        recording = self.recorded(controls)
        horizon = max(round(_WINDOW / self.series.interval), 1)
        windows = cut(self.model, [recording], horizon=horizon)
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

    def cost(self, controls: Float[np.ndarray, "R nu"], energy: float) -> float:
        """Return the logarithm of the widest interval, with penalties for limits and energy."""
        points = np.vstack([self.point[None], self.draws[:_DRAWS]])
        over = self.violation(controls, points, MARGIN)
        over += max(self.energy(controls) / energy - 1.0, 0.0)
        if over > 1.0:
            return _PENALTY * over
        found = self.information(controls)
        return float(np.log(_widest(found))) + _PENALTY * over

    def energy(self, controls: Float[np.ndarray, "R nu"]) -> float:
        """Return the mean square of the controls in units of their half ranges."""
        unit = (controls - self.series.middle) / self.series.half
        return float((unit**2).mean())

    def design(
        self,
        budget: int,
        seed: int,
        *,
        energy: float = np.inf,
        report: Callable[[int, float], None] | None = None,
    ) -> Float[np.ndarray, "R nu"]:
        """Return the most informative controls that were found, within all limits."""
        tries = max(budget // 10, 1)
        starts = [self.random(seed + k) for k in range(tries)]
        costs = [self.cost(self.series.controls(x), energy) for x in starts]
        start = starts[int(np.argmin(costs))]
        best, _ = minimise(
            lambda x: self.cost(self.series.controls(x), energy),
            start,
            0.1,
            budget - tries,
            seed,
            report,
        )
        return self.safe(best)

    def random(self, seed: int) -> Float[np.ndarray, " p"]:
        """Return the coefficients of a random multisine, as large as the limits allow.

        Raises:
            StudyError: standing still exceeds a limit.
        """
        x = np.random.default_rng(seed).standard_normal(self.series.size)
        x[-1] = 0.0
        while self.violation(self.series.controls(x), self.point[None], MARGIN) > 0:
            x[:-1] *= 0.8
            if np.abs(x[:-1]).max() < 1e-4:
                raise StudyError("limits: even standing still exceeds them at the reference")
        return x

    def safe(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, "R nu"]:
        """Return controls, made smaller until every drawn machine keeps every limit."""
        points = np.vstack([self.point[None], self.draws[:_PROOF]])
        while self.violation(self.series.controls(x), points, 1.0) > 0:
            x = np.append(_SHRINK * x[:-1], x[-1])
        return self.series.controls(x)


def excite(
    study: Study,
    *,
    seconds: float = 10.0,
    interval: float = 0.01,
    budget: int = 400,
    effects: bool = False,
    report: Callable[[int, float], None] | None = None,
) -> Excitation:
    """Return a trajectory that tells a study's parameters, within its limits.

    Args:
        study: model, parameters and limits; recordings are not read.
        seconds: length of the trajectory.
        interval: between two controls in [s].
        budget: number of trajectories that are tried.
        effects: also make friction, damping, armature and springs of all joints tellable.
        report: told the number of trajectories tried and the lowest cost.

    Raises:
        StudyError: there is nothing to be known, or the limits allow no motion.
        UserError: the model is wrong.
    """
    model = load_model(study)
    if study.actuators:
        raise study.error(
            ("actuators",), "excite cannot plan through a law in Python; leave it out"
        )
    parameters = study.parameter_set(model)
    if effects:
        parameters = (*parameters, *_catalogue(model, parameters))
    if not parameters:
        raise study.error(("parameters",), "excite needs parameters to be known (or --effects)")
    notes = []
    noise = {}
    for name in model.qpos_channels:
        stated = study.recordings.noise.get(name, study.recordings.noise.get("qpos"))
        noise[name] = stated or NOISE
    if not study.recordings.noise:
        notes.append(f"Noise of positions taken as {1e3 * NOISE:g} mrad (mm); say it under noise:.")
    unlimited = [j for j in model.joints if j not in study.limits]
    if unlimited:
        notes.append(f"No limits are stated for: {', '.join(unlimited)}.")
    designer = Designer(
        model, parameters, Limits.of(model, study.limits), noise,
        seconds=seconds, interval=interval, seed=study.search.seed,
    )  # fmt: skip
    controls = designer.design(budget, study.search.seed, report=report)
    found = designer.information(controls)
    points = np.vstack([designer.point[None], designer.draws[:_PROOF]])
    names = [f"ctrl.{a}" for a in model.actuators]
    frame = pd.DataFrame(controls, columns=names)
    frame.insert(0, "time", designer.series.time)
    predicted = designer.recorded(controls)
    return Excitation(
        frame,
        found.table(),
        predicted,
        _widest(found),
        designer.violation(controls, points, 0.0),
        designer.energy(controls),
        tuple(notes),
    )


def _widest(found: Information) -> float:
    return float(found.sigma.max())


def _ranges(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half width of each control's range; ±1 where it says none."""
    limited = np.asarray(model.actuator_ctrllimited) > 0
    ctrl = np.where(limited[:, None], model.actuator_ctrlrange, [-_UNBOUNDED, _UNBOUNDED])
    return ctrl.mean(axis=1), 0.5 * np.diff(ctrl, axis=1)[:, 0]


def _catalogue(model: Model, known: Sequence[Parameter]) -> list[Parameter]:
    """Return effects that are one number of a joint, as parameters that are not known yet."""
    compiled = model.compile()
    taken = {a for p in known for a in p.addresses}
    found = []
    for j, name in enumerate(model.joints):
        inertia = float(compiled.dof_M0[compiled.jnt_dofadr[j]])
        for what, unit in (
            ("frictionloss", 1.0), ("damping", 1.0), ("armature", 0.5), ("stiffness", 5.0),
        ):  # fmt: skip
            address = f"joint[{name}].{what}"
            if address not in taken:
                found.append(Parameter(address, (address,), 0.0, unit * inertia, apply="add"))
    return found
