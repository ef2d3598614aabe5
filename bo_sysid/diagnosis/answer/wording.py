"""A finding in words, to be read aloud."""

import re
from collections.abc import Mapping
from types import MappingProxyType

from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.effects import Site
from bo_sysid.intervals import Quantity, amount

_SHORT = 3  # letters of a name that needs its kind beside it
_ROUNDING = 1e-9  # of what the model has, that may be left where all of it is taken away
_UNDETERMINED = 0.6  # of the range of a coordinate, that its interval leaves open
_OPPOSITE = {  # what a sentence says instead of a negative value
    "too much": "too little",
    "larger forwards than backwards": "larger backwards than forwards",
}


def sentence(
    candidate: Candidate,
    quantity: Quantity,
    before: float,
    begun: float,
    details: Mapping[str, Quantity] = MappingProxyType({}),
) -> str:
    """Return a finding in words: what, where, how much, how sure.

    Args:
        candidate: what was found.
        quantity: by how much it changes the model.
        before: what the nominal model has.
        begun: what the model has that it is added to.
        details: further components by name, which a sentence may have placeholders for.
    """
    effect, site = candidate.effect, spoken(candidate.site)
    presliding = details.get(effect.components[-1].name) if candidate.preslides else None
    low, high = quantity.interval
    if presliding and begun and low < 0 < high:
        return (
            f"{definite(effect.noun)} at {site}, {begun:.4g} {quantity.unit} in the model, gives "
            f"way by {amount(presliding)} before it slips, which the model lacks."
        )
    if (before or begun) and not effect.absolute and "the model's" not in effect.sentence:
        whole = Quantity(
            after_change(begun, quantity.value), quantity.unit, (begun + low, begun + high)
        )
        now = amount(whole)
        noun = re.sub(r"^an? ", "the ", effect.noun)
        text = f"{noun} at {site} is {now}, not {before:.4g} as in the model."
    else:
        text = effect.sentence
        for word, opposite in _OPPOSITE.items():
            if word in text and quantity.value < 0:
                text, quantity = text.replace(word, opposite), _negated(quantity)
        size = amount(quantity)
        if any(words in text for both in _OPPOSITE.items() for words in both):
            size = size.removeprefix("+")
        if any(f"{{{name}}}" in text for name in details):  # each of several may be nothing
            size += _may_be_nothing(quantity)
        more = {name: amount(q) + _may_be_nothing(q) for name, q in details.items()}
        more["details"] = " and ".join(details)
        between = f"{quantity.interval[0]:.4g} to {quantity.interval[1]:.4g}"
        text = text.format_map({**more, "site": site, "value": size, "interval": between})
    if presliding:
        text += f" It gives way by {amount(presliding)} before it slips."
    if candidate.moved:
        text += f" {_place_sentence(candidate, details)}"
    elif candidate.extent.place:
        at = ", ".join(f"{round(d, 6) or 0.0:.3g}" for d in candidate.shapes)  # in whole um
        text += f" It is taken to lie at ({at}) m in the frame of {site}."
    return text[0].upper() + text[1:]


def _may_be_nothing(quantity: Quantity) -> str:
    """Return the words that an amount may be nothing, where its interval holds that."""
    low, high = quantity.interval
    return ", which may be nothing" if low <= 0 <= high else ""


def definite(noun: str) -> str:
    """Return a noun as a sentence begins with it: a payload becomes The payload."""
    return f"The {re.sub(r'^(an?|the) ', '', noun)}"


def _place_sentence(c: Candidate, details: Mapping[str, Quantity]) -> str:
    """Return where a load lies, and which of its coordinates the recordings do not tell."""
    known: list[str] = []
    unknown_places: list[str] = []
    bounds = zip(c.effect.components, c.low, c.high, strict=True)
    for component, low, high in list(bounds)[c.effect.acting :]:
        if component.name in details:
            first, last = details[component.name].interval
            unknown = last - first > _UNDETERMINED * (high - low)
            words = f"{component.name} = {amount(details[component.name])}"
            (unknown_places if unknown else known).append(component.name if unknown else words)
    text = f"It lies at {', '.join(known)} in the frame of {spoken(c.site)}" if known else ""
    if unknown_places:
        text += "; the" if known else "The"
        text += f" recordings do not tell its {' and '.join(unknown_places)}"
    return f"{text}."


def spoken(site: Site) -> str:
    """Return a site as it is said: "the elbow", "joint x", "joint7"."""
    name = site.name.replace("_", " ")
    if site.kind == "world":
        return "the machine"
    plain = len(name) > _SHORT and name.replace(" ", "").isalpha()
    if plain:
        return f"the {name}"
    return name if name.startswith(site.kind) else f"{site.kind} {site.name}"


def plural(kind: str) -> str:
    """Return what several sites of a kind are called."""
    return {"joint": "joints", "actuator": "actuators", "body": "bodies"}.get(kind, "sites")


def after_change(before: float, change: float) -> float:
    """Return what there is after a change; 0 where all of it is taken away, but for rounding."""
    after = before + change
    return 0.0 if abs(after) < _ROUNDING * abs(before) else after


def _negated(quantity: Quantity) -> Quantity:
    low, high = quantity.interval
    return Quantity(-quantity.value, quantity.unit, (-high, -low))
