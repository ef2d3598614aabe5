"""What an identification does not tell, or not surely, in sentences; "" where there is nothing."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from bo_sysid.arrays import Point
from bo_sysid.identify.errors import is_worse
from bo_sysid.identify.problem import FittedStarts
from bo_sysid.parameters import CandidateSet

_LITTLE = 0.5  # share of the range from which an interval says little
_KNOWN = 1e-9  # share of the range: what spreads less has one value, but for rounding
_EXPLAINED = 3.0  # standard deviations of the noise, beyond which recordings are not explained
_LIKELY = 0.5  # P of the best candidate that was tried, from which it is no stopgap
_UNLIKE = 100.0  # ratio of two channels' spreads over noise, above which one hides the other
_TIED = 0.8  # correlation from which two parameters stand for each other
_MOVED = 1.96  # standard deviations, by which values lie outside an interval for sure
_READ = 1e6  # largest number that is written out


def worse(
    errors: pd.DataFrame,
    parameters: pd.DataFrame,
    best: float,
    nominal: float,
    *,
    refined: bool = False,
) -> str:
    """Return that the model as it is fits the training recordings better than every candidate.

    Where it does so in all channels, or lies outside the intervals.

    Args:
        errors: rows of `compared` on the training recordings.
        parameters: columns name, nominal, low95 and high95.
        best: smallest Δ of the candidates.
        nominal: Δ of the model as it is; NaN where it is not known.
        refined: whether the search zoomed in already.
    """
    if not errors.empty and is_worse(errors):
        known = errors[["channel", "unit", "nominal", "identified"]].dropna()
        ratio = known["identified"] / known["nominal"]
        row = known.to_dict(orient="records")[int(ratio.to_numpy().argmax())]
        return (
            "The model as it is fits the training recordings better than every candidate that was "
            f"tried ({row['channel']}: {row['nominal']:.3g} {row['unit']}, and "
            f"{row['identified']:.3g} with the best of them): use none of these values. "
            f"Candidates are too far apart: {_nearer(refined)}."
        )
    if not nominal < best:
        return ""
    own, low, high = (parameters[c].to_numpy(float) for c in ("nominal", "low95", "high95"))
    if ((low <= own) & (own <= high)).all():
        return ""
    columns = zip(parameters["name"], parameters["nominal"], strict=True)
    values = ", ".join(f"{name} {value:.4g}" for name, value in columns)
    return (
        f"The model as it is ({values}) fits the training recordings better than every candidate "
        f"that was tried (deviation {nominal:.4g}, and {best:.4g} with the best of them): "
        f"candidates are too far apart: {_nearer(refined)}."
    )


def _nearer(refined: bool) -> str:
    """Return what brings candidates nearer to each other."""
    zoom = "narrower bounds or a larger search.budget help"
    return zoom if refined else f"`search: {{refine: true}}` zooms in, and {zoom}"


def moved(parameters: pd.DataFrame, other: FittedStarts | None, *, refined: bool = False) -> str:
    """Return which values would fit best outside their intervals, and why.

    Noise of measured starts moves values; of fitted ones candidates are too far apart.

    Args:
        parameters: columns name, unit, low95 and high95.
        other: what would fit best with fitted starts; None where that is not known.
        refined: whether the search zoomed in already.
    """
    if other is None:
        return ""
    slack = _MOVED * other.sigma
    low, high = (parameters[c].to_numpy(float) for c in ("low95", "high95"))
    out = np.flatnonzero(other.outside(low - slack, high + slack))
    each = [
        f"{name} about {other.values[k]:.3g} {unit}".rstrip()
        for k, name, unit in zip(
            out, parameters["name"].iloc[out], parameters["unit"].iloc[out], strict=True
        )
    ]
    if not each:
        return ""
    intervals = "the interval" if len(each) == 1 else "their intervals"
    if not other.measured:
        return (
            f"Between the candidates {' and '.join(each)} would fit best, outside {intervals}: "
            f"candidates are too far apart: {_nearer(refined)} (or the model lacks something)."
        )
    return (
        f"With the start of every window fitted, and not measured, {' and '.join(each)} would fit "
        f"best, outside {intervals}: noise of the measured starts moves values (as does what the "
        f"model lacks). `deviation: {{starts: fitted, horizon: {other.horizon}}}` identifies with "
        "fitted starts."
    )


def unexplained(errors: pd.DataFrame, noise: Mapping[str, float]) -> str:
    """Return what is left of the recordings from fitted starts, where that is far from noise.

    Measured starts make predictions as noisy as they are: their errors are no sign.

    Args:
        errors: rows of `compared` on the training recordings.
        noise: standard deviation of each recorded position's noise, by channel.
    """
    if not noise or errors.empty:
        return ""
    fits = errors[errors["kind"] == "fit"]
    left = {
        str(channel): float(error) / noise[str(channel)]
        for channel, error in zip(fits["channel"], fits["identified"], strict=True)
        if noise.get(str(channel)) and np.isfinite(error)
    }
    worst = max(left, key=left.__getitem__, default="")
    if not worst or not left[worst] > _EXPLAINED:
        return ""
    times = f"{left[worst]:,.0f}" if left[worst] < _READ else f"{left[worst]:.2g}"
    return (
        f"The identified model misses {worst} of the training recordings by {times} standard "
        "deviations of its noise. Nothing that was tried explains them, so do not trust the "
        "intervals: more evaluations or candidates may find what fits, and diagnose what the "
        "model lacks."
    )


def wide(identifiability: pd.DataFrame) -> list[str]:
    """Return of which parameters the recordings say little: see `Identification`."""
    return [
        f"These recordings say little about {name}: its interval takes {share:.0%} of the range "
        "that was searched."
        for name, share in _wide(identifiability).items()
    ]


def cut_short(identifiability: pd.DataFrame) -> list[str]:
    """Return which intervals are wide since the search had no budget to make them narrower."""
    found = _wide(identifiability)
    if not found:
        return []
    each = ", ".join(f"{name} ({share:.0%})" for name, share in found.items())
    return [
        "The search ended before it was sure of the minimum, so that intervals take much of the "
        f"range that was searched: {each}. What the recordings tell of them a larger "
        "search.budget shows, in another run folder, or `search: {refine: true}`, which spends "
        "less on candidates that are far from the best."
    ]


def tied(identifiability: pd.DataFrame) -> list[str]:
    """Return of which pairs of parameters the recordings tell a combination."""
    pairs = {
        frozenset((str(r["name"]), str(r["tied_to"]))): float(r["correlation"])
        for r in identifiability.to_dict(orient="records")
        if abs(float(r["correlation"])) > _TIED
    }
    sentences = []
    for pair, rho in pairs.items():
        one, other = sorted(pair)
        how = "together" if rho > 0 else "against each other"
        sentences.append(
            f"{one} and {other} move {how} over P_boot (ρ = {rho:.2f}): the recordings tell a "
            "combination of the two better than either."
        )
    return sentences


def hidden(
    identifiability: pd.DataFrame, spread: Mapping[str, float], noise: Mapping[str, float]
) -> str:
    """Return which channel counts for little, since its spread is far more of its noise.

    Such as a wheel that turns many times, beside a joint that swings; where intervals are wide.

    Args:
        identifiability: see `Identification`.
        spread: the scale of each channel that is compared in units of its recorded spread.
        noise: as in `unexplained`.
    """
    ratio = {n: s / noise[n] for n, s in spread.items() if noise.get(n)}
    if not _wide(identifiability) or not ratio:
        return ""
    if max(ratio.values()) < _UNLIKE * min(ratio.values()):
        return ""
    least = max(ratio, key=ratio.__getitem__)
    whiten = ", ".join(f"{n}: {noise[n]:.2g}" for n in ratio)
    return (
        f"Channels are compared in units of their recorded spread, in which {least} counts for "
        "little: it varies by far more of its noise than others do. In units of noise, "
        f"`deviation: {{whiten: {{{whiten}}}}}`, it may tell more."
    )


def at_ends(parameters: pd.DataFrame, candidates: CandidateSet) -> str:
    """Return which short intervals end where the search does, of values that are on no bound.

    But for an end at zero: less than no friction is none.
    """
    bounds, count = candidates.bounds, len(parameters)
    free = ~np.asarray(parameters.get("at_bound", np.zeros(count)), bool)
    free[list(candidates.categories)] = False
    low, high = (parameters[c].to_numpy(float) for c in ("low95", "high95"))
    short = high - low <= _LITTLE * np.ptp(bounds, axis=0)
    ends = ((low <= bounds[0]) & (bounds[0] != 0)) | ((high >= bounds[1]) & (bounds[1] != 0))
    names = parameters["name"][free & short & ends].astype(str)
    if not len(names):
        return ""
    verb = "interval ends" if len(names) == 1 else "intervals end"
    return f"{', '.join(names)}: the {verb} where the search does, and the truth may lie beyond."


def outside(parameters: pd.DataFrame, candidates: CandidateSet, best: Point, likely: float) -> str:
    """Return which values lie outside their intervals, where P expects others to be better.

    Args:
        parameters: columns name, low95 and high95.
        candidates: the set B.
        best: `d` values.
        likely: P of the best.
    """
    if likely > _LIKELY:
        return ""
    slack = _KNOWN * np.ptp(candidates.bounds, axis=0)
    low, high = (parameters[c].to_numpy(float) for c in ("low95", "high95"))
    names = parameters["name"][(best < low - slack) | (best > high + slack)].astype(str)
    if not len(names):
        return ""
    return (
        f"{', '.join(names)}: the value, that of the best candidate that was tried, lies outside "
        "the interval, where better ones are expected; a larger search.budget, in another run "
        "folder, tries them."
    )


def _wide(identifiability: pd.DataFrame) -> dict[str, float]:
    """Return the share of the range that each wide interval takes, by parameter."""
    rows = identifiability.to_dict(orient="records")
    return {str(r["name"]): float(r["of_range"]) for r in rows if float(r["of_range"]) > _LITTLE}
