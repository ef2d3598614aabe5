"""States of a model that an effect gave further joints or activations, beside the nominal ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.effects import Hidden, Part
from bo_sysid.simulation import State, Trajectory


@dataclass(frozen=True)
class Coordinates:
    """Where an edited model keeps the coordinates of the nominal one.

    Attributes:
        rest: `qpos` of the edited model at rest.
        qpos: column of the edited model for each nominal column of `qpos`.
        qvel: the same for `qvel`.
        act: the same for `act`.
        sizes: nq, nv and na of the edited model.
        shown: (nominal column of qpos, of qvel, hidden column of qpos, of qvel, share) of each
            hidden joint that an encoder shows.
    """

    rest: Float[np.ndarray, " q"]
    qpos: Int[np.ndarray, " nq"]
    qvel: Int[np.ndarray, " nv"]
    act: Int[np.ndarray, " na"]
    sizes: tuple[int, int, int]
    shown: tuple[tuple[int, int, int, int, float], ...]

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
        shown = tuple(
            (
                int(nominal.joint(p.of).qposadr[0]),
                int(nominal.joint(p.of).dofadr[0]),
                int(edited.joint(p.joint).qposadr[0]),
                int(edited.joint(p.joint).dofadr[0]),
                p.shown,
            )
            for p in parts
            if isinstance(p, Hidden) and p.shown
        )
        sizes = (edited.nq, edited.nv, edited.na)
        return cls(
            edited.qpos0.copy(),
            np.array(qpos, int),
            np.array(qvel, int),
            np.array(act, int),
            sizes,
            shown,
        )

    @property
    def same(self) -> bool:
        """Whether the edited model has the nominal coordinates and no others."""
        return self.sizes == (len(self.qpos), len(self.qvel), len(self.act))

    def expand(self, state: State) -> State:
        """Return nominal states as states of the edited model; what is hidden is at rest."""
        if self.same:
            return state
        count = len(state)
        qpos = np.tile(self.rest, (count, 1))
        qvel, act = np.zeros((count, self.sizes[1])), np.zeros((count, self.sizes[2]))
        qpos[:, self.qpos], qvel[:, self.qvel], act[:, self.act] = state.qpos, state.qvel, state.act
        return State(qpos, qvel, act)

    def reduce(self, trajectory: Trajectory) -> Trajectory:
        """Return the nominal coordinates of a trajectory, as the encoders show them."""
        if self.same:
            return trajectory
        qpos, qvel = trajectory.qpos[..., self.qpos], trajectory.qvel[..., self.qvel]
        for q, v, hidden_q, hidden_v, share in self.shown:
            qpos[..., q] += share * trajectory.qpos[..., hidden_q]
            qvel[..., v] += share * trajectory.qvel[..., hidden_v]
        act = trajectory.act[..., self.act]
        return Trajectory(
            qpos, qvel, act, trajectory.sensordata, trajectory.diverged, trajectory.ctrl
        )


def _speeds(model: mujoco.MjModel, joint: int) -> int:
    return {0: 6, 1: 3}.get(int(model.jnt_type[joint]), 1)
