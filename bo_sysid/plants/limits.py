"""Limits of a machine, which bind every excitation and policy that is meant for it.

Commands are kept within limits by clipping: the control range of every actuator is narrowed, so
that no action and no excitation leaves it. Positions and velocities cannot be kept by clipping; an
episode ends for good where they are left, so that a policy learns to stay within.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from bo_sysid.errors import ModelError
from bo_sysid.mjcf import Edit, Model
from bo_sysid.mjcf.commands import (
    commands_force,
    common_bounds,
    controlled,
    driven_joint,
    has_bias,
    other_drives,
)
from bo_sysid.mjcf.edits import RangeEdit
from bo_sysid.mjcf.extremes import actuator_extremes
from bo_sysid.mjcf.joints import SCALAR
from bo_sysid.plants.environment import control_range
from bo_sysid.plants.simulations import Simulations
from bo_sysid.plants.tasks.base import Start, VectorTask, WrappedTask
from bo_sysid.study import Study
from bo_sysid.study.requirements import require_limits


def limit_edits(study: Study, model: Model) -> tuple[Edit, ...]:
    """Return the edits that narrow the control ranges to a study's limits.

    A motor's command is bounded by `effort`, |u| ≤ effort / |gear · gain|; a position servo's by
    `position`. Where an actuator's force depends on more than its command, as that of servos does,
    or follows otherwise from it, as of integrators, muscles and motors with a circuit, the force
    itself is clipped to `effort`, or to the model's own range where that is narrower.
    Several actuators of one joint have equal shares of its effort, so that their sum keeps it for
    all commands. Gears, gains and biases that are parameters count at the end of their
    bounds that allows least, since the machine may be any candidate of B.

    Raises:
        StudyError: a limit is of a joint that the model does not have, leaves no command, or is an
            effort along a joint that is no hinge or slide or is not driven by itself.
    """
    if not study.limits:
        return ()
    compiled = model.compile()
    _require_kept(study, model, compiled)
    machines = actuator_extremes(model, study.parameter_set(model))
    driven = [driven_joint(compiled, a) for a in controlled(compiled)]
    bounds: dict[str, tuple[float, float]] = {}
    forces: dict[str, tuple[float, float]] = {}
    for a, name, joint in zip(controlled(compiled), model.controlled, driven, strict=True):
        limit = study.limits.get(joint) if joint else None
        if joint is None or limit is None:
            continue
        where = ("limits", joint)
        effort = None if limit.effort is None else limit.effort / driven.count(joint)
        alone = all(commands_force(m, a) and not has_bias(m, a) for m in machines)
        if effort is not None and not alone:
            most = _most_force(machines, a, effort)
            forces[name] = (-most, most)
            if not _leaves_force(machines, a, most):
                raise study.error(where, f"leaves actuator {name!r} no force")
        low, high = common_bounds(machines, a, limit.position, effort)
        if not low < high:
            raise study.error(where, f"leaves actuator {name!r} no command")
        if np.isfinite([low, high]).all():
            bounds[name] = (low, high)
    return (RangeEdit(bounds, forces),)


def require_ranges(study: Study, model: mujoco.MjModel) -> None:
    """Refuse an actuator of which neither the model nor a limit says how far it may be driven.

    Args:
        study: for the message.
        model: its model, with the edits of its limits.

    Raises:
        StudyError: there is one.
    """
    try:
        control_range(model)
    except ModelError as error:
        raise study.error(("model",), str(error)) from None


def _require_kept(study: Study, model: Model, compiled: mujoco.MjModel) -> None:
    """Refuse limits of joints that the model does not have, and efforts that cannot be kept.

    Raises:
        StudyError: there is one.
    """
    require_limits(study, model)
    for name, limit in study.limits.items():
        if limit.effort is None:
            continue
        if int(compiled.joint(name).type[0]) not in SCALAR:
            raise study.error(("limits", name), "only hinges and slides have limits")
        others = other_drives(compiled, name)
        if others:
            raise study.error(
                ("limits", name, "effort"),
                f"actuator {others[0]!r} acts on it through a tendon, a site or a body; an effort "
                "is kept only where actuators drive the joint itself: leave it out, and narrow the "
                "ctrlrange in the model",
            )


def _most_force(machines: Sequence[mujoco.MjModel], actuator: int, effort: float) -> float:
    """Return the largest force of an actuator, before its gear, within an effort."""
    return effort / max(abs(float(m.actuator_gear[actuator, 0])) for m in machines)


def _leaves_force(machines: Sequence[mujoco.MjModel], actuator: int, most: float) -> bool:
    """Return whether the model's own range, if any, has forces within a bound."""
    own = (m.actuator_forcerange[actuator] for m in machines if m.actuator_forcelimited[actuator])
    return all(low < most and high > -most for low, high in own)


class LimitedTask(WrappedTask):
    """A task whose episodes end for good where positions or velocities leave their limits.

    They are looked at in `reward`, after every part of an action: a machine that swings out and
    back while an action is held has left them, and earns nothing from then on.

    Args:
        task: the task.
        study: its `limits` are kept.
        model: gives the joints.

    Attributes:
        beyond: which simulations left the limits during the action after which `terminated` was
            last asked.
    """

    def __init__(self, task: VectorTask, study: Study, model: Model) -> None:
        super().__init__(task)
        self.beyond = np.zeros(0, bool)
        self._left: np.ndarray | None = None  # in the parts of an action that have earned so far
        require_limits(study, model)
        compiled = model.compile()
        self._low, self._high = np.full(compiled.nq, -np.inf), np.full(compiled.nq, np.inf)
        self._speed = np.full(compiled.nv, np.inf)
        for name, limit in study.limits.items():
            joint = compiled.joint(name)
            if int(joint.type[0]) not in SCALAR:
                raise study.error(("limits", name), "only hinges and slides have limits")
            if limit.position is not None:
                q = int(joint.qposadr[0])
                self._low[q], self._high[q] = limit.position
            if limit.velocity is not None:
                self._speed[int(joint.dofadr[0])] = limit.velocity

    def draw_start(self, model: mujoco.MjModel, rng: np.random.Generator) -> Start:
        """Draw where an episode begins, as the task does, within the limits."""
        start = self.task.draw_start(model, rng)
        return Start(np.clip(start.qpos, self._low, self._high), start.qvel, start.goal)

    def get_reward(self, sims: Simulations) -> np.ndarray:
        """Return the task's rewards; 0 where an earlier part of the action left the limits."""
        earned, before, now = self.task.get_reward(sims), self._left, self.left(sims)
        if before is None:
            self._left = now
            return earned
        self._left = before | now
        return np.where(before, 0.0, earned)

    def is_terminated(self, sims: Simulations) -> np.ndarray:
        """Return which episodes the task has ended, or have left the limits."""
        self.beyond = self.left(sims) if self._left is None else self._left
        self._left = None
        return np.asarray(self.task.is_terminated(sims) | self.beyond)

    def left(self, sims: Simulations) -> np.ndarray:
        """Return which of the `n` simulations are outside the limits.

        One that diverged has left them, wherever MuJoCo has put it back.
        """
        outside = (sims.qpos < self._low - 1e-9) | (sims.qpos > self._high + 1e-9)
        fast = np.abs(sims.qvel) > self._speed
        return np.asarray(outside.any(axis=1) | fast.any(axis=1) | sims.diverged())


def limited(task: VectorTask, study: Study, model: Model) -> VectorTask:
    """Return a task that keeps a study's limits of position and velocity; itself without any."""
    bound = [x.position is not None or x.velocity is not None for x in study.limits.values()]
    return LimitedTask(task, study, model) if any(bound) else task
