"""Addresses such as `joint[elbow].damping`, and the edits that write to them."""

import fnmatch
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, Self

import mujoco
import numpy as np

from bo_sysid.errors import ModelError, nearest
from bo_sysid.mjcf.attributes import ATTRIBUTES, Attribute, refusal, size_of
from bo_sysid.mjcf.inertia import mass_key
from bo_sysid.mjcf.model import Model
from bo_sysid.mjcf.sources import NAMED_KINDS
from bo_sysid.mjcf.values import compiled_vector, geom_mass, write_body_mass, write_value

Apply = Literal["set", "scale", "add"]

_FORM = re.compile(
    r"(?P<kind>\w+)(?:\[(?P<pattern>.+)\])?\.(?P<attribute>\w+)(?:\[(?P<index>\d+)\])?"
)


@dataclass(frozen=True)
class Address:
    """Where a number stands in a model: `kind[name].attribute[index]` or `option.attribute`.

    Attributes:
        kind: "joint", "geom", "body", "site", "actuator", "tendon", "equality", "pair" or
            "option".
        pattern: name of the element, where `*`, `?` and `[abc]` match as in file names; empty
            for "option".
        attribute: MJCF name of the attribute.
        index: component, or None for a single number; `damping` and `stiffness` without an
            index mean their linear term.
    """

    kind: str
    pattern: str
    attribute: str
    index: int | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read an address as a study writes it.

        Raises:
            ModelError: it has not the form of an address, or there is no such kind or attribute.
        """
        parts = _FORM.fullmatch(text.strip())
        if parts is None:
            raise ModelError(
                f"address {text!r}: must look like joint[elbow].damping, "
                "geom[*].friction[0] or option.gravity[2]"
            )
        kind, pattern, attribute = parts["kind"], parts["pattern"] or "", parts["attribute"]
        if kind not in ATTRIBUTES:
            raise ModelError(
                f"address {text!r}: no kind of element {kind!r}; {nearest(kind, ATTRIBUTES)}"
            )
        if (kind == "option") == bool(pattern):
            form = "option.gravity[2]" if kind == "option" else f"{kind}[name].{attribute}"
            raise ModelError(f"address {text!r}: must look like {form}")
        if attribute not in ATTRIBUTES[kind]:
            raise ModelError(
                f"address {text!r}: {attribute!r} is not a number of a model's {kind} that can be "
                f"addressed; {nearest(attribute, ATTRIBUTES[kind])}"
            )
        return cls(kind, pattern, attribute, int(parts["index"]) if parts["index"] else None)

    def __str__(self) -> str:
        element = f"[{self.pattern}]" if self.pattern else ""
        index = "" if self.index is None else f"[{self.index}]"
        return f"{self.kind}{element}.{self.attribute}{index}"

    def matches(self, model: Model) -> tuple[str, ...]:
        """Return the concrete addresses, one for each element, in MuJoCo's order.

        A wildcard passes over elements that do not have the number (the mass of a geom that
        belongs to the world, the second size of a sphere); an exact name may not.

        Raises:
            ModelError: nothing matches, or the element does not have the number.
        """
        return tuple(target.address for target in resolve(model, str(self)))

    def read(self, model: Model) -> float:
        """Return the model's own value, as compiled: angles in rad, masses from densities.

        Raises:
            ModelError: the address matches nothing or more than one element.
        """
        targets = resolve(model, str(self))
        if len(targets) != 1:
            raise ModelError(f"address '{self}': matches {len(targets)} elements; name one")
        return targets[0].nominal


@dataclass(frozen=True)
class Target:
    """One number of one model.

    Attributes:
        address: its concrete address.
        kind: kind of element.
        element: name of the element; empty for "option".
        name: MJCF name of the attribute.
        attribute: where spec and model keep it.
        index: component, 0 for a single number.
        nominal: the model's own value.
        mass_key: for a body's mass, what in the spec it is made of.
    """

    address: str
    kind: str
    element: str
    name: str
    attribute: Attribute
    index: int
    nominal: float
    mass_key: tuple[object, ...] = ()

    @property
    def moves_mass(self) -> bool:
        """Whether masses or inertias depend on it."""
        return (self.kind, self.name) in _MASS

    @property
    def stage(self) -> int:
        """Shapes and densities come first, then a body's mass, then its inertia."""
        if self.kind != "body":
            return 0
        return {"mass": 1, "inertia": 2, "ipos": 2}.get(self.name, 0)


_MASS = {
    *(("geom", name) for name in ("mass", "density", "size", "pos")),
    *(("body", name) for name in ("mass", "inertia", "ipos")),
}


@dataclass(frozen=True)
class AddressEdit:
    """Writes values to addresses of the model that it was made for.

    Attributes:
        text: what it does, for messages.
        writes: each number with its new value; one that is its own is not written, so that an
            edit without a change leaves the compiled model the same to the last bit.
        model: the model.
    """

    text: str
    writes: tuple[tuple[Target, float], ...]
    model: Model

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
        nominal = self.model._forms.base_model
        for t, value in self.writes:
            if (t.kind, t.name) == ("body", "mass"):
                present = float(nominal.body(t.element).mass[0])
                write_body_mass(spec, t.element, value, present, t.mass_key)
            else:
                write_value(spec, nominal, t.kind, t.element, t.name, t.attribute, t.index, value)

    def __str__(self) -> str:
        return self.text


class ParameterLike(Protocol):
    """What `parameter_edits` needs to know of a parameter."""

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses that share the value."""

    @property
    def apply(self) -> Apply:
        """How the value is applied."""


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
    return AddressEdit(text, tuple(w for w in writes if w[1] != w[0].nominal), model)


def _applied(own: float, value: float, apply: Apply) -> float:
    if apply == "scale":
        return own * value
    return own + value if apply == "add" else float(value)


def parameter_edits(
    model: Model, parameters: Sequence[ParameterLike], values: Iterable[float]
) -> list[AddressEdit]:
    """Return the edits that give each parameter its value.

    Shapes and densities come first, then masses of bodies, then inertias, so that a body's mass
    is what was asked for whatever its geoms' sizes became.

    Args:
        model: the model to be edited.
        parameters: d parameters with `addresses` and `apply`.
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
        edits.append(address_edit(model, parameter.addresses, float(value), parameter.apply))
    return sorted(edits, key=lambda edit: edit.stage)


def resolve(model: Model, address: str) -> tuple[Target, ...]:
    """Return the numbers that an address names in a model; remembered by the model.

    Raises:
        ModelError: nothing matches, or an element named exactly does not have the number.
    """
    known: dict[str, tuple[Target, ...]] = model._forms.resolved
    if address not in known:
        known[address] = _resolve(model, Address.parse(address))
    return known[address]


def _resolve(model: Model, address: Address) -> tuple[Target, ...]:
    spec = model._forms.lean
    if address.kind == "option":
        return (_target(model, address, "", spec.option),)
    elements = sorted(getattr(spec, NAMED_KINDS[address.kind]), key=lambda e: int(e.id))
    exact = [e for e in elements if e.name == address.pattern]
    if exact:
        return (_target(model, address, address.pattern, exact[0]),)
    matching = [e for e in elements if fnmatch.fnmatchcase(e.name, address.pattern)]
    if not matching:
        names = [e.name for e in elements]
        hint = nearest(address.pattern, names) or f"the model has no {address.kind}"
        raise ModelError(f"{model.source}: '{address}': no such {address.kind}; {hint}")
    targets, refused = [], []
    for element in matching:
        try:
            targets.append(_target(model, address, element.name, element))
        except ModelError as error:
            refused.append(error)
    if not targets:
        raise refused[0]
    return tuple(targets)


def _target(model: Model, address: Address, element: str, target: Any) -> Target:
    """Return one concrete number.

    Raises:
        ModelError: the element does not have it.
    """
    kind, name = address.kind, address.attribute
    attribute = ATTRIBUTES[kind][name]
    concrete = Address(kind, element, name, address.index)
    where = f"{model.source}: '{concrete}'"
    reason = refusal(kind, name, target)
    if reason:
        raise ModelError(f"{where}: {reason}")
    size = size_of(kind, name, target)
    index = address.index
    if size == 0 and index is not None:
        raise ModelError(f"{where}: {name} is a single number; leave out [{index}]")
    if size > 0 and index is None:
        if not attribute.polynomial:
            raise ModelError(f"{where}: needs an index, {name}[0] to {name}[{size - 1}]")
        index = 0
    if index is not None and index >= size:
        raise ModelError(f"{where}: index out of range; {name}[0] to {name}[{size - 1}] are valid")
    row = index or 0
    key = mass_key(model._forms.base, element) if (kind, name) == ("body", "mass") else ()
    value = _nominal(model, kind, element, name, attribute, row)
    return Target(str(concrete), kind, element, name, attribute, row, value, key)


def _nominal(
    model: Model, kind: str, element: str, name: str, attribute: Attribute, index: int
) -> float:
    if kind == "geom" and name == "mass":
        return geom_mass(model._forms.base, element)
    if kind == "geom" and name == "density":
        return float(model._forms.base.geom(element).density)
    if name in ("kp", "kv"):
        actuator = model._forms.model.actuator(element)
        return float(actuator.gainprm[0] if name == "kp" else -actuator.biasprm[2])
    return float(compiled_vector(model._forms.model, kind, element, attribute)[index])
