"""What a machine bears: positions, speeds, efforts, and parts that must not touch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.errors import StudyError, nearest
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.commands import (
    ALONG_JOINT,
    LAGS,
    bias_of,
    common_bounds,
    controlled,
    follows,
)
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.simulation import Trajectory
from bo_sysid.study.outer import Limit

_TOUCH = 0.01  # [s] between two poses at which contacts are looked for
_COLLISION = 2.0  # violation that touching counts as


@dataclass(frozen=True)
class Limits:
    """Bounds of every degree of freedom of a model of hinges and slides.

    Attributes:
        position: `nv x 2`; infinite where there is no limit.
        velocity: `nv`.
        effort: `nv`, of what the actuators do along it.
        joints: names.
        touching: whether the model's parts can touch.
    """

    position: Float[np.ndarray, "nv 2"]
    velocity: Float[np.ndarray, " nv"]
    effort: Float[np.ndarray, " nv"]
    joints: tuple[str, ...]
    touching: bool

    @classmethod
    def of(cls, model: Model, stated: Mapping[str, Limit]) -> "Limits":
        """Return the stated limits, within those of the model's joints.

        Raises:
            StudyError: a limit names no joint or lies outside the joint's own range, or a joint is
                neither a hinge nor a slide.
        """
        compiled = model.compile()
        for name in stated:
            if name not in model.joints:
                raise StudyError(f"limits: no joint {name!r}; {nearest(name, model.joints)}")
        if not np.isin(compiled.jnt_type, SCALAR).all():
            raise StudyError("excite needs a model of hinges and slides; hold a floating base")
        position = np.tile([-np.inf, np.inf], (compiled.nv, 1))
        velocity, effort = np.full(compiled.nv, np.inf), np.full(compiled.nv, np.inf)
        for j, name in enumerate(model.joints):
            if compiled.jnt_limited[j]:
                position[j] = compiled.jnt_range[j]
            limit = stated.get(name)
            if limit is not None and limit.position is not None:
                position[j] = _within(position[j], limit.position, name)
            if limit is not None:
                velocity[j] = limit.velocity or np.inf
                effort[j] = limit.effort or np.inf
        if np.isfinite(effort).any() and not np.isin(compiled.actuator_trntype, ALONG_JOINT).all():
            raise StudyError("limits: effort is known only for actuators that drive one joint each")
        if np.isfinite(effort).any():
            _require_effort_follows(compiled)
        return cls(position, velocity, effort, model.joints, can_touch(compiled))

    def commands(
        self, models: Sequence[mujoco.MjModel]
    ) -> tuple[Float[np.ndarray, " nu"], Float[np.ndarray, " nu"]]:
        """Return the least and the largest control of every actuator; infinite where unlimited.

        See `command_bounds`.

        Args:
            models: compiled models of the machines that the controls are for.

        Raises:
            StudyError: the limits of a joint leave its actuator no command.
        """
        model = models[0]
        ends = np.where(
            np.asarray(model.actuator_ctrllimited, bool)[:, None],
            model.actuator_ctrlrange, [-np.inf, np.inf],
        )  # fmt: skip
        for k, a in enumerate(controlled(model)):
            if int(model.actuator_trntype[a]) in ALONG_JOINT:
                j = int(model.actuator_trnid[a, 0])
                low, high = self.position[j]
                ends[k] = common_bounds(models, a, (low, high), float(self.effort[j]))
                if not ends[k, 0] < ends[k, 1]:
                    raise StudyError(
                        f"limits: {self.joints[j]}: they leave actuator {model.actuator(a).name!r} "
                        f"no command within its ctrlrange"
                    )
        return ends[:, 0], ends[:, 1]

    def of_channels(
        self, names: Sequence[str], low: Float[np.ndarray, " nu"], high: Float[np.ndarray, " nu"]
    ) -> dict[str, tuple[float, float]]:
        """Return least and largest value of each channel that a trajectory has.

        Args:
            names: channels of the controls.
            low: least controls, see `commands`.
            high: largest controls.
        """
        found = {}
        for j, name in enumerate(self.joints):
            found[f"qpos.{name}"] = (float(self.position[j, 0]), float(self.position[j, 1]))
            found[f"qvel.{name}"] = (-float(self.velocity[j]), float(self.velocity[j]))
        for name, least, most in zip(names, low, high, strict=True):
            found[name] = (float(least), float(most))
        return found

    def violation(
        self,
        models: Sequence[mujoco.MjModel],
        trajectory: Trajectory,
        ctrl: Float[np.ndarray, "W S nu"],
        margin: float,
    ) -> Float[np.ndarray, " W"]:
        """Return by how much the worst limit is exceeded in each of W simulations; 0 for not.

        Args:
            models: the compiled model of each simulation, for efforts and contacts.
            trajectory: what the simulations did.
            ctrl: their controls.
            margin: share of each limit that may be used.
        """
        middle, half = self._centres()
        off = np.abs(trajectory.qpos - middle) / half
        fast = np.abs(trajectory.qvel) / self.velocity
        worst = np.maximum(off.max(axis=(1, 2)), fast.max(axis=(1, 2)))
        if np.isfinite(self.effort).any():
            share = np.abs(self.torque(models, trajectory, ctrl)) / self.effort
            worst = np.maximum(worst, share.max(axis=(1, 2)))
        if self.touching:
            worst += _COLLISION * self._touched(models, trajectory)
        worst[trajectory.diverged] = 10.0
        return np.asarray(np.maximum(worst - margin, 0.0))

    @property
    def middle(self) -> Float[np.ndarray, " nv"]:
        """Middle of each joint's limits; 0 where there is none."""
        return self._centres()[0]

    def _centres(self) -> tuple[np.ndarray, np.ndarray]:
        bounded = np.isfinite(self.position).all(axis=1)
        position = np.where(bounded[:, None], self.position, [-1.0, 1.0])
        middle = np.where(bounded, position.mean(axis=1), 0.0)
        half = np.where(bounded, 0.5 * np.diff(position, axis=1)[:, 0], np.inf)
        return middle, half

    def torque(
        self,
        models: Sequence[mujoco.MjModel],
        trajectory: Trajectory,
        ctrl: Float[np.ndarray, "W S nu"],
    ) -> Float[np.ndarray, "W S nv"]:
        """Return what actuators that drive one joint each do along it, in [N m] or [N].

        Along its joint an actuator acts with r (g u + b₀ + b₁ r q + b₂ r v), gear r, gain g, those
        of the machine that is simulated, u the activation where it lags behind its control. Forces
        are clipped where MuJoCo clips them, of an actuator and of all that drive a joint.

        Args:
            models: the compiled model of each simulation.
            trajectory: what the simulations did.
            ctrl: their controls.
        """
        first = models[0]
        torque = np.zeros((*ctrl.shape[:2], first.nv))
        for k, a in enumerate(controlled(first)):
            dof = int(first.jnt_dofadr[first.actuator_trnid[a, 0]])
            gear = np.array([m.actuator_gear[a, :1] for m in models])
            gain = np.array([m.actuator_gainprm[a, :1] for m in models])
            bias = np.array([bias_of(m, a) for m in models]).T[..., None]
            q, v = trajectory.qpos[:, :-1, dof], trajectory.qvel[:, :-1, dof]
            u = _acting(first, trajectory, a, ctrl[..., k])
            force = gain * u + bias[0] + gear * (bias[1] * q + bias[2] * v)
            if first.actuator_forcelimited[a]:
                low, high = np.array([m.actuator_forcerange[a] for m in models]).T[..., None]
                force = np.clip(force, low, high)
            torque[..., dof] += gear * force
        for j in np.flatnonzero(first.jnt_actfrclimited):
            low, high = np.array([m.jnt_actfrcrange[j] for m in models]).T[..., None]
            dof = int(first.jnt_dofadr[j])
            torque[..., dof] = np.clip(torque[..., dof], low, high)
        return torque

    def _touched(
        self, models: Sequence[mujoco.MjModel], trajectory: Trajectory
    ) -> Bool[np.ndarray, " W"]:
        """Return whether any parts touch in each simulation."""
        known = {id(m): mujoco.MjData(m) for m in models}  # one model may have many simulations
        stride = max(round(_TOUCH / models[0].opt.timestep), 1)
        touched = np.zeros(len(trajectory.qpos), bool)
        for w, (model, poses) in enumerate(zip(models, trajectory.qpos[:, ::stride], strict=True)):
            data = known[id(model)]
            for pose in poses:
                data.qpos[:] = pose
                mujoco.mj_fwdPosition(model, data)
                if any(data.contact[c].dist < 0 for c in range(data.ncon)):
                    touched[w] = True
                    break
        return touched


def _acting(
    model: mujoco.MjModel, trajectory: Trajectory, actuator: int, ctrl: Float[np.ndarray, "W S"]
) -> Float[np.ndarray, "W S"]:
    """Return what an actuator's force follows from: its control, or what lags behind that."""
    if int(model.actuator_dyntype[actuator]) not in LAGS:
        return ctrl
    column = int(model.actuator_actadr[actuator] + model.actuator_actnum[actuator]) - 1
    act = trajectory.act[..., column]
    return np.asarray(act[:, 1:] if model.actuator_actearly[actuator] else act[:, :-1])


def knows_effort(model: mujoco.MjModel) -> bool:
    """Return whether commands say the effort along every joint that is driven."""
    along = np.isin(model.actuator_trntype, ALONG_JOINT).all()
    return bool(along) and all(_effort_follows(model, a) for a in controlled(model))


def _effort_follows(model: mujoco.MjModel, actuator: int) -> bool:
    """Return whether an actuator's force follows from its command.

    It does not where the command is integrated, in muscles, and where the gain changes with
    position or speed, as a damper's does.
    """
    affine = int(model.actuator_gaintype[actuator]) == mujoco.mjtGain.mjGAIN_AFFINE
    varies = affine and model.actuator_gainprm[actuator, 1:3].any()
    return follows(model, actuator) and not varies


def _require_effort_follows(model: mujoco.MjModel) -> None:
    for a in controlled(model):
        if not _effort_follows(model, a):
            raise StudyError(
                f"limits: effort is not known of actuator {model.actuator(a).name!r}: its force "
                "does not follow from its command; leave effort out, and watch the machine"
            )


def _within(
    own: Float[np.ndarray, " 2"], stated: tuple[float, float], joint: str
) -> tuple[float, float]:
    """Return what a joint's own range and a stated limit have in common."""
    low, high = max(float(own[0]), stated[0]), min(float(own[1]), stated[1])
    if not low < high:
        raise StudyError(
            f"limits: {joint}: position [{stated[0]:g}, {stated[1]:g}] lies outside the range of "
            f"the model's joint, [{own[0]:g}, {own[1]:g}]; the two must overlap"
        )
    return low, high
