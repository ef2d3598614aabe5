"""mujoco.sysid on a concealed case: least squares for a structure that it is given.

Two structures. `nominal`: what the nominal model has and a person would fit, masses, torques per
command, whatever damping, friction and armature is not zero, and the parameters of the study.
`right`: the concealed effects with the study's parameters, from the starts and within the bounds
that the catalogue gives them; delays of commands and of sensors are shifts of the signals, as its
own modifiers make them. Both are given windows of the recording and smoothed starts, and residuals
in units of the sensor noise.
"""

import contextlib
import io
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from absl import logging as absl_logging
from jaxtyping import Float
from mujoco import sysid

from bo_sysid.diagnosis.windows.candidate import Candidate, parameter_candidates
from bo_sysid.diagnosis.windows.cutting import cut_problem
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.parameters import Parameter

WINDOW = 0.3  # [s]
_MOST_WINDOWS = 60
_STEP = 1e-3  # of the finite differences, in probes
_ITERATIONS = 40
_DELAYS = ("actuator_delay", "sensor_delay")


@dataclass(frozen=True)
class Fitted:
    """What came of a fit.

    Attributes:
        hypothesis: members and parameters with their values.
        warnings: what was said that a person would take as a warning.
        seconds: that it took.
    """

    hypothesis: Hypothesis
    warnings: tuple[str, ...]
    seconds: float


def nominal_structure(evidence: Evidence) -> tuple[Candidate, ...]:
    """Return what the nominal model has and a person would fit, the study's parameters first."""
    model, held = evidence.machine.model, evidence.nuisances
    taken = {a for c in held for a in c.site.name.split()}
    found = []
    for b in range(1, model.nbody):
        if model.body_dofnum[model.body_rootid[b]] or model.body_mass[b] > 0:
            found.append(_scale(f"body[{model.body(b).name}].mass", 0.5, 2.0))
    for a in range(model.nu):
        found.append(_scale(f"actuator[{model.actuator(a).name}].gear[0]", 0.5, 2.0))
    for j in range(model.njnt):
        dof = int(model.jnt_dofadr[j])
        for field, value in (
            ("damping", model.dof_damping[dof]),
            ("frictionloss", model.dof_frictionloss[dof]),
            ("armature", model.dof_armature[dof]),
        ):
            if value > 0:
                found.append(_scale(f"joint[{model.joint(j).name}].{field}", 0.2, 5.0))
    wanted = [p for p in found if p.addresses[0] not in taken]
    return (*held, *parameter_candidates(evidence.model, wanted))


def _scale(address: str, low: float, high: float) -> Parameter:
    return Parameter(
        name=address, addresses=(address,), apply="scale", low=low, high=high, steps=2, unit="1"
    )


def expressible(truth: Hypothesis, evidence: Evidence) -> bool:
    """Whether mujoco.sysid can hold a structure: MJCF, or a delay of a signal."""
    for c in truth.members:
        if c.effect.id in _DELAYS:
            continue
        parts: list[Any] = []

        def edit(spec: mujoco.MjSpec, c: Candidate = c, parts: list[Any] = parts) -> None:
            parts.extend(c.effect.write(spec, c.site, c.point, evidence.machine))

        evidence.model.compile([edit])
        if parts:
            return False
    return True


def fit(
    evidence: Evidence, members: Sequence[Candidate], nuisances: Sequence[Candidate], probed: bool
) -> Fitted:
    """Fit the magnitudes of a structure.

    Args:
        evidence: recordings, model and noise.
        members: effects beyond the nominal model.
        nuisances: parameters of the model.
        probed: begin members at their probes instead of at nothing.
    """
    began = time.perf_counter()
    said = _Said()
    absl_logging.get_absl_logger().addHandler(said)
    try:
        x = _Case(evidence, tuple(members), tuple(nuisances)).fit(probed)
    finally:
        absl_logging.get_absl_logger().removeHandler(said)
    return Fitted(x, tuple(said.messages), time.perf_counter() - began)


class _Said(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())


class _Case:
    """Windows of the recordings as mujoco.sysid takes them."""

    def __init__(
        self, evidence: Evidence, members: tuple[Candidate, ...], nuisances: tuple[Candidate, ...]
    ) -> None:
        self.evidence, self.members, self.nuisances = evidence, members, nuisances
        self.late = {k: c for k, c in enumerate(members) if c.effect.id in _DELAYS}
        horizon = max(round(WINDOW / evidence.machine.sampling), 6)
        problem = cut_problem(
            evidence.model, evidence.machine, evidence.recordings, evidence.sigma, (),
            horizon=horizon, timestep=float(evidence.machine.model.opt.timestep),
            engine=evidence.engine,
        )  # fmt: skip
        stride = max(len(problem.windows) // _MOST_WINDOWS, 1)
        self.problem: Problem = problem.rows(np.arange(0, len(problem.windows), stride))
        self.sigma = np.array([evidence.sigma[n] for n in self.problem.windows.channels])

    def fit(self, probed: bool) -> Hypothesis:
        params = sysid.ParameterDict()
        for k, c in enumerate((*self.members, *self.nuisances)):
            scale = _scale_of(c)
            begin = c.probe / scale if probed and k < len(self.members) else np.zeros(c.size)
            low, high = np.minimum(c.low / scale, 0.0), np.maximum(c.high / scale, 0.0)
            params.add(sysid.Parameter(str(k), begin, low, high))
        with contextlib.redirect_stdout(io.StringIO()):  # it tells every iteration
            params, _ = sysid.optimize(
                params, self._residuals, optimizer="mujoco", verbose=False,
                check_conditioning=True, max_iters=_ITERATIONS, eps=_STEP,
            )  # fmt: skip
        return self._hypothesis(params)

    def _hypothesis(self, params: Any) -> Hypothesis:
        values = [
            params[str(k)].value * _scale_of(c)
            for k, c in enumerate((*self.members, *self.nuisances))
        ]
        n = len(self.members)
        return Hypothesis(self.members, tuple(values[:n]), self.nuisances, tuple(values[n:]))

    def _model(self, params: Any) -> mujoco.MjModel:
        """Compile the model of a structure; what is a shift of signals is not in it."""
        whole = self._hypothesis(params)
        kept = [k for k in range(len(self.members)) if k not in self.late]
        plain = Hypothesis(
            tuple(whole.members[k] for k in kept),
            tuple(whole.x[k] for k in kept),
            whole.nuisances,
            whole.nuisance_x,
        )
        edits, _ = edits_and_parts(plain, self.evidence.machine, written=True)
        return self.evidence.model.compile(edits, timestep=self.problem.windows.timestep)

    def _residuals(self, x: np.ndarray, params: Any) -> tuple[list[np.ndarray], None, None]:
        """Return the residuals of all windows, one column for each point of `x`."""
        trajectories = self._trajectories(x, params)
        flat, _, _ = sysid.model_residual(
            x, params, self._model, trajectories, modify_residual=self._residual,
            custom_rollout=self._rollout, n_threads=1, resample_true=False,
        )  # fmt: skip
        if x.ndim == 1:
            return [flat], None, None
        # one column for each point and window comes back, points first
        columns = flat.T.reshape(x.shape[1], -1)
        return [columns.T], None, None

    def _trajectories(self, x: np.ndarray, params: Any) -> list[Any]:
        windows, copy = self.problem.windows, params.copy()
        copy.update_from_vector(x if x.ndim == 1 else x[:, 0])
        model, dt = self._model(copy), windows.timestep
        times = dt * np.arange(windows.steps)
        found = []
        for w in range(len(windows)):
            begin = self._state(model, w)
            instants = dt * (windows.step[w] + windows.fraction[w])
            measured = np.nan_to_num(windows.observed[w])
            found.append(
                sysid.SystemTrajectory(
                    model,
                    sysid.TimeSeries(times, windows.ctrl[w]),
                    sysid.TimeSeries(instants, measured),
                    begin,
                    None,
                )
            )
        return found

    def _state(self, model: mujoco.MjModel, w: int) -> Float[np.ndarray, " s"]:
        """Return the smoothed start of a window; lags begin settled on the first command."""
        start, nominal = self.problem.windows.start, self.evidence.machine.model
        qpos, qvel, act = model.qpos0.copy(), np.zeros(model.nv), np.zeros(model.na)
        for j in range(nominal.njnt):
            there = model.joint(nominal.joint(j).name)
            qpos[there.qposadr[0]] = start.qpos[w, nominal.jnt_qposadr[j]]
            qvel[there.dofadr[0]] = start.qvel[w, nominal.jnt_dofadr[j]]
        for a in range(min(model.nu, nominal.nu)):
            if model.actuator_actadr[a] >= 0 and model.actuator_dyntype[a] == _LAG:
                act[model.actuator_actadr[a]] = self.problem.windows.ctrl[w, 0, a]
        return np.asarray(sysid.create_initial_state(model, qpos, qvel, act))

    def _rollout(self, *, models: Any, control_signal: Any, param_dicts: Any, **others: Any) -> Any:
        """Roll out with commands that arrive as late as the parameters say."""
        each = len(models) // len(param_dicts)
        signals = []
        for i, control in enumerate(control_signal):
            values = control.data.copy()
            for k, c in self.late.items():
                if c.effect.id == "actuator_delay":
                    late = float(param_dicts[i // each][str(k)].value[0] * _scale_of(c)[0])
                    a = self.problem.model.ctrl_channels.index(f"ctrl.{c.site.name}")
                    values[:, a] = self._late(i % each, a, late)
            signals.append(sysid.TimeSeries(control.times, values))
        return sysid.sysid_rollout(models=models, control_signal=signals, **others)

    def _late(self, w: int, a: int, late: float) -> Float[np.ndarray, " S"]:
        """Return the mean of a held command over each step, `late` seconds ago."""
        windows = self.problem.windows
        recording = self.evidence.recordings[windows.recording[w]]
        channel = recording.channels[self.problem.model.ctrl_channels[a]]
        gaps = np.diff(channel.time, append=channel.time[-1] + 1.0)
        whole = np.concatenate([[0.0], np.cumsum(channel.values * gaps)])
        edges = np.append(channel.time, channel.time[-1] + 1.0)
        steps = windows.time[w] + windows.timestep * np.arange(windows.steps + 1) - late
        before = np.minimum(steps - edges[0], 0.0) * channel.values[0]
        return np.diff(np.interp(steps, edges, whole) + before) / windows.timestep

    def _residual(
        self, params: Any, predicted: Any, measured: Any, model: Any, every: bool, *, state: Any,
        **_: Any,
    ) -> tuple[np.ndarray, Any, Any]:  # fmt: skip
        """Return recorded minus predicted positions in sigma."""
        windows = self.problem.windows
        columns, channels = [], windows.channels
        moments = state[:, 0]
        for c, channel in enumerate(channels):
            joint = model.joint(channel.removeprefix("qpos."))
            late = sum(
                float(params[str(k)].value[0] * _scale_of(m)[0])
                for k, m in self.late.items()
                if m.site.name == channel
            )
            shown = np.interp(measured.times - late, moments, state[:, 1 + joint.qposadr[0]])
            columns.append((measured.data[:, c] - shown) / self.sigma[c])
        return np.nan_to_num(np.stack(columns, axis=1), nan=1e3), measured, measured


_LAG = int(mujoco.mjtDyn.mjDYN_FILTEREXACT)


def _scale_of(c: Candidate) -> Float[np.ndarray, " l"]:
    """Return the unit in which a magnitude is fitted: its probe."""
    return np.where(c.probe == 0, 1.0, np.abs(c.probe))
