"""What a plant of the proof is made of, apart from the catalogue and apart from any simulator.

A plant has a body (masses, inertias, gravity: a compiled model), a drive for each actuator, laws of
force at joints, and encoders. The catalogue's effects are edits of MJCF; here the same physics is
written a second time as forces, so that an error in the one is not hidden by the other. What is
smooth but stiff in nature is so here: dry friction is Dahl's, with a bristle that has a state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, TypeAlias

import mujoco

State: TypeAlias = Sequence[float]
ForceAt: TypeAlias = Callable[[float, State, State, State], float]
"""(t, q, v, load) -> force along a joint in [N m] or [N].

By degree of freedom: q and v of the motion, load what the drives put in."""


@dataclass(frozen=True)
class Concealed:
    """Physics that a plant has and its nominal model lacks; a part of the sealed answer.

    Attributes:
        effect: id in the catalogue, or a name of its own where the catalogue has none.
        kind: kind of site.
        site: name of the site.
        value: magnitude in `unit`, as the catalogue defines it.
        unit: of the value at this site.
        details: further numbers of the effect, and of the form that the plant gives it.
        depends_on: what the force depends on; only for physics outside the catalogue.
    """

    effect: str
    kind: str
    site: str
    value: float
    unit: str
    details: Mapping[str, float] = field(default_factory=dict)
    depends_on: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "details", MappingProxyType(dict(self.details)))

    def plain(self) -> dict[str, Any]:
        """Return it for JSON."""
        own = {name: getattr(self, name) for name in ("effect", "kind", "site", "value", "unit")}
        return own | {"details": dict(self.details), "depends_on": list(self.depends_on)}


@dataclass(frozen=True)
class Law:
    """A force along one joint that follows from the motion at once.

    Attributes:
        dof: degree of freedom on which it acts.
        force: as a function of time and motion.
    """

    dof: int
    force: ForceAt


@dataclass(frozen=True)
class Bristle:
    """Dry friction with presliding: Dahl's model, Canudas de Wit's for a level that varies.

    The bristle's deflection z in units of its yield deflection δ follows
    dz/dt = (v - |v| z)/δ, and the force is -g·(z + τ dz/dt) with g the steady level of friction
    at this time and motion. In steady sliding z = sign v and the force is Coulomb's. Dahl (1968),
    "A solid friction model"; Canudas de Wit, Olsson, Åström, Lischinsky (1995), "A new model for
    control of systems with friction", with the stiffness proportional to the level.

    Attributes:
        dof: degree of freedom on which it acts.
        level: g ≥ 0 in [N m] or [N].
        yields: δ in [rad] or [m].
        damping: τ in [s]; 0 is Dahl's model.
    """

    dof: int
    level: ForceAt
    yields: float
    damping: float = 0.0


@dataclass(frozen=True)
class Drive:
    """An actuator on one joint, from the command to the force.

    The command arrives `delay` late, loses what lies within `deadzone`, and passes a first-order
    lag. The force is gear·clip(gain·u + b0 + b1·gear·q + b2·gear·v), limited to ±`limit`.

    Attributes:
        dof: degree of freedom that it drives.
        gear: force along the joint per actuator force.
        gain: actuator force per command.
        bias: (b0, b1, b2); b1 is not zero in a position servo, whose q is what its encoder reads.
        limit: largest force along the joint.
        deadzone: half width, in the command's unit.
        lag: time constant in [s].
        delay: in [s].
        offset: what the encoder reads too much, for a servo.
        scale: by which share the encoder reads too much, for a servo.
    """

    dof: int
    gear: float
    gain: float
    bias: tuple[float, float, float]
    limit: float = float("inf")
    deadzone: float = 0.0
    lag: float = 0.0
    delay: float = 0.0
    offset: float = 0.0
    scale: float = 0.0

    @property
    def servo(self) -> bool:
        """Whether its force depends on the position of the joint."""
        return self.bias[1] != 0

    def command(self, u: float) -> float:
        """Return what is left of a command behind the dead zone."""
        return u - min(max(u, -self.deadzone), self.deadzone)

    def force(self, u: float, q: float, v: float) -> float:
        """Return the force along the joint for a command behind dead zone and lag."""
        b0, b1, b2 = self.bias
        read = self.gear * ((1.0 + self.scale) * q + self.offset)
        force = self.gear * (self.gain * u + b0 + b1 * read + b2 * self.gear * v)
        return min(max(force, -self.limit), self.limit)


@dataclass(frozen=True)
class Encoder:
    """What is recorded of a joint: (1 + scale)·q(t - delay) + offset, then rounded.

    Attributes:
        scale: relative.
        offset: in [rad] or [m].
        delay: in [s].
        motor_side: reads the rotor where there is a transmission with a rotor.
    """

    scale: float = 0.0
    offset: float = 0.0
    delay: float = 0.0
    motor_side: bool = False


@dataclass(frozen=True)
class Transmission:
    """A rotor and a link with a gap or a spring between them: backlash or compliance.

    Within the gap the rotor is free; beyond, force = stiffness·(deflection - gap/2) plus damping.

    Attributes:
        dof: of the link.
        inertia: of the rotor; taken off the link's armature.
        gap: total gap in [rad].
        stiffness: in [N m/rad].
        damping: in [N m s/rad], where in contact.
    """

    dof: int
    inertia: float
    gap: float
    stiffness: float
    damping: float

    def force(self, turn: float, speed: float) -> float:
        """Return what the rotor does to the link, for their relative position and velocity."""
        beyond = turn - min(max(turn, -0.5 * self.gap), 0.5 * self.gap)
        if beyond == 0.0 and self.gap > 0:
            return 0.0
        return self.stiffness * beyond + self.damping * speed


@dataclass(frozen=True)
class Physics:
    """A plant before anyone integrates it.

    Attributes:
        model: compiled; masses, inertias, armature, joint springs and damping, gravity, contact.
        drives: one an actuator, in the model's order.
        encoders: one a degree of freedom.
        laws: further forces at joints.
        bristles: dry friction at joints.
        transmission: at most one joint with a rotor of its own.
    """

    model: mujoco.MjModel
    drives: tuple[Drive, ...]
    encoders: tuple[Encoder, ...]
    laws: tuple[Law, ...] = ()
    bristles: tuple[Bristle, ...] = ()
    transmission: Transmission | None = None


def nominal_physics(model: mujoco.MjModel) -> Physics:
    """Return the plant that is exactly its model: hinges, slides, and actuators on joints."""
    drives = tuple(
        Drive(
            int(model.jnt_dofadr[model.actuator_trnid[a, 0]]),
            float(model.actuator_gear[a, 0]),
            float(model.actuator_gainprm[a, 0]),
            _bias(model, a),
        )
        for a in range(model.nu)
    )
    return Physics(model, drives, (Encoder(),) * model.nv)


def _bias(model: mujoco.MjModel, a: int) -> tuple[float, float, float]:
    if int(model.actuator_biastype[a]) != int(mujoco.mjtBias.mjBIAS_AFFINE):
        return (0.0, 0.0, 0.0)
    b0, b1, b2 = (float(b) for b in model.actuator_biasprm[a, :3])
    return (b0, b1, b2)
