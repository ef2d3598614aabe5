"""Which limit is exceeded first, by which machine, and what to do about it."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.excite.limits import Limits
from bo_sysid.excite.rest import Hold
from bo_sysid.mjcf.joints import SLIDE
from bo_sysid.parameters import Parameter
from bo_sysid.simulation import Trajectory

_MISSING = 1e-3  # share of the largest force that is needed
_SHORTEST = 1.0  # [s], the least length of a plan


@dataclass(frozen=True)
class Exceeded:
    """The first limit that any machine exceeds.

    Attributes:
        machine: row of the machine.
        joint: name of the joint, empty where none is to blame.
        event: what happens, such as "position is -0.31 rad (limit -0.3 to 1.8)".
        time: when, in [s]; nan where that is not known.
    """

    machine: int
    joint: str
    event: str
    time: float

    def __str__(self) -> str:
        joint = f"{self.joint}: " if self.joint else ""
        after = f" after {self.time:.3g} s" if self.time > 0 else ""
        return f"limits: {joint}{self.event}{after}"

    @property
    def advice(self) -> str:
        """What to do."""
        shorter = f"plan less than {self.time:.2g} s (--seconds), " if self.time > _SHORTEST else ""
        return (
            f"{shorter}give the model the machine's servos, widen limits, or narrow low and high "
            "of parameters"
        )


def first_exceeded(
    limits: Limits,
    models: Sequence[mujoco.MjModel],
    trajectory: Trajectory,
    ctrl: Float[np.ndarray, "W S nu"],
) -> Exceeded:
    """Return the limit that is exceeded first; without one, that parts touch or all is lost.

    Args:
        limits: are exceeded.
        models: the compiled model of each machine.
        trajectory: what the machines did.
        ctrl: their controls.
    """
    q, v = trajectory.qpos, trajectory.qvel
    torque = np.zeros_like(v)
    if np.isfinite(limits.effort).any():
        torque = limits.torque(models, trajectory, ctrl)
    low, high = limits.position.T
    beyond = {
        "position": (q < low) | (q > high),
        "velocity": np.abs(v) > limits.velocity,
        "effort": np.abs(torque) > limits.effort,
    }
    found = [(*np.argwhere(np.swapaxes(b, 0, 1))[0], k) for k, b in beyond.items() if b.any()]
    if not found:
        lost = int(np.argmax(trajectory.diverged))
        what = "the simulation diverges" if trajectory.diverged[lost] else "parts touch"
        return Exceeded(lost, "", what, np.nan)
    step, machine, joint, kind = min(found)
    length, force = ("m", "N") if int(models[0].jnt_type[joint]) == SLIDE else ("rad", "N m")
    values, bound, unit = {
        "position": (q, f"{low[joint]:.4g} to {high[joint]:.4g}", length),
        "velocity": (v, f"{limits.velocity[joint]:.4g}", f"{length}/s"),
        "effort": (torque, f"{limits.effort[joint]:.4g}", force),
    }[kind]
    event = f"{kind} is {values[machine, step, joint]:.4g} {unit} (limit {bound})"
    time = float(step * models[0].opt.timestep)
    return Exceeded(int(machine), limits.joints[joint], event, time)


def why_not_held(
    worst: Exceeded,
    joints: Sequence[str],
    hold: Hold,
    parameters: Sequence[Parameter],
    machines: Float[np.ndarray, "M d"],
) -> str:
    """Return why a machine that is held at its reference exceeds a limit, and what to do.

    Args:
        worst: what is exceeded.
        joints: names.
        hold: how it is held.
        parameters: what is not known.
        machines: of which one exceeds the limit; the nominal one comes first.
    """
    if worst.time == 0.0:
        return (
            f"{worst} at the model's reference pose, from which plans start; widen the limit or "
            "choose another reference (ref of joints)"
        )
    begins = f"{worst} where the machine should stand at its reference"
    missing = np.abs(hold.needed - hold.given)
    lacks = int(np.argmax(missing))
    if missing[lacks] > _MISSING * np.abs(hold.needed).max():
        return (
            f"{begins}: {joints[lacks]} needs {hold.needed[lacks]:.3g} there, actuators give "
            f"{hold.given[lacks]:.3g} within ctrlrange and limits; state the range that the "
            "machine has, or choose another reference (ref of joints)"
        )
    which = "as the model has it"
    if worst.machine:
        point = zip(parameters, machines[worst.machine], strict=True)
        which = "with " + ", ".join(f"{p.name} {x:.4g}" for p, x in point)
    return f"{begins}: {which} it drifts under controls that are constant; {worst.advice}"


def why_unstable(worst: Exceeded, nudge: float) -> str:
    """Return that a machine falls when it starts beside its reference, and what to do."""
    return (
        f"{worst} if the machine starts {nudge:g} rad (m) beside its reference: it is unstable "
        f"there, and no planned controls keep it; {worst.advice}"
    )


def why_not_moved(worst: Exceeded) -> str:
    """Return that no motion is small enough, and what to do."""
    return (
        f"{worst} under the smallest motion that was tried: the reference is too near that limit, "
        f"or the machine unstable there; {worst.advice}"
    )
