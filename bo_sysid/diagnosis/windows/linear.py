"""The linear time-varying model along a prediction.

The simulator is linearised every few steps by one-step finite differences, s⁺ = A s + w: w is what
is added in a step, such as B times a force or E times a change of control. A change of start is a
nuisance: J₀, the response to the start, is projected out of everything, window by window,
P = I - QQᵀ with Q = orth(J₀).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.points import (
    StatePoints,
    control_matrix,
    force_matrix,
    points_along,
    state_matrix,
)
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.diagnosis.windows.process_noise import ProcessNoise
from bo_sysid.diagnosis.windows.reference_motion import Along, smoothed
from bo_sysid.effects import Part
from bo_sysid.effects.parts import Reading
from bo_sysid.effects.readings import readings
from bo_sysid.mjcf.commands import controlled, lags
from bo_sysid.simulation import (
    State,
    Trajectory,
    tangent_difference,
)

_GRID = 0.002  # [s] length of a macro step of the linear model
_HOLD = 0.008  # [s] over which its matrices are held
_MOVED = 1e-5  # [rad], [m] and their rates, by which a start is moved along a loop
_UNSEEN = 0.5  # [sigma] of a window below which that is not fitted


@dataclass(frozen=True)
class Linear:
    """The linear time-varying model along the prediction of a hypothesis.

    Attributes:
        problem: what is predicted.
        hypothesis: the point of linearisation.
        start: the starts.
        trajectory: the prediction.
        parts: of the hypothesis.
        macro: simulation steps in a macro step.
        hold: macro steps over which the matrices are held; K = M / hold, rounded up.
        A: `W x K x n x n` with n = 2 nv + na of the edited model.
        ctrl: `W x S x nu` controls of the hypothesis, before controllers write theirs.
        points: the states at which it was linearised.
        J: `W x R x k` response to the start, in sigma: 2 nv nominal coordinates, and those of
            joints that the hypothesis added.
        Q: `W x R x k` orthonormal basis of the response to the start, zero where an added
            joint's start does nothing that could be seen.
        start_gain: `W x k x R` least-squares change of start per residual.
    """

    problem: Problem
    hypothesis: Hypothesis
    start: State
    trajectory: Trajectory
    parts: tuple[Part, ...]
    macro: int
    hold: int
    A: Float[np.ndarray, "W K n n"]
    ctrl: Float[np.ndarray, "W S nu"]
    points: StatePoints
    J: Float[np.ndarray, "W R k"]
    Q: Float[np.ndarray, "W R k"]
    start_gain: Float[np.ndarray, "W k R"]

    @property
    def macros(self) -> int:
        """Number M of macro steps."""
        return int(self.ctrl.shape[1] // self.macro)

    @cached_property
    def B(self) -> Float[np.ndarray, "W K n nv"]:  # noqa: N802
        """The response of a macro step to a unit of force on each nominal coordinate."""
        return force_matrix(self.problem, self.points, len(self.start))

    @cached_property
    def E(self) -> Float[np.ndarray, "W K n nu"]:  # noqa: N802
        """The response of a macro step to a unit of each control."""
        return control_matrix(self.problem, self.points, len(self.start))

    @cached_property
    def residual(self) -> Float[np.ndarray, "W R"]:
        """What was recorded less the prediction, in sigma."""
        return self.problem.residual(self.hypothesis, self.start)

    @cached_property
    def along(self) -> Along:
        """The motion at the beginning of every macro step."""
        rows = slice(0, self.macros * self.macro, self.macro)
        p, model = self.problem, self.problem.machine.model
        joints = p.machine.joints.values()
        qpos = {
            j.name: self.trajectory.qpos[:, rows, int(model.joint(j.name).qposadr[0])]
            for j in joints
        }
        qvel = {j.name: self.trajectory.qvel[:, rows, j.dof] for j in joints}
        names = [c.removeprefix("ctrl.") for c in p.model.ctrl_channels]
        written = self.ctrl if self.trajectory.ctrl is None else self.trajectory.ctrl
        at = np.minimum(np.arange(self.macros) * self.macro, written.shape[1] - 1)
        ctrl = {n: written[:, at, i] for i, n in enumerate(names)}
        signals = {n: s[:, rows] for n, s in p.windows.signals.items()}
        lagging = {model.actuator(a).name: a for a in controlled(model) if lags(model, a)}
        act = {
            n: self.trajectory.act[:, rows, int(model.actuator_actadr[a])]
            for n, a in lagging.items()
        }
        step = self.macro * p.windows.timestep
        time = np.broadcast_to(np.arange(self.macros) * step, (len(p.windows), self.macros))
        return Along(qpos, qvel, ctrl, signals, time, step, act)

    @cached_property
    def recorded(self) -> Along:
        """The motion as it was recorded: the prediction and a smooth deviation from it."""
        p = self.problem
        deviation = p.deviation(self.hypothesis, self.start).reshape(p.weight.shape)
        seen = p.weight > 0
        deviation = np.divide(deviation, p.weight, out=np.zeros(seen.shape), where=seen)
        time = (p.windows.step + p.windows.fraction) * p.windows.timestep
        qpos, qvel = dict(self.along.qpos), dict(self.along.qvel)
        for k, name in enumerate(p.windows.channels):
            joint = name.removeprefix("qpos.")
            if joint in qpos and name in p.layout.qpos:
                moved, rate = smoothed(time, deviation[..., k], seen[..., k], self.along.time)
                qpos[joint], qvel[joint] = qpos[joint] + moved, qvel[joint] + rate
        return replace(self.along, qpos=qpos, qvel=qvel, memory={})

    def rows(self, keep: Bool[np.ndarray, " W"]) -> "Linear":
        """Return the linear model of some windows."""
        if keep.all():
            return self
        return replace(
            self,
            problem=self.problem.rows(keep),
            start=self.start.rows(keep),
            trajectory=self.trajectory.rows(keep),
            A=self.A[keep],
            ctrl=self.ctrl[keep],
            points=self.points.rows(np.repeat(keep, self.A.shape[1])),
            J=self.J[keep],
            Q=self.Q[keep],
            start_gain=self.start_gain[keep],
        )

    def observing(self, problem: Problem) -> "Linear":
        """Return the linear model of the same windows with other weights."""
        seen = self.problem.weight > 0
        ratio = np.divide(problem.weight, self.problem.weight, out=np.zeros(seen.shape), where=seen)
        J = self.J * ratio.reshape(len(ratio), -1, 1)
        return replace(self, problem=problem)._responding(J)

    def with_process(self, process: ProcessNoise) -> "Linear":
        """Return the linear model of the same windows, in units of all noise."""
        made = replace(self, problem=replace(self.problem, process=process))
        return made._responding(process.whiten(self.J))

    def _responding(self, J: Float[np.ndarray, "W R k"]) -> "Linear":
        """Return the linear model with a response to the start, and what follows from it."""
        Q, R = np.linalg.qr(J)
        coordinates = self.points.coordinates
        if coordinates.second or self.problem.loops:
            own = np.abs(np.diagonal(R, axis1=1, axis2=2))
            own = own * coordinates.reach(self.problem.machine)
            Q = Q * (own > _UNSEEN)[:, None, :]
        gain = np.linalg.pinv(R, rcond=1e-10) @ Q.transpose(0, 2, 1)
        return replace(self, J=J, Q=Q, start_gain=gain)

    def held(self, values: np.ndarray) -> np.ndarray:
        """Return values given every `hold` macro steps for each macro step."""
        return np.asarray(values[:, np.arange(self.macros) // self.hold])

    def propagate(
        self, w: Float[np.ndarray, "W M n c"] | None, s0: Float[np.ndarray, "W n c"] | None = None
    ) -> Float[np.ndarray, "W M1 n c"]:
        """Return s⁺ = A s + w from s0, at the macro steps."""
        W, n = len(self.start), self.A.shape[-1]
        given = w if w is not None else s0
        assert given is not None  # noqa: S101
        s = np.zeros((W, n, given.shape[-1])) if s0 is None else s0
        out = np.empty((W, self.macros + 1, n, given.shape[-1]))
        out[:, 0] = s
        with np.errstate(over="ignore", invalid="ignore"):  # windows that diverge
            for k in range(self.macros):
                s = self.A[:, k // self.hold] @ s
                if w is not None:
                    s += w[:, k]
                out[:, k + 1] = s
        return out

    def shown(self, s: Float[np.ndarray, "W M1 n c"]) -> Float[np.ndarray, "W R c"]:
        """Return what the channels show of a change of state, in units of all noise."""
        return self.problem.whitened(self.seen(s))

    def seen(self, s: Float[np.ndarray, "W M1 n c"]) -> Float[np.ndarray, "W R c"]:
        """Return what the channels show of a change of state, in sigma of the sensors.

        The hypothesis' readings show it as well: (1 + scale)·δ(t - delay).
        """
        p = self.problem
        if not self.points.coordinates.same:
            s = self.points.coordinates.seen() @ s
        read = readings(self.parts)
        out = np.empty((*p.weight.shape, s.shape[-1]))
        with np.errstate(over="ignore", invalid="ignore"):  # windows that diverge
            for k, name in enumerate(p.windows.channels):
                reading = read.get(name, Reading(name))
                values = self._later(s, reading.source or name, reading.delay)
                out[:, :, k] = (1.0 + reading.scale) * values
            out *= np.where(p.seen(self.parts), p.weight, 0.0)[..., None]
        return out.reshape(len(out), -1, s.shape[-1])

    def _turned(
        self, s: Float[np.ndarray, "W M1 n c"], channel: str
    ) -> Float[np.ndarray, "W M1 c"]:
        """Return the change of one number of a quaternion, from that of the orientation."""
        q, v, number = self.problem.layout.turns[channel]
        last = self.trajectory.qpos.shape[1] - 1
        rows = np.minimum(np.arange(self.macros + 1) * self.macro, last)
        G = _quaternion_rate(self.trajectory.qpos[:, rows, q : q + 4])[..., number, :]
        return np.asarray(np.einsum("wmj,wmjc->wmc", G, s[:, :, v : v + 3]))

    def _later(
        self, s: Float[np.ndarray, "W M1 n c"], channel: str, delay: float
    ) -> Float[np.ndarray, "W H c"]:
        """Return the change of what a channel measures, `delay` after it.

        Between macro steps it bends as its velocity says; before the window it goes on with the
        acceleration at its start. A channel may show joints that nothing else measures as well.
        """
        p, nv = self.problem, self.problem.machine.model.nv
        position = channel not in p.layout.turns
        shows = (p.layout.qpos[channel], *p.layout.also.get(channel, ()))
        columns = p.layout.velocity[list(shows)] if position else np.empty(0, int)
        values = s[:, :, columns].sum(axis=2) if position else self._turned(s, channel)
        rates = s[:, :, nv + columns].sum(axis=2)
        length = self.macro * p.windows.timestep
        at = (p.windows.step + p.windows.fraction) / self.macro - delay / length
        inside = np.maximum(at, 0.0)
        node = np.minimum(np.floor(inside + 1e-9).astype(int), self.macros)
        after = np.minimum(node + 1, self.macros)
        part = np.clip(inside - node, 0.0, 1.0)[..., None]
        row = np.arange(len(node))[:, None]
        out = values[row, node]
        if (part > 1e-9).any():
            out = out + part * (values[row, after] - values[row, node])
            if position:
                bend = rates[row, after] - rates[row, node]
                out -= 0.5 * part * (1 - part) * length * bend
        if delay and position:
            before, v = np.minimum(at, 0.0)[..., None], rates[:, :2]
            out = out + length * before * (v[:, :1] + 0.5 * before * (v[:, 1:] - v[:, :1]))
        return np.asarray(out)


def _quaternion_rate(q: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 4 3"]:
    """Return G of dq = G dθ for a rotation dθ in the body's frame: half of q times (0, dθ)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]
    return np.asarray(0.5 * np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def _along_loops(problem: Problem, start: State) -> Float[np.ndarray, "W n n"]:
    """Return how starts move with their free coordinates, by differences; 0 for what follows."""
    model, loops, W = problem.machine.model, problem.loops, len(start)
    nv = model.nv
    out = np.zeros((W, 2 * nv, 2 * nv))
    at = start.closed(loops)
    for k in np.delete(np.arange(2 * nv), np.concatenate([loops.dofs, nv + loops.dofs])):
        moved = problem.moved(at, np.tile(_MOVED * np.eye(2 * nv)[k], (W, 1)))
        out[:, :nv, k] = tangent_difference(model, moved.qpos, at.qpos) / _MOVED
        out[:, nv:, k] = (moved.qvel - at.qvel) / _MOVED
    return out


def linearise(problem: Problem, hypothesis: Hypothesis, start: State) -> Linear:
    """Linearise the simulator along the prediction of a hypothesis."""
    s = problem.simulate(hypothesis, start)
    macro = max(round(_GRID / s.windows.timestep), 1)
    hold = max(round(_HOLD / (macro * s.windows.timestep)), 1)
    spare = -s.ctrl.shape[1] % macro
    ctrl = np.pad(s.ctrl, ((0, 0), (0, spare), (0, 0)), mode="edge")
    points = points_along(problem, s, ctrl, macro, hold)
    W = len(start)
    A = state_matrix(points, W)
    empty = np.zeros((W, problem.count, 0))
    linear = Linear(
        problem, hypothesis, start, s.trajectory, s.parts, macro, hold, A, ctrl, points,
        empty, empty, empty.transpose(0, 2, 1),
    )  # fmt: skip
    moves = np.tile(s.coordinates.tangent(), (W, 1, 1))
    if problem.loops:
        nominal = slice(0, 2 * problem.machine.model.nv)
        moves[..., nominal] = moves[..., nominal] @ _along_loops(problem, start)
    J = np.clip(np.nan_to_num(linear.shown(linear.propagate(None, moves))), -1e12, 1e12)
    return linear._responding(J)
