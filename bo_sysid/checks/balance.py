r"""The balance of forces along recorded motion, without simulating and without fitting.

For each degree of freedom j, at each instant,

    M a + bias - passive - constraint = g · actuators - b v - c tanh(v / v₀) + residual

where the left side is MuJoCo's inverse dynamics at the smoothed motion, less the gravity
compensation that actuators give beside their forces, and g (within 0.6 and 1.67), b and c (not
negative) stand for a wrong gain, viscous and dry friction: what is physics and not wiring shall not
be mistaken for it. J is the mean square of the residual over that of all terms
of the balance: near 0 where the channels are what the model takes them for, near 1 where not.

In a closed chain the balance is that of the joints that are free, Zᵀ of each term (mjcf/loops.py);
that of a joint that follows is empty.
"""

from collections.abc import Collection
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import lsq_linear

from bo_sysid.checks.limits import force_ends, joint_ends
from bo_sysid.mjcf import Loops
from bo_sysid.mjcf.commands import ALONG_JOINT, compensating, moments

GAIN = (0.6, 1.67)
"""Factors of an actuator's force that count as physics."""
_SLOW = 0.03  # of the typical speed: below it dry friction is no longer full
_SWEEPS, _MANY_SWEEPS = 12, 60  # more where the gain is free: friction resembles it


@dataclass(frozen=True)
class Terms:
    """The terms of the balance at n instants.

    Attributes:
        inertial: `n x nv` M a.
        rest: `n x nv` bias - passive - constraint.
        velocity: `n x nv`.
        acceleration: `n x nv`.
        bias: `n x nu` force of each actuator at zero control.
        gain: `n x nu` force per control.
        moment: `n x nu x nv` force along each degree of freedom per force of each actuator.
        ends: `2 x nu` least and largest force of each actuator; infinite without a limit.
        joint_ends: `2 x nv` the same of all actuators together along each degree of freedom.
    """

    inertial: Float[np.ndarray, "n nv"]
    rest: Float[np.ndarray, "n nv"]
    velocity: Float[np.ndarray, "n nv"]
    acceleration: Float[np.ndarray, "n nv"]
    bias: Float[np.ndarray, "n nu"]
    gain: Float[np.ndarray, "n nu"]
    moment: Float[np.ndarray, "n nu nv"]
    ends: Float[np.ndarray, "2 nu"]
    joint_ends: Float[np.ndarray, "2 nv"]

    def actuated(self, ctrl: Float[np.ndarray, "n nu"]) -> Float[np.ndarray, "n nv"]:
        """Return the force of all actuators along each degree of freedom, within its limits."""
        force = np.clip(self.bias + self.gain * ctrl, *self.ends)
        total = np.einsum("nu,nuv->nv", force, self.moment)
        return np.asarray(np.clip(total, *self.joint_ends))

    @property
    def dry(self) -> Float[np.ndarray, "n nv"]:
        """The direction of motion, smoothed about rest."""
        slow = _SLOW * self.velocity.std(axis=0) + 1e-12
        return np.asarray(np.tanh(self.velocity / slow))

    @property
    def required_force(self) -> Float[np.ndarray, "n nv"]:
        """The force that the recorded motion needs."""
        return np.asarray(self.inertial + self.rest)


class Dynamics:
    """Inverse dynamics of a model of hinges and slides.

    Args:
        model: the compiled model. Contacts are left out (comparable.py).
        silent: joints that are not recorded, which follow where a closed chain says so.
    """

    def __init__(self, model: mujoco.MjModel, silent: Collection[str] = ()) -> None:
        self.model, self.loops = model, Loops.of(model, silent)
        if self.loops:  # they make their own forces
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
        self._ends = force_ends(model), joint_ends(model, self.loops)
        model.actuator_forcelimited[:], model.actuator_delay[:] = 0, 0.0  # what acts is told
        self._data = mujoco.MjData(model)
        self._inputs = self._data.ctrl, self._data.act, self._data.actuator_force
        self._fixed = bool(np.isin(model.actuator_trntype, ALONG_JOINT).all())

    def terms(
        self,
        qpos: Float[np.ndarray, "n nq"],
        qvel: Float[np.ndarray, "n nv"],
        qacc: Float[np.ndarray, "n nv"],
    ) -> Terms:
        """Return the terms of the balance at n instants."""
        qpos, qvel, qacc = self._on_loops(qpos, qvel, qacc)
        model, data = self.model, self._data
        n, nv, nu = len(qpos), model.nv, model.nu
        needed, inertial = np.zeros((n, nv)), np.zeros((n, nv))
        bias, gain, moment = np.zeros((n, nu)), np.zeros((n, nu)), np.zeros((n, nu, nv))
        controlled = model.actuator_ctrlnum == 1  # friction may be an actuator without a control
        at, force = (data.qpos, data.qvel, data.qacc), data.qfrc_inverse  # looked up once: views
        asked, gravcomp = compensating(model), data.qfrc_gravcomp
        for k in range(n):
            at[0][:], at[1][:], at[2][:] = qpos[k], qvel[k], qacc[k]
            mujoco.mj_inverse(model, data)
            needed[k] = force - asked * gravcomp
            mujoco.mj_mulM(model, data, inertial[k], qacc[k])
            if nu:
                self._forces(controlled, bias[k], gain[k])
                if k == 0 or not self._fixed:
                    dense = moments(model, data)[controlled]
                moment[k] = dense
        rest = needed - inertial
        if self.loops:
            Z = self.loops.response(qpos)
            inertial, rest = (np.einsum("nij,ni->nj", Z, f) for f in (inertial, rest))
            moment = np.einsum("nij,nui->nuj", Z, moment)
        return Terms(inertial, rest, qvel, qacc, bias, gain, moment, *self._ends)

    def opening(self, qpos: Float[np.ndarray, "n nq"]) -> Float[np.ndarray, " _"]:
        """Return how far from closed the loops stay at positions, in [m] or [rad].

        The joints that follow are moved until they close, or as far as they can; empty without
        loops.
        """
        loops = self.loops
        if not loops:
            return np.zeros(0)
        qpos = loops.followed(qpos) if loops.silent else qpos
        closed, _ = loops.closed(qpos, np.zeros((len(qpos), self.model.nv)))
        return loops.opening(closed)

    def _on_loops(
        self, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return a motion in which the joints that follow do as the loops say."""
        loops = self.loops
        if not loops:
            return qpos, qvel, qacc
        qpos = loops.followed(qpos) if loops.silent else qpos
        qpos, qvel = loops.closed(qpos, qvel)
        return qpos, qvel, loops.accelerated(qpos, qvel, qacc)

    def of_bodies(
        self,
        qpos: Float[np.ndarray, "n nq"],
        qvel: Float[np.ndarray, "n nv"],
        qacc: Float[np.ndarray, "n nv"],
    ) -> Float[np.ndarray, "n nv b"]:
        """Return the force that each moving body's mass (and inertia) needs.

        The inverse dynamics are linear in them: a body's share is twice what half of it lacks.
        """
        qpos, qvel, qacc = self._on_loops(qpos, qvel, qacc)
        model = self.model
        bodies = [b for b in range(1, model.nbody) if model.body_mass[b] > 0]
        whole = self._inverse(qpos, qvel, qacc)
        shares = []
        for b in bodies:
            mass, inertia = float(model.body_mass[b]), model.body_inertia[b].copy()
            model.body_mass[b], model.body_inertia[b] = 0.5 * mass, 0.5 * inertia
            shares.append(2.0 * (whole - self._inverse(qpos, qvel, qacc)))
            model.body_mass[b], model.body_inertia[b] = mass, inertia
        if not shares:
            return np.zeros((*whole.shape, 0))
        stacked = np.stack(shares, axis=2)
        if self.loops:
            stacked = np.einsum("nij,nib->njb", self.loops.response(qpos), stacked)
        return stacked

    def of_points(
        self,
        qpos: Float[np.ndarray, "n nq"],
        qvel: Float[np.ndarray, "n nv"],
        qacc: Float[np.ndarray, "n nv"],
        body: int,
        points: Float[np.ndarray, "p 3"],
    ) -> Float[np.ndarray, "n nv p"]:
        """Return the force that a unit mass at each point of a body needs; no closed chains.

        Jᵀ a, with J the point's Jacobian and a = a₀ + α x d + ω x (ω x d) its acceleration less
        gravity's, at d from the body's frame.

        Args:
            qpos: positions.
            qvel: velocities.
            qacc: accelerations.
            body: its number.
            points: in its frame, in [m].
        """
        model, data = self.model, self._data
        out = np.empty((len(qpos), model.nv, len(points)))
        kind, rate, change = mujoco.mjtObj.mjOBJ_XBODY, np.empty(6), np.empty(6)
        linear, angular = np.empty((3, model.nv)), np.empty((3, model.nv))
        for k in range(len(qpos)):
            data.qpos[:], data.qvel[:], data.qacc[:] = qpos[k], qvel[k], qacc[k]
            mujoco.mj_inverse(model, data)
            mujoco.mj_rnePostConstraint(model, data)
            mujoco.mj_jacBody(model, data, linear, angular, body)
            mujoco.mj_objectVelocity(model, data, kind, body, rate, 0)
            mujoco.mj_objectAcceleration(model, data, kind, body, change, 0)
            d, w = points @ data.xmat[body].reshape(3, 3).T, rate[:3]
            a = change[3:] + np.cross(change[:3], d) + np.cross(w, np.cross(w, d))
            out[k] = linear.T @ a.T + angular.T @ np.cross(d, a).T
        return out

    def _inverse(self, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray) -> np.ndarray:
        data, out, asked = self._data, np.zeros_like(qvel), compensating(self.model)
        for k in range(len(qpos)):
            data.qpos[:], data.qvel[:], data.qacc[:] = qpos[k], qvel[k], qacc[k]
            mujoco.mj_inverse(self.model, data)
            out[k] = data.qfrc_inverse - asked * data.qfrc_gravcomp
        return out

    def _forces(
        self, controlled: Bool[np.ndarray, " a"], bias: np.ndarray, gain: np.ndarray
    ) -> None:
        """Write the actuators' forces at zero control, and their change per control."""
        ctrl, act, force = self._inputs
        ctrl[:] = act[:] = 0.0
        mujoco.mj_fwdActuation(self.model, self._data)
        bias[:] = force[controlled]
        ctrl[:] = act[:] = 1.0
        mujoco.mj_fwdActuation(self.model, self._data)
        gain[:] = force[controlled] - bias


def unexplained(
    terms: Terms, actuated: Float[np.ndarray, "D n nv"], *, varying: bool = False
) -> Float[np.ndarray, "D nv"]:
    """Return J of each degree of freedom, for D hypotheses about the controls.

    Args:
        terms: of the hypothesis about the measured channels.
        actuated: `D x n x nv` forces of the actuators.
        varying: whether every term is taken about its mean, so that what is constant, such as a
            load, counts for nothing.
    """
    friction = -np.stack([terms.velocity, terms.dry])
    inertial, rest = terms.inertial, terms.rest
    if varying:
        inertial, rest, friction, actuated = (
            x - x.mean(axis=-2, keepdims=True) for x in (inertial, rest, friction, actuated)
        )
    needed = inertial + rest
    gram = np.empty((*actuated.shape[::2], 3, 3))
    gram[..., 0, 0] = np.einsum("dnj,dnj->dj", actuated, actuated)
    gram[..., 0, 1:] = gram[..., 1:, 0] = np.einsum("dnj,bnj->djb", actuated, friction)
    gram[..., 1:, 1:] = np.einsum("anj,bnj->jab", friction, friction)
    right = np.empty((*actuated.shape[::2], 3))
    right[..., 0] = np.einsum("dnj,nj->dj", actuated, needed)
    right[..., 1:] = np.einsum("bnj,nj->jb", friction, needed)
    square = (needed**2).sum(axis=0)
    left = _left(square, gram, right, _bounded(gram, right))
    total = (inertial**2 + rest**2).sum(axis=0) + gram[..., 0, 0]
    return np.asarray(np.maximum(left, 0.0) / np.maximum(total, 1e-300))


def free_gain(
    terms: Terms, j: int, own: Float[np.ndarray, "D n"], rest: Float[np.ndarray, "D n"]
) -> tuple[float, float]:
    """Return the factor of one actuator's force that suits, whatever it is, beside friction.

    Args:
        terms: of the hypothesis about the measured channels.
        j: degree of freedom.
        own: `D x n` force of the actuator along it, for D hypotheses, of which the best counts.
        rest: `D x n` force of all others.

    Returns:
        The factor, and what it leaves unexplained over what is left without: with no actuator at
        all, or with physics alone, a rotor that the model lacks among it. Each is a share of the
        forces that it supposes, since noise in the acceleration counts with a rotor's inertia.
    """
    needed = terms.required_force[:, j] - rest
    columns = np.empty((len(own), 3, own.shape[1]))
    columns[:, 0], columns[:, 1], columns[:, 2] = own, -terms.velocity[:, j], -terms.dry[:, j]
    gram = np.einsum("dan,dbn->dab", columns, columns)
    right = np.einsum("dan,dn->da", columns, needed)
    square = (needed**2).sum(axis=1)
    found = _bounded(gram, right, (-np.inf, np.inf), _MANY_SWEEPS)
    left = _left(square, gram, right, found)
    k = int(np.argmin(left))
    none = _left(square[k], gram[k], right[k], _bounded(gram[k], right[k], (0.0, 0.0)))
    gain, all_of_it = float(found[k, 0]), float(gram[k, 0, 0])
    without = min(
        float(none / max(square[k], 1e-300)),
        _with_rotor(np.column_stack([*columns[k], -terms.acceleration[:, j]]), needed[k]),
    )
    return gain, float(left[k]) / max(gain**2 * all_of_it * without, 1e-300)


def _with_rotor(columns: Float[np.ndarray, "n 4"], needed: Float[np.ndarray, " n"]) -> float:
    """Return the share of an actuator's force that its gain, friction and a rotor leave."""
    size = np.sqrt((columns**2).mean(axis=0)) + 1e-300
    low, high = np.array([GAIN[0], 0.0, 0.0, 0.0]), np.array([GAIN[1], *[np.inf] * 3])
    found = lsq_linear(columns / size, needed, (low * size, high * size), method="bvls")
    force = found.x[0] * columns[:, 0] / size[0]
    return float(2 * found.cost / max(force @ force, 1e-300))


def _left(
    square: np.ndarray | np.float64, gram: np.ndarray, right: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Return the sum of squares that coefficients leave."""
    explained = 2 * (x * right).sum(axis=-1) - np.einsum("...a,...ab,...b->...", x, gram, x)
    return np.asarray(square - explained)


def _bounded(
    gram: np.ndarray,
    right: np.ndarray,
    gain: tuple[float, float] = GAIN,
    sweeps: int = _SWEEPS,
) -> np.ndarray:
    """Return the least-squares coefficients within their bounds, by coordinate descent.

    Friction that the model lacks takes from what the actuators give, and never adds to it.
    """
    low, high = (gain[0], 0.0, 0.0), (gain[1], np.inf, np.inf)
    x = np.zeros_like(right)
    x[..., 0] = np.clip(1.0, *gain)
    for _ in range(sweeps):
        for k in range(3):
            own = gram[..., k, k]
            rest = right[..., k] - (gram[..., k, :] * x).sum(axis=-1) + own * x[..., k]
            best = np.divide(rest, own, out=x[..., k].copy(), where=own > 0)
            x[..., k] = np.clip(best, low[k], high[k])
    return x
