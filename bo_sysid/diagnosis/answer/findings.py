"""Findings: an effect at a site each, with its numbers and its words."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from bo_sysid.diagnosis.answer.exchanges import Entry, Key
from bo_sysid.diagnosis.answer.quantities import details_of, quantities
from bo_sysid.diagnosis.answer.wording import after_change, plural, sentence
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.candidate import Candidate, slices_of
from bo_sysid.effects import Machine
from bo_sysid.intervals import Quantity


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
        value = quantity.value
        after = value if candidate.effect.absolute else after_change(begun, value)
        details = details_of(candidate, x, fit.covariance[own, own], spread, fitted)
        found.append(
            Finding(
                candidate.effect.id,
                candidate.site.kind,
                candidate.site.name,
                quantity,
                before,
                after,
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


def _group_words(label: str | None, candidate: Candidate, fit: Fit) -> str | None:
    if label is None:
        return None
    count = sum(g == label for g in fit.groups)
    return f"{candidate.effect.noun} on {count} {plural(candidate.site.kind)}"
