"""Findings: what a fit says in numbers and in words."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.answer.exchanges import Entry, Key
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.shapes import ranges
from bo_sysid.diagnosis.windows.hypothesis import Candidate, slices_of
from bo_sysid.effects import Machine, Site, unit_at

_SHORT = 3  # letters of a name that needs its kind beside it
_QUANTILE = 1.96
_RELATIVE = 0.005  # model error of magnitudes, beside the statistical one
_RELATIVE_BENT = 0.15  # the same of speed and bend of friction: a time step changes what they do
_TIME = 0.3e-3  # [s] the same for times
_ROUNDING = 1e-9  # of what the model has, that may be left where all of it is taken away
_UNTOLD = 0.6  # of the range of a coordinate, that its interval leaves open
_OPPOSITE = {  # what a sentence says instead of a negative value
    "too much": "too little",
    "larger forwards than backwards": "larger backwards than forwards",
}


_UNSPOKEN = ("relative", "fraction", "fraction of the load torque", "coefficient", "–")
"""Units of pure numbers, which sentences say otherwise."""


@dataclass(frozen=True)
class Quantity:
    """A number with its 95 % interval."""

    value: float
    unit: str
    interval: tuple[float, float]


@dataclass(frozen=True)
class Finding:
    """An effect at a site.

    Attributes:
        effect: id.
        kind: kind of site.
        site: name of the site.
        quantity: the change that is added to the nominal model.
        before: the quantity in the nominal model.
        after: the quantity in the repaired model, the study's parameters fitted.
        details: further components by name.
        group: id of the effect that was found on several sites at once, None otherwise.
        probability: of the set that the finding belongs to.
        equivalents: sets that may stand in its place, for all that the recordings tell.
        sentence: to be read aloud.
        x: the magnitudes, as the effect takes them.
    """

    effect: str
    kind: str
    site: str
    quantity: Quantity
    before: float
    after: float
    details: Mapping[str, Quantity]
    group: str | None
    probability: float
    equivalents: tuple[tuple[Entry, ...], ...]
    sentence: str
    x: tuple[float, ...]

    def as_json(self) -> dict[str, object]:
        """Return the finding as `diagnosis.json` has it."""
        return {
            "effect": self.effect,
            "kind": self.kind,
            "site": self.site,
            "value": self.quantity.value,
            "unit": self.quantity.unit,
            "interval": list(self.quantity.interval),
            "before": self.before,
            "after": self.after,
            "details": {
                n: {"value": q.value, "unit": q.unit, "interval": list(q.interval)}
                for n, q in self.details.items()
            },
            "group": self.group,
            "probability": self.probability,
            "equivalents": [list(e) for e in self.equivalents],
            "sentence": self.sentence,
        }


def quantities(fit: Fit, machine: Machine) -> tuple[Quantity, ...]:
    """Return the value of each member of a fit as it is reported."""
    slices = slices_of(fit.members)
    return tuple(
        _value(c, x, fit.covariance[own, own], machine)
        for c, x, own in zip(fit.members, fit.x, slices, strict=True)
    )


def findings(
    fit: Fit,
    machine: Machine,
    probability: float,
    fitted: Machine | None = None,
    equivalents: Mapping[Key, tuple[tuple[Entry, ...], ...]] = MappingProxyType({}),
) -> tuple[Finding, ...]:
    """Return the findings of a fit.

    Args:
        fit: of the set that is answered.
        machine: with the nominal model.
        probability: of the set.
        fitted: with the model that the effects are added to, in which the study's parameters were
            fitted; the nominal one where left out.
        equivalents: what may stand in the place of each, by effect and site.
    """
    fitted = fitted or machine
    found, slices = [], slices_of(fit.members)
    unsure = fit.spread or tuple(np.zeros(len(c.shapes)) for c in fit.members)
    terms = zip(
        fit.members, fit.x, quantities(fit, machine), fit.groups, unsure, slices, strict=True
    )
    for candidate, x, quantity, label, spread, own in terms:
        before = candidate.effect.nominal(candidate.site, machine)
        begun = candidate.effect.nominal(candidate.site, fitted)
        details = _details(candidate, x, fit.covariance[own, own], spread, fitted)
        found.append(
            Finding(
                candidate.effect.id,
                candidate.site.kind,
                candidate.site.name,
                quantity,
                before,
                quantity.value if candidate.effect.absolute else _sum(begun, quantity.value),
                details,
                _group_words(label, candidate, fit),
                probability,
                equivalents.get(candidate.key, ()),
                sentence(candidate, quantity, before, begun, details),
                tuple(float(v) for v in candidate.full(x)),
            )
        )
    return tuple(found)


def named(fit: Fit, machine: Machine) -> tuple[Entry, ...]:
    """Return the set of a fit as {effect, kind, site, value} each."""
    return tuple(
        {
            "effect": c.effect.id,
            "kind": c.site.kind,
            "site": c.site.name,
            "value": c.effect.reported(c.full(x), machine, c.site),
        }
        for c, x in zip(fit.members, fit.x, strict=True)
    )


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
    bend = details.get(effect.components[-1].name) if candidate.bent else None
    low, high = quantity.interval
    if bend and begun and low < 0 < high:
        return (
            f"The {effect.noun} at {site}, {begun:.4g} {quantity.unit} in the model, gives way by "
            f"{amount(bend)} before it slips, which the model lacks."
        )
    if (before or begun) and not effect.absolute and "the model's" not in effect.sentence:
        whole = Quantity(_sum(begun, quantity.value), quantity.unit, (begun + low, begun + high))
        now = amount(whole)
        noun = re.sub(r"^an? ", "the ", effect.noun)
        text = f"{noun} at {site} is {now}, not {before:.4g} as in the model."
    else:
        text = effect.sentence
        for said, opposite in _OPPOSITE.items():
            if said in text and quantity.value < 0:
                text, quantity = text.replace(said, opposite), _negated(quantity)
        size = amount(quantity)
        if any(words in text for both in _OPPOSITE.items() for words in both):
            size = size.removeprefix("+")
        more = {name: amount(q) for name, q in details.items()}
        between = f"{quantity.interval[0]:.4g} to {quantity.interval[1]:.4g}"
        text = text.format_map({**more, "site": site, "value": size, "interval": between})
    if bend:
        text += f" It gives way by {amount(bend)} before it slips."
    if candidate.moved:
        text += f" {_place_sentence(candidate, details)}"
    elif candidate.extent.place:
        at = ", ".join(f"{d:.3g}" for d in candidate.shapes)
        text += f" It is taken to lie at ({at}) m in the frame of {site}."
    return text[0].upper() + text[1:]


def _place_sentence(c: Candidate, details: Mapping[str, Quantity]) -> str:
    """Return where a load lies, and which of its coordinates the recordings do not tell."""
    told: list[str] = []
    untold: list[str] = []
    bounds = zip(c.effect.components, c.low, c.high, strict=True)
    for component, low, high in list(bounds)[c.effect.acting :]:
        if component.name in details:
            first, last = details[component.name].interval
            unknown = last - first > _UNTOLD * (high - low)
            words = f"{component.name} = {amount(details[component.name])}"
            (untold if unknown else told).append(component.name if unknown else words)
    text = f"It lies at {', '.join(told)} in the frame of {spoken(c.site)}" if told else ""
    if untold:
        text += "; the" if told else "The"
        text += f" recordings do not tell its {' and '.join(untold)}"
    return f"{text}."


def _sum(before: float, change: float) -> float:
    """Return what there is after a change; 0 where all of it is taken away, but for rounding."""
    after = before + change
    return 0.0 if abs(after) < _ROUNDING * abs(before) else after


def _negated(quantity: Quantity) -> Quantity:
    low, high = quantity.interval
    return Quantity(-quantity.value, quantity.unit, (-high, -low))


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


def amount(quantity: Quantity) -> str:
    """Return "0.151 ± 0.002 N m": the uncertainty with one digit, two where it begins with 1."""
    half = 0.5 * (quantity.interval[1] - quantity.interval[0])
    spoken_unit = "" if quantity.unit in _UNSPOKEN else f" {quantity.unit}"
    if half <= 0 or not np.isfinite(half):
        return f"{quantity.value:.4g}{spoken_unit}"
    exponent = int(np.floor(np.log10(half)))
    digits = max(-exponent + (1 if half / 10.0**exponent < 2 else 0), 0)
    if quantity.unit == "relative":
        digits = max(digits - 2, 0)
        return f"{100 * quantity.value:+.{digits}f} ± {100 * half:.{digits}f} %"
    return f"{quantity.value:.{digits}f} ± {half:.{digits}f}{spoken_unit}"


def _value(
    c: Candidate, x: np.ndarray, covariance: Float[np.ndarray, "l l"], machine: Machine
) -> Quantity:
    """Return the reported value; its variance to first order, its interval within the bounds."""

    def reported(x: np.ndarray) -> float:
        return float(c.effect.reported(c.full(x), machine, c.site))

    at, gradient = reported(x), _gradient(reported, c, x, 1e-4, 1e-6)
    unit = unit_at(c.effect.unit, c.site, machine)
    found = _quantity(at, float(gradient @ covariance @ gradient), unit)
    if c.size > 1:
        return found
    low, high = sorted((reported(c.low), reported(c.high)))
    return _within(found, low, high)


def _within(quantity: Quantity, low: float, high: float) -> Quantity:
    """Return a quantity whose interval ends where the magnitude was not searched for."""
    first, last = quantity.interval
    return replace(quantity, interval=(max(low, first), min(high, last)))


def _quantity(value: float, variance: float, unit: str, relative: float = _RELATIVE) -> Quantity:
    floor = _TIME if unit == "s" else 0.0
    half = _QUANTILE * float(np.sqrt(max(variance, 0.0) + (relative * value) ** 2 + floor**2))
    return Quantity(float(value), unit, (float(value) - half, float(value) + half))


def _details(
    c: Candidate,
    x: np.ndarray,
    covariance: Float[np.ndarray, "l l"],
    spread: Float[np.ndarray, " s"],
    machine: Machine,
) -> dict[str, Quantity]:
    out: dict[str, Quantity] = {}
    full, variances = c.full(x), np.concatenate([np.diag(covariance), spread**2])
    low, high = _searched(c, machine)
    shown = 0 if c.effect.vector > 1 else 1
    for i in range(shown, len(full)):
        fitted, last = i < c.size, i == len(full) - 1
        optional = not fitted and ((c.bendable and last) or not c.extent.grid)
        if optional and full[i] == c.extent.probe[i]:
            continue  # as it usually is
        component = c.effect.components[i]
        unit = unit_at(component.unit, c.site, machine)
        relative = _RELATIVE_BENT if c.bendable and not fitted else _RELATIVE
        found = _quantity(float(full[i]), float(variances[i]), unit, relative)
        out[component.name] = _within(found, low[i], high[i])
    if c.effect.details is not None:
        derived = c.effect.details(full, machine, c.site)
        for name, (value, unit) in derived.items():
            variance = _propagated(c, x, covariance, machine, name)
            out[name] = _quantity(value, variance, unit)
    return out


def _searched(
    c: Candidate, machine: Machine
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Return where magnitudes and shapes were searched for: shapes also beyond their grid."""
    low, high = np.array(c.extent.low, float), np.array(c.extent.high, float)
    for i, (least, most) in ranges(c, machine).items():
        low[c.size + i] = min(low[c.size + i], least)
        high[c.size + i] = max(high[c.size + i], most)
    return low, high


def _propagated(
    c: Candidate, x: np.ndarray, covariance: np.ndarray, machine: Machine, name: str
) -> float:
    """Return the variance of a derived quantity, to first order."""
    assert c.effect.details is not None  # noqa: S101
    details = c.effect.details
    at = details(c.full(x), machine, c.site)[name]

    def derived(x: np.ndarray) -> float:  # one that is no longer said does not change
        return details(c.full(x), machine, c.site).get(name, at)[0]

    gradient = _gradient(derived, c, x, 1e-3, 1e-3)
    return float(gradient @ covariance @ gradient)


def _gradient(
    of: Callable[[np.ndarray], float], c: Candidate, x: np.ndarray, relative: float, least: float
) -> Float[np.ndarray, " l"]:
    """Return the slope by each magnitude, from steps of a share of it, or of its probe if more."""
    at, gradient = of(x), np.zeros(c.size)
    for i in range(c.size):
        h = max(relative * abs(x[i]), least * abs(c.probe[i]))
        moved = x.copy()
        moved[i] += h
        gradient[i] = (of(moved) - at) / h
    return gradient


def _group_words(label: str | None, candidate: Candidate, fit: Fit) -> str | None:
    if label is None:
        return None
    count = sum(g == label for g in fit.groups)
    return f"{candidate.effect.noun} on {count} {plural(candidate.site.kind)}"
