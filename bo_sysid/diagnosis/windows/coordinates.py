"""States of a model that an effect gave further joints or activations, beside the nominal ones.

What no recording shows begins where it would be at rest: a second joint between motor and link
where the torque that the motor hands on holds it (`transmitted`), with no speed of its own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.effects import Hidden, Machine, Part
from bo_sysid.mjcf.joints import QVEL_SIZE
from bo_sysid.simulation import State, Trajectory

_OFF = 0.1  # of the spread of a joint's position and of its speed: prior of an added joint
_ANY = 1e12
_PLACES = (0.5, 0.0, -0.5)  # of where an added joint rests, tried as its start


@dataclass(frozen=True)
class SeriesElastic:
    """Where the coordinates of an added joint are, and of the joint whose axis it shares.

    Attributes:
        qpos: column of the joint that it shares the axis of, in the nominal `qpos`.
        qvel: the same in the nominal `qvel`.
        own_qpos: its own column in the edited `qpos`.
        own_qvel: the same in the edited `qvel`.
        shown: how much of it the encoder shows.
        under: from a torque to where it is at rest.
        most: how far from zero it can be.
    """

    qpos: int
    qvel: int
    own_qpos: int
    own_qvel: int
    shown: float
    under: Callable[[np.ndarray], np.ndarray]
    most: float


@dataclass(frozen=True)
class Coordinates:
    """Where an edited model keeps the coordinates of the nominal one.

    Attributes:
        rest: `qpos` of the edited model at rest.
        qpos: column of the edited model for each nominal column of `qpos`.
        qvel: the same for `qvel`.
        act: the same for `act`.
        sizes: nq, nv and na of the edited model.
        second: the joints that were added on the axes of others.
    """

    rest: Float[np.ndarray, " q"]
    qpos: Int[np.ndarray, " nq"]
    qvel: Int[np.ndarray, " nv"]
    act: Int[np.ndarray, " na"]
    sizes: tuple[int, int, int]
    second: tuple[SeriesElastic, ...]

    @classmethod
    def between(
        cls, nominal: mujoco.MjModel, edited: mujoco.MjModel, parts: Sequence[Part]
    ) -> "Coordinates":
        """Find the nominal coordinates in an edited model by the names of joints."""
        qpos, qvel = [], []
        for j in range(nominal.njnt):
            there = edited.joint(nominal.joint(j).name)
            here = nominal.joint(j)
            qpos += [int(there.qposadr[0]) + k for k in range(len(here.qpos0))]
            qvel += [int(there.dofadr[0]) + k for k in range(_speeds(nominal, j))]
        act = [
            int(edited.actuator_actadr[edited.actuator(nominal.actuator(a).name).id]) + k
            for a in range(nominal.nactuator)
            for k in range(int(nominal.actuator_actnum[a]))
        ]
        second = tuple(
            SeriesElastic(
                int(nominal.joint(p.of).qposadr[0]),
                int(nominal.joint(p.of).dofadr[0]),
                int(edited.joint(p.joint).qposadr[0]),
                int(edited.joint(p.joint).dofadr[0]),
                p.shown,
                p.under,
                p.most,
            )
            for p in parts
            if isinstance(p, Hidden)
        )
        sizes = (edited.nq, edited.nv, edited.na)
        return cls(
            edited.qpos0.copy(),
            np.array(qpos, int),
            np.array(qvel, int),
            np.array(act, int),
            sizes,
            second,
        )

    @property
    def same(self) -> bool:
        """Whether the edited model has the nominal coordinates and no others."""
        return self.sizes == (len(self.qpos), len(self.qvel), len(self.act))

    def expand(self, state: State, torque: Float[np.ndarray, "W nv"] | None) -> State:
        """Return nominal states as states of the edited model.

        Args:
            state: as the encoders show it.
            torque: that is transmitted at each nominal coordinate; nothing, where it is None.
        """
        if self.same:
            return state
        count = len(state)
        qpos = np.tile(self.rest, (count, 1))
        qvel, act = np.zeros((count, self.sizes[1])), np.zeros((count, self.sizes[2]))
        qpos[:, self.qpos], qvel[:, self.qvel], act[:, self.act] = state.qpos, state.qvel, state.act
        kinds = len(self.second)
        if state.added is not None and state.added.shape[1] == 2 * kinds:
            away, speed = state.added[:, :kinds], state.added[:, kinds:]
        else:
            away, speed = np.zeros((count, kinds)), np.zeros((count, kinds))
        for k, s in enumerate(self.second):
            there = away[:, k] + (0.0 if torque is None else s.under(torque[:, s.qvel]))
            there = np.clip(there, -s.most, s.most)
            qpos[:, s.own_qpos] += there
            qpos[:, self.qpos[s.qpos]] -= s.shown * there
            qvel[:, s.own_qvel] += speed[:, k]
            qvel[:, self.qvel[s.qvel]] -= s.shown * speed[:, k]
        return State(qpos, qvel, act, past=state.past)

    def elsewhere(
        self, torque: Float[np.ndarray, "W nv"], speeds: Sequence[float]
    ) -> list[Float[np.ndarray, "W s2"]]:
        """Return other places and speeds with which added joints may begin, as `State.added`.

        What gives way by a gap is on either side of it, or between them shortly after the torque
        has changed its sign.

        Args:
            torque: that is transmitted at each nominal coordinate.
            speeds: of the added joints, to be tried with every place.
        """
        own = torque[:, [s.qvel for s in self.second]]
        rest = self._at_rest(own)
        there = [share * rest for share in _PLACES] + [self._at_rest(-own)]
        return [
            np.concatenate([place - rest, np.full_like(rest, speed)], axis=1)
            for speed in speeds
            for place in ([rest] if speed else []) + there
        ]

    def _at_rest(self, torque: Float[np.ndarray, "W s"]) -> Float[np.ndarray, "W s"]:
        places = [s.under(torque[:, k]) for k, s in enumerate(self.second)]
        return np.clip(np.stack(places, axis=1), *(sign * self._most for sign in (-1, 1)))

    @property
    def _most(self) -> Float[np.ndarray, " s"]:
        return np.array([s.most for s in self.second])

    def reduce(self, trajectory: Trajectory) -> Trajectory:
        """Return the nominal coordinates of a trajectory, as the encoders show them."""
        if self.same:
            return trajectory
        qpos, qvel = trajectory.qpos[..., self.qpos], trajectory.qvel[..., self.qvel]
        for s in self.second:
            qpos[..., s.qpos] += s.shown * trajectory.qpos[..., s.own_qpos]
            qvel[..., s.qvel] += s.shown * trajectory.qvel[..., s.own_qvel]
        act = trajectory.act[..., self.act]
        return Trajectory(
            qpos, qvel, act, trajectory.sensordata, trajectory.diverged, trajectory.ctrl
        )

    @property
    def loose(self) -> bool:
        """Whether a joint was added that can only move as far as a gap."""
        return any(np.isfinite(s.most) for s in self.second)

    def reach(self, machine: Machine) -> Float[np.ndarray, " k"]:
        """Return how far each number of a start may be off, nominal ones as far as may be."""
        joints = {j.dof: j for j in machine.joints.values()}
        added = [joints[s.qvel] for s in self.second]
        places = [_OFF * j.spread for j in added]
        speeds = [_OFF * j.speed for j in added]
        return np.array([_ANY] * 2 * len(self.qvel) + places + speeds)

    def tangent(self) -> Float[np.ndarray, "n k"]:
        """Return how a full state moves with a start: nominal positions and speeds, then added.

        A full state has the positions, speeds and activations of the edited model.
        """
        nv, full, kinds = len(self.qvel), self.sizes[1], len(self.second)
        out = np.zeros((2 * full + self.sizes[2], 2 * (nv + kinds)))
        for first, start in ((0, 0), (full, nv)):
            out[first + self.qvel, start + np.arange(nv)] = 1.0
            for k, s in enumerate(self.second):
                column = 2 * nv + k + (kinds if first else 0)
                out[first + s.own_qvel, column] = 1.0
                out[first + self.qvel[s.qvel], column] = -s.shown
        return out

    def seen(self) -> Float[np.ndarray, "k n"]:
        """Return what the encoders show of a change of a full state: positions, then speeds."""
        nv, full = len(self.qvel), self.sizes[1]
        out = np.zeros((2 * nv, 2 * full + self.sizes[2]))
        for first, start in ((0, 0), (full, nv)):
            out[start + np.arange(nv), first + self.qvel] = 1.0
            for s in self.second:
                out[start + s.qvel, first + s.own_qvel] = s.shown
        return out


def transmitted(
    model: mujoco.MjModel, start: State, ctrl: Float[np.ndarray, "W nu"]
) -> Float[np.ndarray, "W nv"]:
    """Return the torque that each joint's motor hands to its link, as if nothing gave way.

    The balance of the motor's side: τ = τ_actuator + τ_passive + τ_friction - I_a·q̈ with the
    armature I_a. Forces of contacts are counted as the joint's own.
    """
    data, out = mujoco.MjData(model), np.zeros((len(start), model.nv))
    for w in range(len(start)):
        start.begin(data, w, ctrl[w])
        mujoco.mj_forward(model, data)
        forces = data.qfrc_actuator + data.qfrc_passive + data.qfrc_constraint
        out[w] = forces - model.dof_armature * data.qacc
    return out


def _speeds(model: mujoco.MjModel, joint: int) -> int:
    return QVEL_SIZE[int(model.jnt_type[joint])]
