"""Marking one case: the answer against the truth, as plain comparisons of sets.

An answer is a set of (effect, kind, site). It is right where it equals the concealed set. Where it
is not, the classes are looked at: what the answer itself says may stand for a finding. A finding
about the time step is true of every plant here and counts neither for nor against.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from math import hypot
from typing import Any, TypeAlias

import numpy as np

Named: TypeAlias = frozenset[tuple[str, str, str]]

LEAST = 2.0
"""Size in sensor sigma of all that an answer lacks, below which it may lack it."""

CONFIDENT = 0.9
"""Probability from which on a wrong name is a confident wrong name."""

MOST_IN_CLASS = 3
"""Names that a finding may have, its own and its equivalents, where its class counts."""

NOTHING, UNKNOWN = "(nothing)", "(unknown)"
"""What an answer without names calls an effect."""

_NEUTRAL = {"timestep", "unknown"}
_MODELS = ("nominal", "refitted", "repaired", "learned_residual", "noise_floor")


def mark(truth: Mapping[str, Any], answer: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the marks of one case, one value a column.

    Args:
        truth: the sealed answer.
        answer: content of `diagnosis.json`; None where the diagnosis failed.
    """
    concealed = named(truth["effects"])
    known = all(e["known"] for e in truth["effects"])
    size = min((float(e["size"]) for e in truth["effects"]), default=0.0)
    marks: dict[str, Any] = {
        "tier": truth["tier"],
        "machine": truth["machine"],
        "missing": bool(concealed),
        "known": known,
        "concealed": words(concealed),
        "effects": len(concealed),
        "grouped": truth["grouped"],
        "wrong_parameters": bool(truth["parameters"]),
        "size": float(truth["size"]),
        "smallest": size,
        "decade": decade(size) if concealed else "",
        "answered": answer is not None,
    }
    marked: Mapping[str, Any] = answer or {"verdict": "failed", "findings": [], "alternatives": []}
    found = named(marked["findings"])
    marks |= {
        "verdict": marked["verdict"],
        "found": words(found),
        "probability": stated(marked),
        **_set_marks(concealed, found, marked),
        **_unknown_marks(truth, marked),
        **forecast_errors(marked),
    }
    marks["right"] = _right(marks)
    marks["acceptable"] = marks["right"] or _little_missed(truth["effects"], found, marks)
    return marks


def named(entries: Sequence[Mapping[str, Any]]) -> Named:
    """Return effects and sites of findings or of what was concealed."""
    return frozenset(
        (str(e["effect"]), str(e["kind"]), str(e["site"]))
        for e in entries
        if e["effect"] not in _NEUTRAL
    )


def words(names: Named) -> str:
    """Return a set in words, in one order."""
    return ", ".join(f"{effect} at {site}" for effect, _, site in sorted(names))


DECADES = (f"below {LEAST:g}", f"{LEAST:g} to 10", "10 and more")
"""Classes of sizes, in order."""


def decade(size: float) -> str:
    """Return the class of a size."""
    return DECADES[0] if size < LEAST else DECADES[1] if size < 10 else DECADES[2]


def offers(findings: Sequence[Mapping[str, Any]], names: Named) -> bool:
    """Return whether an answer says a set, or that it cannot tell it from what it says.

    An equivalent may stand in the place of the finding that lists it, beside others that are
    exchanged as well or not; where all the findings that it lacks list it, it is the whole answer.
    """
    ways = [[named([f]), *map(named, f.get("equivalents", ()))] for f in findings]
    if all(own[0] <= names or names in own[1:] for own in ways) and any(
        names in own[1:] for own in ways
    ):
        return True
    fitting = [[way for way in own if way <= names] for own in ways]
    return any(frozenset().union(*chosen) == names for chosen in product(*fitting))


def class_size(findings: Sequence[Mapping[str, Any]]) -> int:
    """Return how many names an answer has for the finding with most of them, its own included."""
    whole = named(findings)
    others = (
        {named(other) for other in f.get("equivalents", ())} - {whole, named([f])} for f in findings
    )
    return 1 + max(map(len, others), default=0)


def stated(answer: Mapping[str, Any]) -> float:
    """Return the probability that an answer gives to the set it names, nothing included.

    With it goes that of the sets which it offers as equivalent: one of them counts as right, too.
    """
    own = [float(f["probability"]) for f in answer["findings"] if f.get("probability") is not None]
    if own:
        others = (a for a in answer.get("alternatives", ()) if named(a["findings"]))
        among = (a for a in others if offers(answer["findings"], named(a["findings"])))
        return min(min(own) + sum(float(a["probability"]) for a in among), 1.0)
    return max(0.0, 1.0 - sum(float(a["probability"]) for a in answer.get("alternatives", ())))


def forecast_errors(answer: Mapping[str, Any]) -> dict[str, float]:
    """Return the held-out forecast errors of an answer in sensor sigma, NaN where it has none."""
    errors = (answer.get("holdout") or {}).get("forecast") or {}
    values = {m: errors.get(m) for m in _MODELS}
    return {m: float("nan") if v is None else float(v) for m, v in values.items()}


def _set_marks(concealed: Named, found: Named, answer: Mapping[str, Any]) -> dict[str, Any]:
    others = [a["findings"] for a in answer.get("alternatives", ())]
    strange = [bool(a) and all(f["effect"] == "unknown" for f in a) for a in others]
    alternatives = [
        named(a) for a, none_of_these in zip(others, strange, strict=True) if not none_of_these
    ]
    second = next((a for a in alternatives if a != found), None)
    size = class_size(answer["findings"])
    few = size <= MOST_IN_CLASS
    wrong = [
        f
        for f in answer["findings"]
        if not named([f]) <= concealed and not (few and _offers(f, concealed))
    ]
    in_class = few and offers(answer["findings"], concealed)
    return {
        "top1": found == concealed,
        "top2": concealed in (found, second),
        "class_size": size,
        "in_class": in_class,
        "detected": bool(found) or answer["verdict"] == "unknown-physics",
        "wrong_name": bool(wrong),
        "confident_wrong": any(float(f.get("probability") or 0.0) >= CONFIDENT for f in wrong),
    }


def _offers(finding: Mapping[str, Any], concealed: Named) -> bool:
    """Return whether a finding itself is told as equivalent to what was concealed, or to a part."""
    return any(
        named(other) and named(other) <= concealed for other in finding.get("equivalents", ())
    )


def _unknown_marks(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether the unknown was flagged, located, and its dependence seen."""
    unexplained = answer.get("unexplained") or {}
    flagged = answer["verdict"] == "unknown-physics"
    sites = {str(e["site"]) for e in truth["effects"] if not e["known"]}
    depends = {d for e in truth["effects"] if not e["known"] for d in e["depends_on"]}
    return {
        "flagged": flagged,
        "located": flagged and unexplained.get("site") in sites,
        "dependence": flagged and bool(depends & set(unexplained.get("depends_on", ()))),
    }


def _little_missed(
    effects: Sequence[Mapping[str, Any]], found: Named, marks: Mapping[str, Any]
) -> bool:
    """Return whether an answer has no wrong name and lacks what together is too small to tell."""
    missed = hypot(*(float(e["size"]) for e in effects if not named([e]) <= found))
    names_alone = marks["answered"] and marks["missing"] and not marks["wrong_name"]
    return bool(names_alone and missed < LEAST)


def _right(marks: Mapping[str, Any]) -> bool:
    """Return whether an answer is right as a whole."""
    if not marks["answered"]:
        return False
    if not marks["missing"]:
        return not marks["detected"]
    if not marks["known"]:
        return bool(marks["flagged"]) and not marks["wrong_name"]
    return bool(marks["top1"] or marks["in_class"])


def mark_effects(
    truth: Mapping[str, Any], answer: Mapping[str, Any] | None
) -> list[dict[str, Any]]:
    """Return one row for each effect that was concealed: whether it was found, and how large."""
    findings = [] if answer is None else answer["findings"]
    rows = []
    for e in truth["effects"]:
        hit = next((f for f in findings if named([f]) == named([e])), None)
        row = {
            "tier": truth["tier"],
            "machine": truth["machine"],
            "effect": e["effect"],
            "site": e["site"],
            "known": e["known"],
            "unit": e["unit"],
            "value": float(e["value"]),
            "size": float(e["size"]),
            "decade": decade(float(e["size"])),
            "found": hit is not None,
            "named": _nearest_name(e, findings, answer),
            "estimate": float("nan"),
            "error": float("nan"),
            "covered": False,
        }
        if hit is not None:
            low, high = (float(x) for x in hit["interval"])
            row["estimate"] = float(hit["value"])
            row["error"] = abs(float(hit["value"]) / float(e["value"]) - 1.0)
            row["covered"] = low <= float(e["value"]) <= high
        rows.append(row)
    return rows


def _nearest_name(
    effect: Mapping[str, Any],
    findings: Sequence[Mapping[str, Any]],
    answer: Mapping[str, Any] | None,
) -> str:
    """Return what an answer calls a concealed effect: the finding that is most like it."""
    if answer is None:
        return "(failed)"
    named_findings = [f for f in findings if f["effect"] not in _NEUTRAL]
    flagged = answer["verdict"] == "unknown-physics"
    if not named_findings:
        return UNKNOWN if flagged else NOTHING
    likeness = [
        2 * (f["effect"] == effect["effect"]) + (f["site"] == effect["site"])
        for f in named_findings
    ]
    best = named_findings[int(np.argmax(likeness))]
    if flagged and not effect["known"]:
        return UNKNOWN
    where = "" if best["site"] == effect["site"] else " elsewhere"
    return str(best["effect"]) + where
