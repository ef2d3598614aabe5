"""Edits that write values to addresses."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.errors import ModelError, nearest
from bo_sysid.mjcf.address import resolve
from bo_sysid.mjcf.attributes import NOT_NEGATIVE
from bo_sysid.mjcf.commands import LAGS
from bo_sysid.mjcf.compiling import make_room
from bo_sysid.mjcf.model import Model
from bo_sysid.mjcf.plain import add_plain
from bo_sysid.mjcf.values import Target, write_value

Apply = Literal["set", "scale", "add"]

_ROUNDING = 1e-9  # of a number, that a change by -100 % may leave of it
_TIMED = (*LAGS, int(mujoco.mjtDyn.mjDYN_MUSCLE))  # whose first number is a time constant
_LIT = 0.6  # headlight of a picture, at least


@dataclass(frozen=True)
class AddressEdit:
    """Writes values to addresses of the model that it was made for.

    Attributes:
        text: what it does, for messages.
        writes: each number with its new value.
        model: the model.
        room: delays with the longest that they may have, in [s], for which buffers are made.
    """

    text: str
    writes: tuple[tuple[Target, float], ...]
    model: Model
    room: tuple[tuple[Target, float], ...] = ()

    @property
    def moves_mass(self) -> bool:
        """Whether masses or inertias may change."""
        return any(target.moves_mass for target, _ in self.writes)

    @property
    def stage(self) -> int:
        """When to apply it among other edits: see `parameter_edits`."""
        return max((target.stage for target, _ in self.writes), default=0)

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Apply it to a copy of the model's spec, in place."""
        for target, value in self.writes:
            write_value(spec, self.model._forms.base_model, target, value)
        for target, longest in self.room:
            make_room(spec, spec.actuator(target.element), longest)

    def __str__(self) -> str:
        return self.text


@runtime_checkable
class ParameterLike(Protocol):
    """What `parameter_edits` needs to know of a parameter."""

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses that share the value."""

    @property
    def apply(self) -> Apply:
        """How the value is applied."""

    @property
    def low(self) -> float:
        """Lower bound."""

    @property
    def high(self) -> float:
        """Upper bound."""


def address_edit(
    model: Model, addresses: Sequence[str], value: float, apply: Apply = "set"
) -> AddressEdit:
    """Return the edit that gives tied addresses one value.

    Args:
        model: the model to be edited.
        addresses: addresses, with or without wildcards.
        value: the value, in the units of the compiled model (angles in rad).
        apply: "set" writes it, "scale" multiplies each number's own by it, "add" adds it.

    Raises:
        ModelError: an address matches nothing, or the value is not finite.
    """
    text = f"{', '.join(addresses)} {apply} {value:g}"
    if not np.isfinite(value):
        raise ModelError(f"{model.source}: {text}: the value must be finite")
    if apply not in ("set", "scale", "add"):
        raise ModelError(f"{model.source}: {text}: {nearest(apply, ('set', 'scale', 'add'))}")
    targets = [target for address in addresses for target in resolve(model, address)]
    writes = [(target, _applied(target.nominal, value, apply)) for target in targets]
    return AddressEdit(text, tuple(writes), model)


def _applied(own: float, value: float, apply: Apply) -> float:
    if apply == "scale":
        return own * value
    return own + value if apply == "add" else float(value)


def nominal(model: Model, parameter: ParameterLike) -> float:
    """Return the value of a parameter that stands for the model as it is.

    A factor of 1, a change of 0, or the model's own value; of tied addresses that differ in the
    model the mean, since no one value leaves all of them as they are.

    Raises:
        ModelError: an address matches nothing.
    """
    neutral = {"scale": 1.0, "add": 0.0}
    if parameter.apply in neutral:
        return neutral[parameter.apply]
    return float(np.mean([t.nominal for a in parameter.addresses for t in resolve(model, a)]))


def below_zero(model: Model, parameter: ParameterLike, value: float) -> str:
    """Return which number would be negative and may not be, and the least value; else nothing.

    Raises:
        ModelError: an address matches nothing.
    """
    targets = [t for a in parameter.addresses for t in resolve(model, a)]
    bound = [(t, what) for t in targets if (what := _not_negative(model, t))]
    for t, what in bound:
        number = _applied(t.nominal, value, parameter.apply)
        if number < -_ROUNDING * abs(t.nominal):
            least = max(-t.nominal for t, _ in bound) if parameter.apply == "add" else 0.0
            return (
                f"{t.address} would be {number:g}, and {what} is never negative; at least {least:g}"
            )
    return ""


def _not_negative(model: Model, target: Target) -> str:
    """Return in words what a number is that may not be negative; nothing where it may."""
    if (target.kind, target.name, target.index) == ("actuator", "dynprm", 0):
        compiled = model.compile()
        kind = int(compiled.actuator_dyntype[compiled.actuator(target.element).id])
        return "a time constant" if kind in _TIMED else ""
    return NOT_NEGATIVE.get((target.kind, target.name), "")


def parameter_edits(
    model: Model, parameters: Sequence[ParameterLike], values: Iterable[float]
) -> list[AddressEdit]:
    """Return the edits that give each parameter its value.

    Shapes and densities come first, then masses of bodies, then inertias, so that a body's mass
    is what was asked for whatever its geoms' sizes became. Buffers of delays are as long for any
    values within the bounds.

    Args:
        model: the model to be edited.
        parameters: d parameters with `addresses`, `apply` and bounds.
        values: d values.

    Raises:
        ModelError: an address matches nothing, or two parameters share one.
    """
    owner: dict[tuple[str, str, str, int], int] = {}
    edits = []
    for i, (parameter, value) in enumerate(zip(parameters, values, strict=True)):
        for address in parameter.addresses:
            for t in resolve(model, address):
                if owner.setdefault((t.kind, t.element, t.name, t.index), i) != i:
                    raise ModelError(f"{model.source}: two parameters share {t.address}")
        edit = address_edit(model, parameter.addresses, float(value), parameter.apply)
        edits.append(replace(edit, room=_longest_delays(model, parameter)))
    return sorted(edits, key=lambda edit: edit.stage)


def room_for_delays(model: Model, parameters: Sequence[ParameterLike]) -> list[AddressEdit]:
    """Return the edits that leave a model as it is but for buffers, as `parameter_edits` has them.

    Args:
        model: the model to be edited.
        parameters: whose bounds say how long delays may be.
    """
    rooms = [_longest_delays(model, p) for p in parameters]
    return [AddressEdit("buffers of delays", (), model, room) for room in rooms if room]


def _longest_delays(model: Model, parameter: ParameterLike) -> tuple[tuple[Target, float], ...]:
    """Return the delays of actuators that a parameter has, with the longest within its bounds."""
    targets = [t for address in parameter.addresses for t in resolve(model, address)]
    ends = (parameter.low, parameter.high)
    return tuple(
        (t, max(_applied(t.nominal, end, parameter.apply) for end in ends))
        for t in targets
        if (t.kind, t.name) == ("actuator", "delay")
    )


@dataclass(frozen=True)
class MotorEdit:
    """Adds a motor that acts on a joint with as many N m (N) as its control says.

    Attributes:
        joint: name of a hinge or slide joint, which also names the motor.
    """

    joint: str
    moves_mass = False

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Add the motor."""
        joint = mujoco.mjtTrn.mjTRN_JOINT
        motor = add_plain(spec, "actuator", name=self.joint, target=self.joint, trntype=joint)
        motor.set_to_motor()


@dataclass(frozen=True)
class RangeEdit:
    """Narrows what actuators may be told and what they may do.

    A range that is narrower already, as of a motor that saturates, stays.

    Attributes:
        controls: least and largest control by actuator, within its joint's range where a servo
            inherits that.
        forces: least and largest force by actuator, in [N m] or [N] before the gear.
    """

    controls: Mapping[str, tuple[float, float]]
    forces: Mapping[str, tuple[float, float]]
    moves_mass = False

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Narrow the ranges."""
        for name, bound in self.controls.items():
            a = spec.actuator(name)
            if a.inheritrange > 0 and a.dyntype != mujoco.mjtDyn.mjDYN_INTEGRATOR:
                # its joint's range, within which controls are bounded already
                a.inheritrange, a.ctrllimited = 0.0, mujoco.mjtLimited.mjLIMITED_FALSE
            a.ctrlrange = _narrowed(bound, a.ctrllimited, a.ctrlrange)
            a.ctrllimited = True
        for name, bound in self.forces.items():
            a = spec.actuator(name)
            a.forcerange = _narrowed(bound, a.forcelimited, a.forcerange)
            a.forcelimited = True

    def __str__(self) -> str:
        return f"ranges of {', '.join({**self.controls, **self.forces})}"


def _narrowed(
    bound: tuple[float, float], limited: mujoco.mjtLimited, own: Float[np.ndarray, "2"]
) -> tuple[float, float]:
    """Return a bound within the range that there is, if any."""
    auto = limited == mujoco.mjtLimited.mjLIMITED_AUTO and own[0] == own[1]
    if auto or limited == mujoco.mjtLimited.mjLIMITED_FALSE:
        return bound
    return max(bound[0], float(own[0])), min(bound[1], float(own[1]))


@dataclass(frozen=True)
class SkyEdit:
    """Adds a white sky where a model has none, and light, for pictures.

    A model's own lights may leave what the picture shows in the dark.
    """

    moves_mass = False

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Add them."""
        sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX
        if not any(t.type == sky for t in spec.textures):
            white = {"rgb1": [1.0, 1.0, 1.0], "rgb2": [1.0, 1.0, 1.0], "width": 8, "height": 48}
            flat = mujoco.mjtBuiltin.mjBUILTIN_FLAT
            spec.add_texture(name="bo_sysid_sky", type=sky, builtin=flat, **white)
        head = spec.visual.headlight
        head.ambient[:] = np.maximum(head.ambient, _LIT)
        head.diffuse[:] = np.maximum(head.diffuse, _LIT)
