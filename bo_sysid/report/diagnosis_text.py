"""A diagnosis in words and tables."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from bo_sysid.effects import CATALOGUE
from bo_sysid.report.text import notes_text, table

VERDICTS = {
    "missing-physics": "The model lacks physics.",
    "unknown-physics": "The model lacks physics that no known effect explains.",
    "sensing": "The model is right; what was measured is not what it says.",
    "numerics": "The physics is right; the time step is too coarse.",
    "nothing-missing": "These recordings show nothing that is missing from the model.",
}
_AFTER_FIT = (
    "The model needs what was fitted, parameters of the study or a finer time step; no more is "
    "seen to be missing."
)
_FINER_STEP = "The model needs a finer time step; no more is seen to be missing."
_UNCONFIRMED = (
    "Nothing was found to be missing, but the unseen recording is missed by far more than noise."
)
# times the floor, that forecasts and fits miss the unseen recording by; in contact noise of a start
# grows in the fits of a right model, to 3 to 5 times the sensors'
_MISSED = {"forecast": 3.0, "fit": 20.0}
_EITHER = "Either the model or what was measured is off; these recordings do not tell which."
_HELPED = 1.15  # by how much the forecast gains from what the study fits, before that is a verdict
_SHOWN = 5  # of the other sets
_MODELS = ("nominal", "refitted", "repaired", "learned_residual", "noise_floor")
_MEASURES = {
    "forecast": "forecast from the past alone",
    "fit": "starts fitted inside",
    "free_run": "free run from the past alone",
}


def verdict_text(diagnosis: Mapping[str, Any], summary: Mapping[str, Any] | None = None) -> str:
    """Return the verdict in a sentence.

    Parameters of the study may stand for what is missing: that the model lacks nothing is said of
    the model as it is only where it forecasts about as well without them. Nor is it said where the
    hold-out, which is read after the verdict, contradicts it.

    Args:
        diagnosis: what `diagnosis.json` holds.
        summary: what `summary.json` holds; None where it is missing.
    """
    verdict = str(diagnosis["verdict"])
    holdout = diagnosis.get("holdout") or {}
    forecast = holdout.get("forecast") or {}
    nominal, refitted = (forecast.get(m) or 0.0 for m in ("nominal", "refitted"))
    if verdict == "nothing-missing" and any(_is_missed(holdout, m) for m in _MISSED):
        return _UNCONFIRMED
    if verdict == "nothing-missing" and nominal > _HELPED * refitted:
        return _AFTER_FIT if (summary or {}).get("parameters", True) else _FINER_STEP
    found = diagnosis.get("findings") or ()
    instead = {str(e["effect"]) for f in found for several in f["equivalents"] for e in several}
    measured = {i for i, effect in CATALOGUE.items() if effect.family == "sensing"}
    if verdict == "sensing" and not instead <= measured:
        return _EITHER
    return VERDICTS.get(verdict, verdict)


def _is_missed(holdout: Mapping[str, Any], measure: str) -> bool:
    """Return whether the repaired model is far from the floor by one measure of the hold-out."""
    errors = holdout.get(measure) or {}
    left, floor = (errors.get(m) or 0.0 for m in ("repaired", "noise_floor"))
    return bool(left > _MISSED[measure] * floor > 0.0)


def diagnosis_text(
    diagnosis: Mapping[str, Any],
    summary: Mapping[str, Any] | None,
    sessions: pd.DataFrame | None,
) -> str:
    """Return a diagnosis in words and tables.

    Args:
        diagnosis: what `diagnosis.json` holds.
        summary: what `summary.json` holds: name, sentences, notes, parameters; None where it is
            missing.
        sessions: what `sessions.parquet` holds: magnitudes by recording; None where it is missing.
    """
    summary = summary or {}
    parts = [verdict_text(diagnosis, summary), ""]
    parts += summary.get("sentences") or [f["sentence"] for f in diagnosis["findings"]]
    if diagnosis["findings"]:
        parts += ["", "Found:", table(findings_table(diagnosis["findings"]))]
    errors = errors_table(diagnosis["holdout"])
    if len(errors):
        parts += ["", "Errors on recordings that were never used:", table(errors)]
    if sessions is not None and len(sessions):
        parts += ["", "Recording by recording:", table(sessions)]
    others = alternatives_table(diagnosis["alternatives"])
    if len(others):
        own = diagnosis["verdict"] == "unknown-physics" and not diagnosis["findings"]
        which = "What it may be:" if own else "Other explanations that were tried:"
        parts += ["", which, table(others)]
    proposal = diagnosis["next_experiment"]
    if proposal and (after := _experiment(proposal)) not in parts:  # the sentences may end with it
        parts += ["", f"What to record next: {after}"]
    return "\n".join([*parts, *notes_text(summary.get("notes") or ())])


def findings_table(findings: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return the findings, one row each, with their further components in rows below."""
    rows = []
    for f in findings:
        where = f"{f['kind']} {f['site']}"
        rows.append(
            {
                "effect": f["effect"], "site": where, "change": f["value"],
                "low95": f["interval"][0], "high95": f["interval"][1], "unit": f["unit"],
                "in the model": f["before"], "repaired": f["after"],
                "probability": f["probability"],
            }
        )  # fmt: skip
        rows += [
            {
                "effect": f"  {name}", "site": "", "change": d["value"],
                "low95": d["interval"][0], "high95": d["interval"][1], "unit": d["unit"],
            }
            for name, d in f["details"].items()
            if d["value"] or d["interval"][0] != d["interval"][1]  # else there is none of it
        ]  # fmt: skip
    return pd.DataFrame(rows)


def errors_table(holdout: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return the held-out errors, one row a measure; columns of models that were not judged go.

    A free run of metres and radians has a row for each channel.
    """
    rows = [
        {
            "measure": words, "horizon [s]": float(part["horizon_s"]), "unit": part["unit"],
            **{m.replace("_", " "): part.get(m) for m in _MODELS},
        }
        for key, words in _MEASURES.items()
        if (whole := holdout.get(key))
        for words, part in _by_unit(words, whole)
    ]  # fmt: skip
    return pd.DataFrame(rows).dropna(axis=1, how="all")


def _by_unit(words: str, part: Mapping[str, Any]) -> Sequence[tuple[str, Mapping[str, Any]]]:
    """Return a measure and its errors; those of each channel where they have different units."""
    units, channels = part.get("units") or {}, part.get("channels") or {}
    if len({units[c] for errors in channels.values() for c in errors if c in units}) < 2:
        return [(words, part)]
    found = []
    for channel, unit in units.items():
        errors = {m: e[channel] for m, e in channels.items() if channel in e}
        if errors:
            own = {"horizon_s": part["horizon_s"], "unit": unit, **errors}
            found.append((f"{words}, {channel}", own))
    return found


def alternatives_table(alternatives: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return the most probable of the other sets with their probabilities."""
    return pd.DataFrame(
        [
            {"explanation": set_text(a["findings"]), "probability": round(a["probability"], 4)}
            for a in alternatives[:_SHOWN]
        ]
    )


def set_text(members: Sequence[Mapping[str, Any]]) -> str:
    """Return a set of effects in words: "dry_friction at elbow (0.15), payload at hand (0.3)"."""
    if any(m["effect"] == "unknown" for m in members):
        return "none of these, something unknown"
    members_text = [f"{m['effect']} at {m['site']} ({m['value']:.3g})" for m in members]
    return ", ".join(members_text) or "nothing is missing"


def undecided_sentences(findings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each set that the recordings do not tell from findings.

    A set stands in the place of the findings that list it.
    """
    sentences: dict[str, None] = {}
    for finding in findings:
        for other in finding["equivalents"]:
            own = _without([f for f in findings if other in f["equivalents"]], other)
            theirs = _without(other, findings)
            apart = f"{set_text(own)} from {set_text(theirs)}"
            what = apart if theirs else f"whether there is {set_text(own)}"
            sentences[f"These recordings do not tell {what}."] = None
    return list(sentences)


def _without(
    members: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]]:
    there = {(m["effect"], m["site"]) for m in others}
    return [m for m in members if (m["effect"], m["site"]) not in there]


def _experiment(proposal: Mapping[str, Any]) -> str:
    if "sentence" in proposal:
        return str(proposal["sentence"])
    return ", ".join(f"{key} {value}" for key, value in proposal.items())
