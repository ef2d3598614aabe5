"""The scales of a machine: how strong, fast and heavy it is at each site, from model and data."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.mjcf.commands import ALONG_JOINT
from bo_sysid.mjcf.joints import SLIDE
from bo_sysid.recording import Recording, kind_of

Signal = Float[np.ndarray, "..."]


@dataclass(frozen=True, kw_only=True)
class JointScale:
    """A hinge or slide joint.

    Attributes:
        name: of the joint.
        dof: its degree of freedom.
        hinge: whether it turns.
        force: typical force along it in [N m] or [N].
        speed: root mean square of its velocity.
        acceleration: root mean square of its acceleration.
        spread: standard deviation of its position.
        span: range of its position.
        inertia: mean effective inertia in [kg m²] or [kg].
        actuators: names of the actuators that drive it.
        driven: largest force along it that they made, with others through tendons and chains.
        middle: the middle of that range.
    """

    name: str
    dof: int
    hinge: bool
    force: float
    speed: float
    acceleration: float
    spread: float
    span: float
    inertia: float
    actuators: tuple[str, ...]
    driven: float
    middle: float


@dataclass(frozen=True, kw_only=True)
class ActuatorScale:
    """An actuator.

    Attributes:
        name: of the actuator.
        joint: the hinge or slide joint it drives, None where it acts on something else.
        gear: ratio of force along the joint and actuator force; 1 without a joint, where the force
            is the actuator's own.
        pushes: whether that force is one, in [N], and no torque.
        gain: force per control.
        bias: constant, per length, per velocity.
        servo: whether its force depends on the position of the joint.
        ctrl_max: largest absolute control recorded, within the model's limits.
        ctrl_std: standard deviation of the recorded control.
        force_max: largest absolute force along the joint, within the model's limits.
        force_std: standard deviation of that force.
        levels: fractions of `force_max` at which a saturation is looked for.
        plain: whether its force is affine in control, length and velocity, as of a motor or servo.
        jumps: percentiles of the recorded control's changes from sample to sample, largest first.
        ctrl_limits: to which the model clips controls, None where it does not.
        force_limits: to which it clips the actuator's force, None where it does not.
        follows: whether what acts is the control, or lags behind it; not, as of an integrator,
            something else of which laws are not told.
    """

    name: str
    joint: str | None
    gear: float
    pushes: bool
    gain: float
    bias: tuple[float, float, float]
    servo: bool
    ctrl_max: float
    ctrl_std: float
    force_max: float
    force_std: float
    levels: tuple[float, ...]
    plain: bool
    jumps: tuple[float, ...]
    ctrl_limits: tuple[float, float] | None = None
    force_limits: tuple[float, float] | None = None
    follows: bool = True

    def clipped(self, ctrl: Signal) -> Signal:
        """Return a control within the limits to which the model clips it before it acts."""
        return ctrl if self.ctrl_limits is None else np.clip(ctrl, *self.ctrl_limits)

    def force(self, ctrl: Signal, q: Signal, v: Signal) -> Signal:
        """Return the force along the joint that a plain actuator makes, within its limits.

        Args:
            ctrl: what acts: the control, or the activation that follows it.
            q: position of the joint in [rad] or [m].
            v: its velocity.
        """
        b, gear = self.bias, self.gear
        force = self.gain * self.clipped(ctrl) + b[0] + b[1] * gear * q + b[2] * gear * v
        if self.force_limits is not None:
            force = np.clip(force, *self.force_limits)
        return np.asarray(gear * force)


@dataclass(frozen=True)
class BodyScale:
    """A moving body.

    Attributes:
        name: of the body.
        mass: in [kg].
        tip: the point farthest from its frame, where loads are held.
        turns: whether a joint turns it: of one that only slides no more than the mass is felt.
    """

    name: str
    mass: float
    tip: tuple[float, float, float]
    turns: bool


@dataclass(frozen=True)
class ChannelScale:
    """A recorded channel.

    Attributes:
        name: of the channel.
        unit: of its values; empty where nothing says it.
        low: smallest value.
        high: largest value.
        spread: standard deviation.
    """

    name: str
    unit: str
    low: float
    high: float
    spread: float


@dataclass(frozen=True)
class Machine:
    """The nominal model with the scales of its sites.

    Attributes:
        model: the compiled model, nominal or with edits that sites and magnitudes do not depend on.
        timestep: of the nominal model in [s].
        joints: hinge and slide joints by name.
        actuators: actuators by name.
        bodies: moving bodies with mass by name.
        channels: names of the channels that all recordings have and the model predicts.
        sampling: median sampling interval of the recordings in [s].
        duration: length of the longest recording in [s].
        scales: of every channel that all recordings have, by name.
        impacts: whether contacts may come and go as it moves, or stops are met.
    """

    model: mujoco.MjModel
    timestep: float
    joints: Mapping[str, JointScale]
    actuators: Mapping[str, ActuatorScale]
    bodies: Mapping[str, BodyScale]
    channels: tuple[str, ...]
    sampling: float
    duration: float
    scales: Mapping[str, ChannelScale]
    impacts: bool = False

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the recorded goals and auxiliary channels, which force laws may read."""
        return inputs_of(self.scales)

    @property
    def floating(self) -> frozenset[str]:
        """Joints of a base that floats in a plane, where nothing is that could rub or pull.

        They are those of a body on the world that slides in two directions and that no actuator
        drives there, as MJCF writes planar walkers.
        """
        m = self.model
        driven = set(m.actuator_trnid[:, 0][np.isin(m.actuator_trntype, ALONG_JOINT)].tolist())
        found: set[str] = set()
        for body in np.flatnonzero(m.body_parentid == 0)[1:]:
            own = [int(j) for j in np.flatnonzero(m.jnt_bodyid == body)]
            slides = sum(int(m.jnt_type[j]) == SLIDE for j in own)
            if slides >= 2 and not driven.intersection(own):
                found.update(m.joint(j).name for j in own)
        return frozenset(found)

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names of the sites of one kind."""
        if kind == "world":
            return ("world",)
        if kind == "geom":
            named = (self.model.geom(i).name for i in range(self.model.ngeom))
            return tuple(n for n in named if n)
        tables: dict[str, Mapping[str, object] | tuple[str, ...]] = {
            "joint": tuple(n for n in self.joints if n not in self.floating),
            "actuator": self.actuators,
            "body": self.bodies,
            "channel": self.channels,
        }
        return tuple(tables[kind])

    def joint_of(self, kind: str, name: str) -> JointScale | None:
        """Return the joint on which a site acts, None where there is none."""
        if kind == "actuator" and name in self.actuators:
            name = self.actuators[name].joint or ""
        elif kind == "channel":
            name = name.split(".", 1)[1]
        elif kind != "joint":
            return None
        return self.joints.get(name)


def inputs_of(channels: Iterable[str]) -> tuple[str, ...]:
    """Return the names of goals and auxiliary channels among channels."""
    held = [n for n in channels if kind_of(n) in ("goal", "aux")]
    return tuple(n for n in held if not n.startswith("aux.qacc_warmstart"))


def recorded_inputs(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the goals and auxiliary channels that all recordings have."""
    first, *rest = recordings
    return inputs_of(n for n in first.channels if all(n in r.channels for r in rest))
