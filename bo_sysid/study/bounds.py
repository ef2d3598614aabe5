"""Whether a model can have its parameters and their bounds, before anything is simulated."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

from bo_sysid.errors import ModelError

if TYPE_CHECKING:
    from bo_sysid.mjcf import Model
    from bo_sysid.parameters import Parameter
    from bo_sysid.study.study import Study

Bound = Literal["low", "high"]
_NOT_SI = dict.fromkeys(
    ("lb", "lbs", "lbm", "pound", "pounds", "oz", "ounce", "gram", "grams"), "kg"
)
_NOT_SI |= dict.fromkeys(("inch", "inches", "ft", "foot", "feet", "yd", "km"), "m")
_NOT_SI |= dict.fromkeys(("lbf", "ozf", "kgf", "gf"), "N")
_NOT_SI |= dict.fromkeys(("psi", "bar", "mbar", "kpa", "mpa", "gpa", "atm"), "Pa")
_NOT_SI |= dict.fromkeys(("hp", "kw"), "W") | {"mph": "m/s", "kph": "m/s", "h": "s", "hour": "s"}
"""Words of units in which no bounds are written, with the SI unit instead."""


def require_si(study: "Study", number: int) -> None:
    """Refuse bounds that are written in another unit than the model's, since none is converted.

    Args:
        study: with the parameter.
        number: of the parameter.

    Raises:
        StudyError: its unit is known and no SI unit, and bounds are no factors.
    """
    from bo_sysid.recording import units

    entry = study.parameters[number]
    if entry.apply == "scale":
        return
    words = [entry.unit] if units.is_unit(entry.unit) else re.findall(r"[A-Za-zµΩ°%]+", entry.unit)
    for word in words:
        si = _NOT_SI.get(word.lower(), "")
        if not si and units.is_unit(word):
            known = units.unit(word, "parameters")
            si = known.si if known.factor != 1.0 else ""
        if si:
            what = entry.unit if word == entry.unit else f"{entry.unit} has {word}"
            raise study.error(
                ("parameters", number, "unit"),
                f"{what}, and bounds are in SI units: write low and high, and the unit, with {si}",
            )


def require_one_step(
    study: "Study", parameters: Sequence["Parameter"], entries: Mapping[str, int]
) -> None:
    """Refuse the time step for a parameter.

    Windows are cut into steps of the model's own; as many of another length are another time.

    Args:
        study: has the parameters, for the message.
        parameters: of the study.
        entries: by the parameter's name, which entry of ``parameters:`` it stands in.

    Raises:
        StudyError: a parameter has the address ``option.timestep``.
    """
    for p in parameters:
        if "option.timestep" in p.addresses:
            raise study.error(
                ("parameters", entries[p.name], "address"),
                "option.timestep is no parameter: recordings are cut into steps of the model's own "
                "length, and a candidate with another would be compared at other times; diagnose "
                "looks for another time step by itself",
            )


def require_apart(
    study: "Study", model: "Model", parameters: Sequence["Parameter"], entries: Mapping[str, int]
) -> None:
    """Refuse a number of the model that two parameters have.

    Args:
        study: has the parameters, for the message.
        model: the nominal model.
        parameters: of the study.
        entries: by the parameter's name, which entry of ``parameters:`` it stands in.

    Raises:
        StudyError: the message names the number and both parameters.
    """
    from bo_sysid.mjcf.address import resolve

    owner: dict[tuple[str, str, str, int], str] = {}
    for p in parameters:
        for t in (t for a in p.addresses for t in resolve(model, a)):
            other = owner.setdefault((t.kind, t.element, t.name, t.index), p.name)
            if other != p.name:
                raise study.error(
                    ("parameters", entries[p.name], "address"),
                    f"{t.address} is parameters.{entries[other]}, {other!r}, already; each number "
                    "of the model has one parameter at most",
                )


def require_bounds(
    study: "Study", model: "Model", parameters: Sequence["Parameter"], entries: Mapping[str, int]
) -> None:
    """Refuse a bound with which a model does not compile, such as a mass below 0, or means nothing.

    Two models are compiled, all parameters at their low and at their high; only where one of them
    is refused, each parameter alone, the others as the model has them. What two parameters do
    together is left to the search.

    Args:
        study: has the parameters, for the message.
        model: the nominal model.
        parameters: of the study.
        entries: by the parameter's name, which entry of ``parameters:`` it stands in.

    Raises:
        StudyError: the message names the first such bound and what MuJoCo says of it, or that the
            quantity is never negative.
    """
    from bo_sysid.mjcf import below_zero, nominal

    bounds: tuple[Bound, ...] = ("low", "high")
    for p in parameters:
        for bound in bounds:
            if why := below_zero(model, p, getattr(p, bound)):
                raise study.error(("parameters", entries[p.name], bound), why)
    for bound in bounds:
        if not _refused(model, parameters, [getattr(p, bound) for p in parameters]):
            continue
        own = [nominal(model, p) for p in parameters]
        for k, p in enumerate(parameters):
            if why := _refused(model, parameters, [*own[:k], getattr(p, bound), *own[k + 1 :]]):
                raise study.error(("parameters", entries[p.name], bound), why)


def _refused(model: "Model", parameters: Sequence["Parameter"], values: Sequence[float]) -> str:
    """Return why a model does not compile with some values; empty where it does."""
    from bo_sysid.mjcf import parameter_edits

    edits = parameter_edits(model, parameters, values)
    try:
        model.compile(edits)
    except ModelError as error:
        return str(error)
    return ""
