"""Closed kinematic chains: joints that follow from the others through a model's equalities.

Rigid equalities g(q) = 0 (connect, weld, joint, tendon) leave as many joints free as the machine
has; the others follow,

    g(qᵢ, q_d) = 0,    v_d = Z_d vᵢ    with Z_d = -J_d⁺ Jᵢ and J = ∂g/∂q.

MuJoCo keeps equalities by stiff springs: a state off the loop, as noisy encoders say it, is pulled
back within hundredths of a second, with forces that no recording knows. Soft equalities stand for
compliance and are no loops.
Source: MuJoCo documentation, Computation, Constraint model.
"""

import copy
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float, Int

from bo_sysid.mjcf.commands import ALONG_JOINT
from bo_sysid.mjcf.joints import SCALAR

_RIGID = 0.02  # [s] time constant up to which an equality is rigid; MuJoCo's own
_QUICK = 0.01  # [s] time constant up to which an equality opens by nothing that is measured
_ITERATIONS, _CLOSED = 30, 1e-11  # of Newton's method; [m] or [rad] of its last step
_LONGEST, _STRIDE = 0.3, 0.1  # [m] or [rad] of a step; of the joints that are followed
_ASIDE = 0.05  # [m] or [rad] from where the model rests, where its rank is looked at
_INDEPENDENT = 1e-6  # of the largest column, that the others do not make up
_DIFFERENCE = 1e-6  # [s] by which a motion goes on to see how the loop turns
_LOOPS = (
    int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD),
    int(mujoco.mjtEq.mjEQ_JOINT), int(mujoco.mjtEq.mjEQ_TENDON),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Loops:
    """The loops of a model, and the joints that follow from the others.

    Attributes:
        model: compiled, with nothing but its rigid equalities.
        joints: names of the `d` joints that follow.
        dofs: `d` columns of `qvel` of these.
        silent: whether one of them is not recorded.
    """

    model: mujoco.MjModel
    joints: tuple[str, ...]
    dofs: Int[np.ndarray, " d"]
    silent: bool

    @classmethod
    def of(
        cls, model: mujoco.MjModel, silent: Collection[str] = (), apart: Collection[str] = ()
    ) -> "Loops":
        """Find the loops of a compiled model.

        As many joints follow as the equalities bind: first those that are not recorded, then
        those without an actuator, from the end of the tree on.

        Args:
            model: is not changed.
            silent: joints that are not recorded.
            apart: joints that follow from nothing, such as what gives way behind an encoder.
        """
        bare = _bare(model) if model.neq else model
        if not bare.eq_active0.any():
            return cls(bare, (), np.zeros(0, int), False)
        J = _slopes(bare, _somewhere(bare))
        driven = {
            int(i) for i, t in zip(bare.actuator_trnid[:, 0], bare.actuator_trntype, strict=True)
            if int(t) in ALONG_JOINT
        }  # fmt: skip
        names = [bare.joint(j).name for j in range(bare.njnt)]
        scalar = [
            j for j in range(bare.njnt)
            if int(bare.jnt_type[j]) in SCALAR and names[j] not in apart
        ]  # fmt: skip
        order = sorted(scalar, key=lambda j: (names[j] not in silent, j in driven, -j))
        found = sorted(_independent(J, bare.jnt_dofadr, order))
        joints = tuple(names[j] for j in found)
        return cls(bare, joints, bare.jnt_dofadr[found], any(n in silent for n in joints))

    def __bool__(self) -> bool:
        return bool(self.joints)

    @property
    def mirrored(self) -> dict[str, str]:
        """The joints that follow in proportion to another, as fingers that mimic, with that one."""
        return {follower: other for _, follower, other in self._in_proportion()}

    @property
    def yielding(self) -> frozenset[str]:
        """The mirrored joints whose tie opens under load by what an encoder may show.

        Where it holds back an acceleration a, a tie of time constant τ opens by

            r = τ² D² (1 - d) a / d²

        with its impedance d, at most D: half a milliradian for 11 rad/s² and MuJoCo's own numbers.
        Source: MuJoCo documentation, Computation, Constraint model, with an acceleration of 0.
        """
        slow = self.model.eq_solref[:, 0] > _QUICK
        return frozenset(follower for e, follower, _ in self._in_proportion() if slow[e])

    def _in_proportion(self) -> Iterator[tuple[int, str, str]]:
        """Yield the equalities that tie two joints in proportion, who follows, and whom."""
        model = self.model
        for e in np.flatnonzero(model.eq_active0).tolist():
            tied = _proportional(model, e)
            if len(tied) != 2:
                continue
            one, two = (model.joint(j).name for j in tied)
            if (one in self.joints) != (two in self.joints):
                yield (e, one, two) if one in self.joints else (e, two, one)

    def released(self, joints: Collection[str]) -> "Loops":
        """Return the same where some joints do not follow."""
        keep = [k for k, name in enumerate(self.joints) if name not in joints]
        return replace(self, joints=tuple(self.joints[k] for k in keep), dofs=self.dofs[keep])

    @property
    def columns(self) -> Int[np.ndarray, " d"]:
        """Columns of `qpos` of the joints that follow."""
        return np.asarray(self.model.jnt_qposadr[self.model.dof_jntid[self.dofs]])

    def closed(
        self, qpos: Float[np.ndarray, "W nq"], qvel: Float[np.ndarray, "W nv"]
    ) -> tuple[Float[np.ndarray, "W nq"], Float[np.ndarray, "W nv"]]:
        """Return states in which the loops are closed, from nearby ones."""
        data, qpos, qvel = mujoco.MjData(self.model), qpos.copy(), qvel.copy()
        for q, v in zip(qpos, qvel, strict=True):
            self._close(data, q)
            v[self.dofs] = self._following(data) @ np.delete(v, self.dofs)
        return qpos, qvel

    def followed(self, qpos: Float[np.ndarray, "T nq"]) -> Float[np.ndarray, "T nq"]:
        """Return positions one after the other in which the loops are closed.

        Each begins where the one before ended, the first where the model rests: what is not
        recorded stays in one of the ways to put the machine together.
        """
        data, at, out = mujoco.MjData(self.model), self.model.qpos0.copy(), qpos.copy()
        for row in out:
            steps = max(int(np.ceil(np.abs(np.delete(row - at, self.columns)).max() / _STRIDE)), 1)
            first = at.copy()
            for k in range(1, steps + 1):
                held = at[self.columns]
                at = first + k / steps * (row - first)
                at[self.columns] = held
                self._close(data, at)
            row[self.columns] = at[self.columns]
            at = row.copy()
        return out

    def opening(self, qpos: Float[np.ndarray, "W nq"]) -> Float[np.ndarray, " W"]:
        """Return how far from closed the loops are, at most, in [m] or [rad]."""
        data, out = mujoco.MjData(self.model), np.zeros(len(qpos))
        for k, row in enumerate(qpos):
            data.qpos[:] = row
            _constrain(self.model, data)
            out[k] = np.abs(data.efc_pos[: data.ne]).max(initial=0.0)
        return out

    def response(self, qpos: Float[np.ndarray, "W nq"]) -> Float[np.ndarray, "W nv nv"]:
        """Return Z: how all velocities follow from those of the joints that are free.

        The columns of joints that follow are zero. Forces F on all joints do on the free ones what
        Zᵀ F does.
        """
        data, free = mujoco.MjData(self.model), np.delete(np.arange(self.model.nv), self.dofs)
        out = np.zeros((len(qpos), self.model.nv, self.model.nv))
        out[:, free, free] = 1.0
        for k, row in enumerate(qpos):
            data.qpos[:] = row
            _constrain(self.model, data)
            out[k][np.ix_(self.dofs, free)] = self._following(data)
        return out

    def accelerated(
        self,
        qpos: Float[np.ndarray, "W nq"],
        qvel: Float[np.ndarray, "W nv"],
        qacc: Float[np.ndarray, "W nv"],
    ) -> Float[np.ndarray, "W nv"]:
        """Return the accelerations with which loops stay closed: a = Z aᵢ + Ż vᵢ."""
        later = qpos.copy()
        for row, v in zip(later, qvel, strict=True):
            mujoco.mj_integratePos(self.model, row, v, _DIFFERENCE)
        now, then = self.response(qpos), self.response(later)
        velocity_part = np.einsum("wij,wj->wi", (then - now) / _DIFFERENCE, qvel)
        return np.asarray(np.einsum("wij,wj->wi", now, qacc) + velocity_part)

    def _close(self, data: mujoco.MjData, qpos: Float[np.ndarray, " nq"]) -> None:
        """Move the joints that follow, in place, until the loops are closed."""
        for step in _newton(self.model, data, qpos, self.dofs):
            qpos[self.columns] += step

    def _following(self, data: mujoco.MjData) -> Float[np.ndarray, "d i"]:
        J = _rows(self.model, data)
        free = np.delete(J, self.dofs, axis=1)
        return np.asarray(-np.linalg.lstsq(J[:, self.dofs], free, rcond=1e-9)[0])


def tied_by(model: mujoco.MjModel, joint: str) -> str:
    """Return what names a joint besides actuators and sensors, empty where nothing does."""
    j = model.joint(joint).id
    for e in range(model.neq):
        tied = (model.eq_obj1id[e], model.eq_obj2id[e])
        if int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT) and j in tied:
            return f"the equality {model.equality(e).name}"
    wraps = (model.wrap_type == int(mujoco.mjtWrap.mjWRAP_JOINT)) & (model.wrap_objid == j)
    for t in range(model.ntendon):
        first = int(model.tendon_adr[t])
        if wraps[first : first + int(model.tendon_num[t])].any():
            return f"the tendon {model.tendon(t).name}"
    return ""


def _proportional(model: mujoco.MjModel, e: int) -> list[int]:
    """Return the joints whose positions an equality ties by one linear equation, else nothing.

    A joint equality is one; so is one of fixed tendons, as of the rope of a winch.
    """
    kind, pair = int(model.eq_type[e]), (int(model.eq_obj1id[e]), int(model.eq_obj2id[e]))
    slope = float(model.eq_data[e, 1])
    if pair[1] >= 0 and model.eq_data[e, 2:5].any():
        return []
    if kind == int(mujoco.mjtEq.mjEQ_JOINT):
        return list(pair) if pair[1] >= 0 else []
    if kind != int(mujoco.mjtEq.mjEQ_TENDON):
        return []
    shares = np.zeros(model.njnt)
    for tendon, times in zip(pair, (1.0, -slope), strict=True):
        if tendon < 0:
            continue
        own = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        if (model.wrap_type[own] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
            return []
        np.add.at(shares, model.wrap_objid[own], times * model.wrap_prm[own])
    return np.flatnonzero(shares).tolist()


def _bare(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a model with nothing but its rigid equalities."""
    bare = copy.copy(model)
    for kind in ("CONTACT", "LIMIT", "FRICTIONLOSS"):
        bare.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{kind}"))
    bare.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    soft = (model.eq_solref[:, 0] <= 0) | (model.eq_solref[:, 0] > _RIGID)
    bare.eq_active0[soft | ~np.isin(model.eq_type, _LOOPS)] = 0
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EQUALITY):
        bare.eq_active0[:] = 0
    return bare


def _constrain(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Compute the rows of the equalities at a pose, and nothing of masses.

    Inertias that are too small, as on the way to a closed loop, would be told on the terminal.
    """
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)
    mujoco.mj_makeConstraint(model, data)


def _rows(model: mujoco.MjModel, data: mujoco.MjData) -> Float[np.ndarray, "e nv"]:
    return np.asarray(data.efc_J.reshape(-1, model.nv)[: data.ne])


def _newton(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, dofs: Int[np.ndarray, " d"]
) -> Iterator[Float[np.ndarray, " d"]]:
    """Yield the steps of some degrees of freedom that close the loops; the caller moves `qpos`."""
    for _ in range(_ITERATIONS):
        data.qpos[:] = qpos
        _constrain(model, data)
        J = _rows(model, data)[:, dofs]
        step = -np.linalg.lstsq(J, data.efc_pos[: data.ne], rcond=1e-9)[0]
        longest = float(np.abs(step).max(initial=0.0))
        if longest < _CLOSED:
            return
        yield step * min(1.0, _LONGEST / longest)


def _somewhere(model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
    """Return a pose with closed loops beside the one of rest, which may be a special one."""
    data, qpos = mujoco.MjData(model), model.qpos0.copy()
    aside = _ASIDE * np.random.default_rng(0).standard_normal(model.nv)
    mujoco.mj_integratePos(model, qpos, aside, 1.0)
    for step in _newton(model, data, qpos, np.arange(model.nv)):
        mujoco.mj_integratePos(model, qpos, step, 1.0)
    return np.asarray(qpos)


def _slopes(model: mujoco.MjModel, qpos: Float[np.ndarray, " nq"]) -> Float[np.ndarray, "e nv"]:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    _constrain(model, data)
    return _rows(model, data).copy()


def _independent(
    J: Float[np.ndarray, "e nv"], dofs: Int[np.ndarray, " njnt"], order: Collection[int]
) -> list[int]:
    """Return the joints whose columns no earlier ones make up, in an order."""
    found, basis = [], np.zeros((J.shape[0], 0))
    largest = np.linalg.norm(J, axis=0).max(initial=0.0)
    for j in order:
        left = J[:, dofs[j]] - basis @ (basis.T @ J[:, dofs[j]])
        left = left - basis @ (basis.T @ left)
        size = float(np.linalg.norm(left))
        if size > _INDEPENDENT * largest:
            found.append(j)
            basis = np.column_stack([basis, left / size])
    return found
