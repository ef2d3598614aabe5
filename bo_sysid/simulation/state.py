"""Values that enter and leave a simulation: starts of windows and trajectories."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from bo_sysid.arrays import Act, Qpos, Qvel
from bo_sysid.mjcf import Loops
from bo_sysid.mjcf.joints import BALL, FREE
from bo_sysid.simulation.delays import load_past


@dataclass(frozen=True)
class State:
    """The state of W simulations, in MuJoCo's order and units.

    Attributes:
        qpos: `W x nq` positions in [m], [rad] or quaternions.
        qvel: `W x nv` velocities in [m/s] or [rad/s].
        act: `W x na` activations of actuators with memory.
        warmstart: `W x nv` accelerations that warm-start the constraint solver; with them a
            prediction repeats the recorded step to the last bit.
        added: `W x 2 s` how far s joints beyond these coordinates are from where they rest, then
            their speeds; None where they rest.
        past: `W x D x nu` controls of the last D steps, the oldest first, on which delayed
            actuators still have to act; None where the model has none.
    """

    qpos: Qpos
    qvel: Qvel
    act: Act
    warmstart: Qvel | None = None
    added: Float[np.ndarray, "W s2"] | None = None
    past: Float[np.ndarray, "W D nu"] | None = None

    def __post_init__(self) -> None:
        count = len(self.qpos)
        if len(self.qvel) != count or len(self.act) != count:
            raise ValueError(
                f"qpos, qvel and act have {count}, {len(self.qvel)} and {len(self.act)} rows"
            )

    def __len__(self) -> int:
        return len(self.qpos)

    @classmethod
    def concatenated(cls, states: Sequence["State"]) -> "State":
        """Return several sets of states as one, without the fields that any of them lacks."""
        known = [s.arrays for s in states]
        shared = [name for name in known[0] if all(name in arrays for arrays in known)]
        return cls.of({name: np.concatenate([arrays[name] for arrays in known]) for name in shared})

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "State":
        """Return the states with these `arrays` by field name; other names are ignored."""
        return cls(**{f.name: arrays[f.name] for f in fields(cls) if f.name in arrays})

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that are not None, by field name."""
        known = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in known.items() if value is not None}

    def repeat(self, times: int) -> "State":
        """Return the whole set of states `times` times over, `times * W` rows."""
        return State.of({name: np.concatenate([x] * times) for name, x in self.arrays.items()})

    def rows(self, index: np.ndarray | slice) -> "State":
        """Return the states of some windows."""
        return State.of({name: x[index] for name, x in self.arrays.items()})

    def picked(self, pick: Bool[np.ndarray, " W"], other: "State") -> "State":
        """Return these states with positions and velocities of `other` where `pick` is True.

        Activations and past controls stay these; warm starts are dropped. Added joints are those of
        `other` where it has some, else these; a state that does not have them has them at rest.

        Args:
            pick: `W` flags.
            other: `W` states of the same model.
        """
        p = pick[:, None]
        added = self.added if other.added is None else other.added
        if added is not None:
            mine, theirs = (
                s.added if s.added is not None and s.added.shape == added.shape else 0.0 * added
                for s in (self, other)
            )
            added = np.where(p, theirs, mine)
        return replace(
            self,
            qpos=np.where(p, other.qpos, self.qpos),
            qvel=np.where(p, other.qvel, self.qvel),
            warmstart=None,
            added=added,
        )

    def placed(self, rows: Int[np.ndarray, " L"], other: "State") -> "State":
        """Return these states with `L` of them replaced, as `picked` replaces them.

        Args:
            rows: which ones; none leaves the states as they are, warm starts included.
            other: the `L` states that take their place.
        """
        pick, place = np.zeros(len(self), bool), np.zeros(len(self), int)
        pick[rows], place[rows] = True, np.arange(len(rows))
        return self.picked(pick, other.rows(place)) if len(rows) else self

    def moved(self, model: mujoco.MjModel, tangent: Float[np.ndarray, "W n"]) -> "State":
        """Return the states moved along their tangent space.

        Args:
            model: gives the joints; quaternions are turned as `mj_integratePos` turns them.
            tangent: `W x 2 nv`, change of position in [m] or [rad], then change of velocity; what
                follows is a change of `added`, left out where these starts have others.
        """
        nv = model.nv
        plain, moves, turns = _coordinates(model)
        qpos = np.array(self.qpos, float)
        qpos[:, plain] += tangent[:, moves]
        for q, v in turns:
            at = Rotation.from_quat(qpos[:, q : q + 4], scalar_first=True)
            turned = at * Rotation.from_rotvec(tangent[:, v : v + 3])
            qpos[:, q : q + 4] = turned.as_quat(scalar_first=True)
        added, more = self.added, tangent[:, 2 * nv :]
        if more.shape[1] and (added is None or added.shape == more.shape):
            added = more if added is None else added + more
        qvel = self.qvel + tangent[:, nv : 2 * nv]
        return replace(self, qpos=qpos, qvel=qvel, warmstart=None, added=added)

    def begin(self, data: mujoco.MjData, w: int, ctrl: Float[np.ndarray, " nu"]) -> None:
        """Put simulation data that were reset, or were never stepped, where one state is.

        Args:
            data: to be changed; buffers of delays are filled as a rollout fills them.
            w: number of the state.
            ctrl: controls from there on.
        """
        data.qpos[:], data.qvel[:], data.act[:] = self.qpos[w], self.qvel[w], self.act[w]
        data.ctrl[:] = ctrl
        if data.model.nhistory:
            past = ctrl[None] if self.past is None else self.past[w]
            load_past(data.model, data.history[None], past[None])

    def closed(self, loops: Loops) -> "State":
        """Return the states with the joints that follow through loops where these close."""
        if not loops:
            return self
        qpos, qvel = loops.closed(self.qpos, self.qvel)
        return replace(self, qpos=qpos, qvel=qvel, warmstart=None)


@dataclass(frozen=True)
class Trajectory:
    """What W simulations did over S steps; index 0 is the start.

    Attributes:
        qpos: `W x (S+1) x nq`.
        qvel: `W x (S+1) x nv`.
        act: `W x (S+1) x na`.
        sensordata: `W x (S+1) x nsensordata` where sensors were asked for, else None.
        diverged: `W` flags: MuJoCo warned (bad position, velocity or acceleration, a full
            buffer) or raised; from there on the rows repeat one state, and mean nothing.
        ctrl: `W x S x nu` controls as controllers wrote them, None where none did.
    """

    qpos: Float[np.ndarray, "W S1 nq"]
    qvel: Float[np.ndarray, "W S1 nv"]
    act: Float[np.ndarray, "W S1 na"]
    sensordata: Float[np.ndarray, "W S1 ns"] | None
    diverged: Bool[np.ndarray, " W"]
    ctrl: Float[np.ndarray, "W S nu"] | None = None

    @classmethod
    def concatenated(cls, parts: Sequence["Trajectory"]) -> "Trajectory":
        """Return several sets of trajectories as one, all with sensors and controls or none."""
        joined: dict[str, Any] = {}
        for name in (f.name for f in fields(cls)):
            own = [getattr(p, name) for p in parts]
            joined[name] = None if own[0] is None else np.concatenate(own)
        return cls(**joined)

    def rows(self, index: np.ndarray | slice) -> "Trajectory":
        """Return the trajectories of some windows."""
        sensors = None if self.sensordata is None else self.sensordata[index]
        return replace(
            self,
            qpos=self.qpos[index],
            qvel=self.qvel[index],
            act=self.act[index],
            sensordata=sensors,
            diverged=self.diverged[index],
            ctrl=None if self.ctrl is None else self.ctrl[index],
        )


def tangent_difference(
    model: mujoco.MjModel, left: Float[np.ndarray, "... nq"], right: Float[np.ndarray, "... nq"]
) -> Float[np.ndarray, "... nv"]:
    """Return `left - right` in the tangent space of the joints, in [m] or [rad].

    Hinge and slide joints subtract; of quaternions it is the rotation vector from right to left, in
    the frame of the body, as `mj_differentiatePos` has it.
    """
    if model.nq == model.nv:
        return np.asarray(left - right)
    shape = np.broadcast_shapes(left.shape, right.shape)
    flat_left = np.broadcast_to(left, shape).reshape(-1, model.nq)
    flat_right = np.broadcast_to(right, shape).reshape(-1, model.nq)
    plain, moves, turns = _coordinates(model)
    out = np.empty((len(flat_left), model.nv))
    out[:, moves] = flat_left[:, plain] - flat_right[:, plain]
    for q, v in turns:
        one, two = (
            Rotation.from_quat(values[:, q : q + 4], scalar_first=True)
            for values in (flat_right, flat_left)
        )
        out[:, v : v + 3] = (one.inv() * two).as_rotvec()
    return out.reshape(*shape[:-1], model.nv)


def _coordinates(
    model: mujoco.MjModel,
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"], tuple[tuple[int, int], ...]]:
    """Return columns of qpos that add, those of qvel that move them, and (qpos, qvel) of turns."""
    plain: list[int] = []
    moves: list[int] = []
    turns: list[tuple[int, int]] = []
    for j in range(model.njnt):
        q, v, kind = (int(a[j]) for a in (model.jnt_qposadr, model.jnt_dofadr, model.jnt_type))
        count = {FREE: 3, BALL: 0}.get(kind, 1)
        plain += range(q, q + count)
        moves += range(v, v + count)
        if count != 1:
            turns.append((q + count, v + count))
    return np.array(plain, int), np.array(moves, int), tuple(turns)
