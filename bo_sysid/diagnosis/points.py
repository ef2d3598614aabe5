"""The states along a prediction at which the simulator is stepped for finite differences."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.coordinates import Coordinates
from bo_sysid.diagnosis.problem import Problem, Simulated, force_laws
from bo_sysid.simulation import Controller, Engine, ForceLaw, State, tangent_difference

_MOVE, _TURN = 1e-5, 1e-4  # perturbation of positions and of velocities
_FORCE = 1e-2  # of the joint's typical force


@dataclass(frozen=True)
class Points:
    """The states, one each `hold` macro steps, at which the model is stepped for differences.

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

    def stepped(
        self,
        model: mujoco.MjModel | None = None,
        state: State | None = None,
        ctrl: np.ndarray | None = None,
        force: np.ndarray | None = None,
    ) -> Float[np.ndarray, "P n"]:
        """Return the nominal coordinates after one macro step, positions from where it began."""
        model = model or self.model
        t = self.engine.rollout(
            model,
            state or self.state,
            self.ctrl if ctrl is None else ctrl,
            force=force,
            laws=self.laws,
            signals=self.signals,
        )
        at, c = self.state, self.coordinates
        moved = tangent_difference(model, t.qpos[:, -1], at.qpos)
        speed = t.qvel[:, -1]
        shown_moved, shown_speed = moved[:, c.qvel], speed[:, c.qvel]
        for _, v, _, hidden, share in c.shown:
            shown_moved[:, v] += share * moved[:, hidden]
            shown_speed[:, v] += share * speed[:, hidden]
        return np.concatenate([shown_moved, shown_speed, t.act[:, -1][:, c.act]], axis=1)

    def perturbed(self, k: int, size: float) -> State:
        """Return the states with one nominal coordinate changed: position, velocity, activation."""
        nv = len(self.coordinates.qvel)
        if k >= 2 * nv:
            act = self.state.act.copy()
            act[:, self.coordinates.act[k - 2 * nv]] += size
            return replace(self.state, act=act)
        tangent = np.zeros((len(self.state), 2 * self.model.nv))
        column = int(self.coordinates.qvel[k % nv])
        tangent[:, column if k < nv else self.model.nv + column] = size
        return self.state.moved(self.model, tangent)


def points_along(problem: Problem, s: Simulated, ctrl: np.ndarray, macro: int, hold: int) -> Points:
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
    points = Points(
        s.model,
        s.coordinates,
        Engine(problem.engine.threads),
        (*problem.laws, *force_laws(s.parts)),
        state,
        ctrl[:, inputs].reshape(len(state), macro, ctrl.shape[-1]),
        signals,
        np.zeros((len(state), 2 * len(s.coordinates.qvel) + len(s.coordinates.act))),
    )
    return replace(points, base=points.stepped())


def matrices(problem: Problem, points: Points, W: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how a macro step changes with the state, a force and a control.

    Returns:
        A `W x K x n x n`, B `W x K x n x nv` and E `W x K x n x nu`, by one-sided differences.
    """
    c = points.coordinates
    nv, n, P = len(c.qvel), points.base.shape[1], len(points.state)
    A, B = np.empty((P, n, n)), np.empty((P, n, nv))
    E = np.empty((P, n, points.ctrl.shape[-1]))
    for k in range(n):
        size = _MOVE if k < nv else _TURN
        A[..., k] = (points.stepped(state=points.perturbed(k, size)) - points.base) / size
    scale = {j.dof: j.force for j in problem.machine.joints.values()}
    for k in range(nv):
        size = _FORCE * scale.get(k, 1.0)
        force = np.zeros((P, points.ctrl.shape[1], points.model.nv))
        force[..., c.qvel[k]] = size
        B[..., k] = (points.stepped(force=force) - points.base) / size
    for k, name in enumerate(problem.model.ctrl_channels):
        actuator = problem.machine.actuators.get(name.removeprefix("ctrl."))
        size = 1e-3 * max(actuator.ctrl_max if actuator else 1.0, 1e-6)
        ctrl = points.ctrl.copy()
        ctrl[..., k] += size
        E[..., k] = (points.stepped(ctrl=ctrl) - points.base) / size
    return tuple(a.reshape(W, P // W, *a.shape[1:]) for a in (A, B, E))  # type: ignore[return-value]


def differ(one: mujoco.MjModel, two: mujoco.MjModel) -> bool:
    """Whether two compiled models differ in anything."""
    size = mujoco.mj_sizeModel(one)
    if size != mujoco.mj_sizeModel(two):
        return True
    buffers = [np.empty(size, np.uint8) for _ in range(2)]
    mujoco.mj_saveModel(one, None, buffers[0])
    mujoco.mj_saveModel(two, None, buffers[1])
    return bool((buffers[0] != buffers[1]).any())
