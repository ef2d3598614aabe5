"""Addresses such as `joint[elbow].damping`, and the numbers that they name in a model."""

import fnmatch
import re
from dataclasses import dataclass
from typing import Any

from bo_sysid.errors import ModelError, nearest
from bo_sysid.mjcf.attributes import ATTRIBUTES, Attribute, refusal, size_of
from bo_sysid.mjcf.model import Model
from bo_sysid.mjcf.sources import NAMED_KINDS
from bo_sysid.mjcf.values import Target, compiled_vector, geom_mass, made_of

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
    def parse(cls, text: str) -> "Address":
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
    forms = (model._forms.base, model._forms.lean)
    keys = tuple(made_of(form, kind, element, name) for form in forms)
    value = _nominal(model, kind, element, name, attribute, row)
    return Target(str(concrete), kind, element, name, attribute, row, value, keys)


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
