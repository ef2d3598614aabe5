"""The states along a prediction at which the simulator is stepped for finite differences."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.diagnosis.windows.coordinates import Coordinates
from bo_sysid.diagnosis.windows.problem import Problem, Simulated
from bo_sysid.mjcf.commands import clamped
from bo_sysid.simulation import Controller, Engine, ForceLaw, State, tangent_difference
from bo_sysid.simulation.lockstep import force_laws

_MOVE, _TURN = 1e-5, 1e-4  # perturbation of positions and of velocities
_FORCE = 1e-2  # of the joint's typical force


@dataclass(frozen=True)
class StatePoints:
    """The states, one each `hold` macro steps, at which the model is stepped for differences.

    A state has n = 2 nv + na numbers: positions, speeds and activations of the edited model.
    Controls before it are not among them: actuators that MJCF delays act at once.

    Attributes:
        model: of the hypothesis.
        coordinates: where it keeps the nominal coordinates.
        engine: steps it.
        laws: of the nominal model and of the hypothesis.
        state: `P` states of that model.
        ctrl: controls during the macro step.
        signals: recorded inputs during it.
        base: where the macro step ends.
    """

    model: mujoco.MjModel
    coordinates: Coordinates
    engine: Engine
    laws: tuple[Controller | ForceLaw, ...]
    state: State
    ctrl: Float[np.ndarray, "P macro nu"]
    signals: Mapping[str, Float[np.ndarray, "P macro"]]
    base: Float[np.ndarray, "P n"]

    def rows(self, keep: Bool[np.ndarray, " P"]) -> "StatePoints":
        """Return some of the points."""
        return replace(
            self,
            state=self.state.rows(keep),
            ctrl=self.ctrl[keep],
            signals={name: values[keep] for name, values in self.signals.items()},
            base=self.base[keep],
        )

    def stepped(
        self,
        model: mujoco.MjModel | None = None,
        state: State | None = None,
        ctrl: np.ndarray | None = None,
        force: np.ndarray | None = None,
    ) -> Float[np.ndarray, "P n"]:
        """Return the states after one macro step, positions from where it began."""
        model = model or self.model
        t = self.engine.rollout(
            model,
            state or self.state,
            self.ctrl if ctrl is None else ctrl,
            force=force,
            laws=self.laws,
            signals=self.signals,
        )
        moved = tangent_difference(model, t.qpos[:, -1], self.state.qpos)
        return np.concatenate([moved, t.qvel[:, -1], t.act[:, -1]], axis=1)

    def perturbed(self, k: int, size: float) -> State:
        """Return the states with one number changed: position, speed or activation."""
        nv = self.model.nv
        if k >= 2 * nv:
            act = self.state.act.copy()
            act[:, k - 2 * nv] += size
            return replace(self.state, act=act)
        tangent = np.zeros((len(self.state), 2 * nv))
        tangent[:, k] = size
        return self.state.moved(self.model, tangent)


def points_along(
    problem: Problem, s: Simulated, ctrl: np.ndarray, macro: int, hold: int
) -> StatePoints:
    """Return the points of a simulation, one each `hold` macro steps of `macro` steps."""
    last = s.whole.qpos.shape[1] - 1
    rows = np.minimum(np.arange(0, ctrl.shape[1] // macro, hold) * macro, last)

    def flat(values: np.ndarray) -> np.ndarray:
        return values[:, rows].reshape(len(values) * len(rows), values.shape[-1])

    state = State(flat(s.whole.qpos), flat(s.whole.qvel), flat(s.whole.act))
    inputs = rows[:, None] + np.arange(macro)
    spare = ctrl.shape[1] - s.ctrl.shape[1]
    signals = {
        n: np.pad(v, ((0, 0), (0, spare)), mode="edge")[:, inputs].reshape(-1, macro)
        for n, v in s.windows.signals.items()
    }
    points = StatePoints(
        s.model,
        s.coordinates,
        Engine(problem.engine.threads),
        (*problem.laws, *force_laws(s.parts)),
        state,
        ctrl[:, inputs].reshape(len(state), macro, ctrl.shape[-1]),
        signals,
        np.zeros((len(state), 2 * s.model.nv + s.model.na)),
    )
    return replace(points, base=points.stepped())


def state_matrix(points: StatePoints, W: int) -> Float[np.ndarray, "W K n n"]:
    """Return how a macro step changes with the state, by one-sided differences."""
    P, n = points.base.shape
    A = np.empty((P, n, n))
    for k in range(n):
        size = _MOVE if k < points.model.nv else _TURN
        A[..., k] = (points.stepped(state=points.perturbed(k, size)) - points.base) / size
    return A.reshape(W, P // W, n, n)


def force_matrix(problem: Problem, points: StatePoints, W: int) -> Float[np.ndarray, "W K n nv"]:
    """Return how a macro step changes with a force on each nominal coordinate."""
    c = points.coordinates
    nv, (P, n) = len(c.qvel), points.base.shape
    B = np.empty((P, n, nv))
    scale = {j.dof: j.force for j in problem.machine.joints.values()}
    for k in range(nv):
        size = _FORCE * scale.get(k, 1.0)
        force = np.zeros((P, points.ctrl.shape[1], points.model.nv))
        force[..., c.qvel[k]] = size
        B[..., k] = (points.stepped(force=force) - points.base) / size
    return B.reshape(W, P // W, n, nv)


def control_matrix(problem: Problem, points: StatePoints, W: int) -> Float[np.ndarray, "W K n nu"]:
    """Return how a macro step changes with each control, within its limits."""
    P, n = points.base.shape
    E = np.empty((P, n, points.ctrl.shape[-1]))
    for k, name in enumerate(problem.model.ctrl_channels):
        actuator = problem.machine.actuators.get(name.removeprefix("ctrl."))
        size = 1e-3 * max(actuator.ctrl_max if actuator else 1.0, 1e-6)
        ctrl = clamped(points.model, points.ctrl)
        ctrl[..., k] += size
        over = (clamped(points.model, ctrl) != ctrl).any(axis=(1, 2))  # there it moves inwards
        ctrl[over, :, k] -= 2 * size
        step = np.where(over, -size, size)[:, None]
        E[..., k] = (points.stepped(ctrl=ctrl) - points.base) / step
    return E.reshape(W, P // W, *E.shape[1:])
