"""Scores over the cases of a revealed run; every table is a DataFrame."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from bo_sysid.intervals import upper_bound
from bo_sysid.proof.marks import DECADES, LEAST, NOTHING, UNKNOWN, mark, mark_effects
from bo_sysid.proof.reveal import Revealed
from bo_sysid.proof.statistics import Reliability, clopper_pearson, reliability

FORECAST_GOAL = 1.15
"""Repaired forecast error over the noise floor that counts as repaired."""

RATES: Mapping[str, str] = {
    "names_right": "names and sites right, class counted, from 2 sigma",
    "names_right_tier_2": "the same in tier 2",
    "first_name_right": "names and sites right without a class, from 2 sigma",
    "first_two_right": "right among the first two sets, from 2 sigma",
    "small_acceptable": "cannot tell or right, below 2 sigma",
    "false_alarms": "false alarms where nothing is missing",
    "unknown_flagged": "unknown physics flagged",
    "unknown_located": "unknown physics located",
    "unknown_dependence": "unknown physics with its dependence",
    "confident_wrong": "confident wrong names",
    "known_flagged": "known physics flagged as unknown",
    "intervals_cover": "truth within the 95 % interval",
    "forecast_repaired": f"repaired forecast within {FORECAST_GOAL:g} of the noise floor",
    "failed": "diagnoses that failed",
}
"""The headline rates: the key of each, and what it says in words."""

MODELS = ("nominal", "refitted", "repaired", "learned_residual", "oracle", "noise_floor")
_SCORES = ("top1", "top2", "right", "detected", "acceptable", "confident_wrong")
_NOTHING = ("detected", "flagged", "confident_wrong")


@dataclass(frozen=True)
class Scores:
    """What a run is worth.

    Attributes:
        cases: one row a case: what was concealed, what was found, how it is marked.
        effects: one row for each concealed effect.
        summary: the headline rates, each with its key, what it says in words, its count and its
            95 % interval.
        by_tier: rates of the cases with physics missing, by tier.
        by_machine: the same by machine.
        by_effect: rates by effect, from 2 sigma up.
        by_decade: rates by size.
        nothing: false alarms where nothing is missing, by tier and machine, of the cases that
            were answered.
        confusion: concealed effects (rows) and what they were called (columns), counts; the last
            row is what was found where nothing is concealed.
        magnitudes: error of magnitudes and coverage of intervals, by effect.
        forecasts: medians of the held-out errors of each model, by tier.
        calibration: stated probabilities and how often they were right; an answer that rightly
            says "unknown" and names nothing states none.
    """

    cases: pd.DataFrame
    effects: pd.DataFrame
    summary: pd.DataFrame
    by_tier: pd.DataFrame
    by_machine: pd.DataFrame
    by_effect: pd.DataFrame
    by_decade: pd.DataFrame
    nothing: pd.DataFrame
    confusion: pd.DataFrame
    magnitudes: pd.DataFrame
    forecasts: pd.DataFrame
    calibration: Reliability

    @classmethod
    def of(cls, cases: pd.DataFrame, effects: pd.DataFrame) -> "Scores":
        """Return the scores of some cases, such as those of several runs, from their two tables."""
        missing = cases[cases.missing]
        tellable = effects[effects.known & (effects["size"] >= LEAST)]
        answered = cases[cases.answered]
        stating = answered[answered.known | ~answered.flagged | (answered.found != "")]
        return cls(
            cases,
            effects,
            _summary(cases, effects),
            _rates(missing, "tier", _SCORES),
            _rates(missing, "machine", _SCORES),
            _rates(tellable.rename(columns={"found": "right"}), "effect", ("right",)),
            _in_order(_rates(missing[missing.known], "decade", _SCORES)),
            _rates(answered[~answered.missing], ["tier", "machine"], _NOTHING),
            _confusion(cases, effects),
            _magnitudes(effects),
            forecasts(cases),
            reliability(stating.probability.to_numpy(float), stating["right"].to_numpy(bool)),
        )

    def rate(self, key: str) -> float:
        """Return a rate of the summary by its key in `RATES`; NaN where nothing counts.

        Raises:
            KeyError: there is no such rate.
        """
        return float(self.summary.set_index("key")["rate"].loc[key])


def score(revealed: Sequence[Revealed]) -> Scores:
    """Score a revealed run."""
    cases = pd.DataFrame(
        [
            {
                "case": r.name,
                **mark(r.truth, r.answer),
                "oracle": float("nan"),
                "seconds": r.seconds,
                "failure": r.error,
            }
            for r in revealed
        ]
    ).set_index("case")
    rows = [{"case": r.name, **e} for r in revealed for e in mark_effects(r.truth, r.answer)]
    effects = pd.DataFrame(rows, columns=_EFFECT_COLUMNS).set_index("case").astype(_TYPES)
    return Scores.of(cases, effects)


_EFFECT_COLUMNS = [
    "case", "tier", "machine", "effect", "site", "known", "unit", "value", "size", "decade",
    "found", "named", "estimate", "error", "covered",
]  # fmt: skip


_TYPES = {"known": bool, "found": bool, "covered": bool, "size": float, "error": float}


def _summary(cases: pd.DataFrame, effects: pd.DataFrame) -> pd.DataFrame:
    """Return the rates that the proof is about.

    A diagnosis that failed is never right; where a rate counts errors, it has made none and is left
    out.
    """
    answered = cases[cases.answered]
    missing, nothing = cases[cases.missing], answered[~answered.missing]
    known = missing[missing.known & (missing.smallest >= LEAST)]
    unknown = missing[~missing.known & (missing.smallest >= LEAST)]
    two = known[known.tier == 2]
    found = effects[effects.found]
    ratio = known.repaired / known.noise_floor
    counted = {
        "names_right": known["right"],
        "names_right_tier_2": two["right"],
        "first_name_right": known.top1,
        "first_two_right": known.top2,
        "small_acceptable": missing[missing.smallest < LEAST].acceptable,
        "false_alarms": nothing.detected,
        "unknown_flagged": unknown.flagged,
        "unknown_located": unknown.located,
        "unknown_dependence": unknown.dependence,
        "confident_wrong": answered.confident_wrong,
        "known_flagged": known.flagged[known.answered],
        "intervals_cover": found.covered,
        "forecast_repaired": (ratio <= FORECAST_GOAL)[ratio.notna()],
        "failed": ~cases.answered,
    }
    return pd.DataFrame([_rate(key, counted[key]) for key in RATES])


def _rate(key: str, happened: pd.Series) -> dict[str, object]:
    count, of = int(happened.sum()), len(happened)
    low, high = clopper_pearson(count, of) if of else (float("nan"), float("nan"))
    return {
        "key": key,
        "what": RATES[key],
        "count": count,
        "of": of,
        "rate": count / of if of else float("nan"),
        "low": low,
        "high": high,
        "upper_bound": upper_bound(count, of) if of else float("nan"),
    }


def _rates(cases: pd.DataFrame, by: str | list[str], columns: Sequence[str]) -> pd.DataFrame:
    """Return count and rates of `columns` by the values of one or more columns.

    The interval (low, high) and the one-sided upper bound are those of the rate `right`, or of the
    first column where that is not asked for.
    """
    grouped = cases.groupby(by, sort=True)
    table = grouped.size().rename("n").to_frame()
    for column in columns:
        table[column] = grouped[column].mean()
    counts = grouped["right" if "right" in columns else columns[0]].sum().astype(int)
    pairs = [(int(c), int(n)) for c, n in zip(counts, table.n, strict=True)]
    bounds = [clopper_pearson(*p) for p in pairs]
    table["low"], table["high"] = [b[0] for b in bounds], [b[1] for b in bounds]
    table["upper_bound"] = [upper_bound(*p) for p in pairs]
    return table


def _in_order(by_decade: pd.DataFrame) -> pd.DataFrame:
    return by_decade.reindex([d for d in DECADES if d in by_decade.index])


def _confusion(cases: pd.DataFrame, effects: pd.DataFrame) -> pd.DataFrame:
    """Return what concealed effects, and nothing, were called; one count a name."""
    nothing = cases[~cases.missing]
    called = [
        (NOTHING, name)
        for found, flagged, answered in zip(
            nothing.found, nothing.flagged, nothing.answered, strict=True
        )
        for name in _names(found, flagged, answered)
    ]
    pairs = [*zip(effects.effect, effects.named, strict=True), *called]
    table = pd.DataFrame(pairs, columns=["effect", "named"])
    counts = pd.crosstab(table.effect, table.named)
    return counts.reindex(sorted(counts.index, key=lambda e: (e == NOTHING, e)))


def _names(found: str, flagged: bool, answered: bool) -> list[str]:
    """Return what an answer says of a case that conceals nothing."""
    if not answered:
        return ["(failed)"]
    named = [part.split(" at ")[0] for part in found.split(", ") if part]
    return named or [UNKNOWN if flagged else NOTHING]


def _magnitudes(effects: pd.DataFrame) -> pd.DataFrame:
    found = effects[effects.found & effects.known]
    grouped = found.groupby("effect", sort=True)
    return pd.DataFrame(
        {
            "n": grouped.size(),
            "median error": grouped.error.median(),
            "90 % of errors below": grouped.error.quantile(0.9),
            "interval covers": grouped.covered.mean(),
        }
    )


def forecasts(cases: pd.DataFrame) -> pd.DataFrame:
    """Return medians of the held-out errors, and of the repaired over the noise floor."""
    with_ratio = cases[cases.answered].assign(ratio=lambda c: c.repaired / c.noise_floor)
    columns = [m for m in (*MODELS, "ratio") if m in with_ratio]
    groups: list[tuple[str, Callable[[pd.DataFrame], pd.Series]]] = [
        ("nothing missing", lambda c: ~c.missing),
        ("tier 2", lambda c: c.missing & (c.tier == 2)),
        ("tier 3", lambda c: c.missing & (c.tier == 3)),
        ("tier 4", lambda c: c.missing & (c.tier == 4)),
    ]
    rows = {name: with_ratio[pick(with_ratio)] for name, pick in groups}
    table = pd.DataFrame({name: part[columns].median() for name, part in rows.items()}).T
    table.insert(0, "n", [len(part) for part in rows.values()])
    return table
