"""The answer of a diagnosis: frozen and hashed before the hold-out is read."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import pandas as pd

from bo_sysid.diagnosis.answer.exchanges import Entry, Key, exchanges
from bo_sysid.diagnosis.answer.experiment import Experiment
from bo_sysid.diagnosis.answer.explain import Outcome
from bo_sysid.diagnosis.answer.findings import Finding, findings, named
from bo_sysid.diagnosis.answer.unexplained import Unexplained
from bo_sysid.diagnosis.sets.decide import Decision
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.effects import Machine
from bo_sysid.effects.contract import Family
from bo_sysid.runs import digest

Verdict = Literal["unknown-physics", "missing-physics", "sensing", "numerics", "nothing-missing"]

_FEW, _LISTED = 4, 0.005  # other sets that are always told; probability of further ones
_EQUIVALENTS = 3  # told of one name
# Probability that it is something outside the catalogue. No fit tells it; what is said must be as
# often right as it says, and be no confident name (.9) where names were wrong more often than their
# fits say. With both what was stated in concealed cases came true (calibration in BENCHMARKS).
_UNHEARD = 0.02
_STRANGER = {"effect": "unknown", "kind": "world", "site": "world", "value": 0.0}
_BESIDE_NAMES = 0.3  # where something stays unexplained beside names, or names are doubtful
_FROM_AFAR = 0.8  # where names are far from the recordings: three that were, all were wrong
_UNNAMED = 0.9  # where nothing is named and something unexplained: so it was in 29 of 30


@dataclass(frozen=True)
class Answer:
    """What a diagnosis says, from the training recordings alone.

    Attributes:
        verdict: in one word.
        findings: what is missing.
        alternatives: other sets and their probabilities.
        located: sites with the share of the mismatch that they explain.
        unexplained: what no known effect explains.
        next_experiment: what to record next, None where nothing is to be separated.
    """

    verdict: Verdict
    findings: tuple[Finding, ...]
    alternatives: tuple[Mapping[str, Any], ...]
    located: tuple[Mapping[str, Any], ...]
    unexplained: Unexplained
    next_experiment: Experiment | None

    @property
    def none_of_these(self) -> float:
        """Probability that it is something that no set of known effects is."""
        return sum(
            float(a["probability"]) for a in self.alternatives if a["findings"] == [_STRANGER]
        )

    @property
    def hinted(self) -> bool:
        """Whether its names are hints and not yet findings."""
        return bool(self.findings) and self.none_of_these >= _BESIDE_NAMES

    def as_json(self) -> dict[str, Any]:
        """Return the answer as `diagnosis.json` has it, without the hold-out."""
        return {
            "verdict": self.verdict,
            "findings": [f.as_json() for f in self.findings],
            "alternatives": [dict(a) for a in self.alternatives],
            "located": [dict(s) for s in self.located],
            "unexplained": {
                "share": self.unexplained.share,
                "kind": self.unexplained.kind,
                "site": self.unexplained.site,
                "depends_on": list(self.unexplained.depends_on),
            },
            "next_experiment": self.next_experiment and self.next_experiment.as_json(),
            "model": "model_repaired.xml",
            "study": "study_repaired.yaml",
        }

    @property
    def sha256(self) -> str:
        """Hash of the answer as canonical JSON."""
        return digest(self.as_json())

    @property
    def table(self) -> pd.DataFrame:
        """The findings, one row each."""
        rows = [
            {
                "effect": f.effect,
                "kind": f.kind,
                "site": f.site,
                "value": f.quantity.value,
                "low": f.quantity.interval[0],
                "high": f.quantity.interval[1],
                "unit": f.quantity.unit,
                "before": f.before,
                "after": f.after,
                "group": f.group,
                "probability": f.probability,
            }
            for f in self.findings
        ]
        columns = ["effect", "kind", "site", "value", "low", "high", "unit", "before", "after"]
        return pd.DataFrame(rows, columns=[*columns, "group", "probability"])


def make_answer(
    decision: Decision,
    outcome: Outcome,
    machine: Machine,
    experiment: Experiment | None = None,
    *,
    doubtful: bool = False,
    fitted: Machine | None = None,
) -> Answer:
    """Freeze a decision into an answer, with what to record next.

    Where names are doubtful an effect outside the catalogue is as probable as beside something
    that stays unexplained: in contact, where they were wrong more often than their fits say, and
    where `hints` says why. It is likelier than names that leave far more than noise.

    Names that a learned law replaces, or that recordings disagree on, are no findings. Where others
    of their set stay, these have its probability; where none does, it is among the alternatives.
    An answer without names that leaves something unexplained says that it is something unknown:
    "nothing is missing" is then one of the alternatives.

    Args:
        decision: between sets.
        outcome: what is kept of it.
        machine: the nominal model.
        experiment: what to record next.
        doubtful: whether something says that names are less sure than their fits.
        fitted: the machine with the model in which only the study's parameters were fitted, the
            nominal one where left out.
    """
    best, kept = decision.best, outcome.fit
    flagged, unnamed = outcome.unexplained.flagged, not kept.members
    none_of_these = _BESIDE_NAMES if flagged or doubtful else _UNHEARD
    if flagged and kept.rms > ROUGH:
        none_of_these = _FROM_AFAR
    if unnamed and (flagged or best.members):
        none_of_these = _UNNAMED
    posterior = (1.0 - none_of_these) * decision.probability
    answered = {kept.key} if unnamed else {best.key, kept.key}
    if flagged and unnamed:
        answered = set()
    shares = dict(zip((f.key for f in decision.fits), posterior, strict=True))
    probability = float(sum(shares.get(key, 0.0) for key in answered))
    equivalents = _equivalents(decision, kept, machine)
    found = findings(kept, machine, probability, fitted, equivalents)
    alternatives: list[dict[str, Any]] = [
        {"findings": list(named(f, machine)), "probability": float(p)}
        for f, p in zip(decision.fits, posterior, strict=True)
        if f.key not in answered
    ]
    likely = [a for a in alternatives[_FEW:] if a["probability"] >= _LISTED]
    stranger = {"findings": [_STRANGER], "probability": none_of_these}
    alternatives = [*alternatives[:_FEW], *likely, stranger]
    alternatives.sort(key=lambda a: -a["probability"])
    return Answer(
        verdict({c.effect.family for c in kept.members}, outcome.unexplained),
        found,
        tuple(alternatives),
        _located(kept, outcome.unexplained),
        outcome.unexplained,
        experiment,
    )


def _equivalents(
    decision: Decision, kept: Fit, machine: Machine
) -> dict[Key, tuple[tuple[Entry, ...], ...]]:
    """Return what may stand for each name, without the names that a learned law replaced."""
    named_at = frozenset(c.key for c in kept.members)
    out = {c.key for c in decision.best.members} - named_at
    found: dict[frozenset[Key], tuple[Entry, ...]] = {}
    for fit in decision.equivalents:
        rest = tuple(m for m in named(fit, machine) if (m["effect"], m["site"]) not in out)
        key = frozenset((str(m["effect"]), str(m["site"])) for m in rest)
        if rest and key != named_at:
            found.setdefault(key, rest)
    return exchanges(named_at, found, _EQUIVALENTS)


def verdict(families: Collection[Family], unexplained: Unexplained) -> Verdict:
    """Return the verdict: what is missing outweighs what is only measured wrongly."""
    if unexplained.flagged:
        return "unknown-physics"
    if "physics" in families:
        return "missing-physics"
    if "sensing" in families:
        return "sensing"
    return "numerics" if families else "nothing-missing"


def _located(best: Fit, unexplained: Unexplained) -> tuple[Mapping[str, Any], ...]:
    """Return each site with its part of the unique sizes, squared."""
    share = unexplained.share
    total = sum(u**2 for u in best.unique)
    sites: dict[tuple[str, str], float] = {}
    for c, u in zip(best.members, best.unique, strict=True):
        key: tuple[str, str] = (c.site.kind, c.site.name)
        sites[key] = sites.get(key, 0.0) + (1.0 - share) * u**2 / max(total, 1e-300)
    if unexplained.kind is not None and unexplained.site is not None:
        key = (unexplained.kind, unexplained.site)
        sites[key] = sites.get(key, 0.0) + share
    ordered = sorted(sites.items(), key=lambda item: -item[1])
    return tuple({"kind": k, "site": s, "share": float(v)} for (k, s), v in ordered)
