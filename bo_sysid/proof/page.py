"""The scores as one self-contained HTML page."""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
import pandas as pd

from bo_sysid.proof.score import Scores
from bo_sysid.proof.statistics import Reliability

_STYLE = """
:root { color-scheme: light dark; --ink: #1c2126; --paper: #fff; --line: #ddd;
  --wrong: #fdecea; --mark: #b3261e; --dot: #1f5fa8; --soft: #888 }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e8ecef; --paper: #14181c; --line: #333c44;
    --wrong: #4a2320; --mark: #ff8a80; --dot: #6cb2ff }
}
body { font: 15px/1.45 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem;
  color: var(--ink); background: var(--paper) }
table { border-collapse: collapse; margin: .6rem 0 1.6rem; font-variant-numeric: tabular-nums }
th, td { padding: .2rem .7rem; border-bottom: 1px solid var(--line); text-align: right }
th.text, td.text { text-align: left; max-width: 26rem }
th:first-child, td:first-child { text-align: left; white-space: nowrap }
tr.wrong td { background: var(--wrong) }
tr.wrong td:first-child { border-left: 4px solid var(--mark) }
.wide { overflow-x: auto }
code { font-size: .85em; overflow-wrap: anywhere }
svg { max-width: 100%; height: auto; fill: currentColor }
@media (max-width: 40rem) {
  .wide td.text:first-child { white-space: normal; min-width: 9rem }
  .facts td:first-child { white-space: normal }
}
@page { size: landscape }
@media print {
  :root { --ink: #000; --paper: #fff; --line: #bbb;
    --wrong: #fdecea; --mark: #b3261e; --dot: #1f5fa8 }
  body { margin: 0; max-width: none; font-size: 8pt }
  .wide { overflow: visible }
  th, td { padding: .15rem .35rem }
  td.text:first-child { white-space: normal }
  h2 { break-after: avoid }
  tr, svg { break-inside: avoid }
}
"""
_DIGITS = 3
_PLOT, _MARGIN = 260, 48  # [px]
_TEXT = {"concealed", "found", "verdict", "machine", "failure", "what", "named"}


def page(scores: Scores, facts: Mapping[str, Any]) -> str:
    """Return the page.

    Args:
        scores: of a run.
        facts: about the run, by name: hashes, versions, times.
    """
    shown = scores.cases[_COLUMNS].reset_index()
    wrong = ~scores.cases["acceptable"].to_numpy(bool)
    calibration = scores.calibration
    parts = [
        "<h1>Proof on concealed data</h1>",
        _facts(facts),
        "<h2>Rates</h2>",
        "<p>Counts with exact 95 % intervals (Clopper and Pearson); the last column is the "
        "one-sided 95 % upper bound.</p>",
        _table(scores.summary.drop(columns="key")),
        "<h2>By tier</h2>", _INTERVALS, _table(scores.by_tier.reset_index()),
        "<h2>By machine</h2>", _table(scores.by_machine.reset_index()),
        "<h2>By size, in sensor sigma</h2>", _table(scores.by_decade.reset_index()),
        "<h2>Where nothing is missing</h2>",
        "<p>Detected is a false alarm; its interval and its upper bound are beside it. Diagnoses "
        "that failed are left out.</p>",
        _table(scores.nothing.reset_index()),
        "<h2>By effect, from 2 sigma</h2>", _table(scores.by_effect.reset_index()),
        "<h2>What concealed effects were called</h2>", _table(scores.confusion.reset_index()),
        "<h2>Magnitudes</h2>", _table(scores.magnitudes.reset_index()),
        "<h2>Held-out forecast errors, medians in sensor sigma</h2>",
        _table(scores.forecasts.reset_index(names="cases")),
        "<h2>Stated probabilities</h2>",
        f"<p>{calibration.cases} cases; calibration error {calibration.error:.3f}, of which "
        f"{calibration.expected:.3f} would be there under perfect calibration. Answers "
        "that rightly call physics unknown and name nothing state none and are left out.</p>",
        _diagram(calibration), _table(calibration.bins.rename(columns=_BINS)),
        "<h2>Cases</h2>", _CASES, _table(shown, wrong),
    ]  # fmt: skip
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Proof on concealed data</title><style>{_STYLE}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


_COLUMNS = [
    "tier", "machine", "concealed", "size", "verdict", "found", "probability", "class_size",
    "right", "acceptable", "nominal", "refitted", "repaired", "learned_residual", "oracle",
    "noise_floor", "seconds", "failure",
]  # fmt: skip
_INTERVALS = (
    "<p>Cases with physics missing. Top 1: the set that was named; right: it or one that the "
    "answer calls equivalent, with its interval; acceptable: right, or cannot tell below 2 sigma; "
    "detected: anything was found or flagged.</p>"
)

_BINS = {
    "low": "stated from", "high": "stated to", "stated": "stated, mean", "right": "share right",
    "lower": "low", "upper": "high",
}  # fmt: skip
_CASES = (
    "<p>Size, and what the models' forecasts of the held-out recording are off by, nominal to "
    "noise floor, are in sensor sigma; seconds are those of the diagnosis. A row with a bar "
    "at its left is not acceptable.</p>"
)


def _facts(facts: Mapping[str, Any]) -> str:
    rows = "".join(
        f'<tr><td>{escape(str(k))}</td><td class="text"><code>{escape(str(v))}</code></td></tr>'
        for k, v in facts.items()
    )
    return f'<div class="wide"><table class="facts">{rows}</table></div>'


def _table(frame: pd.DataFrame, marked: np.ndarray | None = None) -> str:
    """Return a DataFrame as an HTML table, every cell escaped."""
    if frame.empty:
        return "<p>None.</p>"
    kinds = [' class="text"' if str(c) in _TEXT else "" for c in frame.columns]
    head = "".join(
        f'<th scope="col"{kind}>{escape(_title(c))}</th>'
        for c, kind in zip(frame.columns, kinds, strict=True)
    )
    rows = []
    for i, values in enumerate(frame.itertuples(index=False)):
        cells = "".join(
            f"<td{kind}>{escape(_cell(v))}</td>" for kind, v in zip(kinds, values, strict=True)
        )
        kind = ' class="wrong"' if marked is not None and marked[i] else ""
        rows.append(f"<tr{kind}>{cells}</tr>")
    return (
        f'<div class="wide" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _title(column: object) -> str:
    return str(column).replace("_", " ")


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{float(value):.{_DIGITS}g}"
    return str(value)


def _diagram(r: Reliability) -> str:
    """Return the reliability diagram as SVG: stated along, right up, the diagonal is perfect."""
    if r.bins.empty:
        return ""
    marks = []
    for stated, right, lower, upper in r.bins[["stated", "right", "lower", "upper"]].to_numpy():
        x, y, low, high = _along(stated), _up(right), _up(lower), _up(upper)
        marks.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{low:.1f}" y2="{high:.1f}" stroke="var(--soft)"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="var(--dot)"/>'
        )
    ticks = "".join(
        f'<text x="{_along(t):.0f}" y="{_up(0) + 16:.0f}" text-anchor="middle">{t:g}</text>'
        f'<text x="{_along(0) - 6:.0f}" y="{_up(t) + 4:.0f}" text-anchor="end">{t:g}</text>'
        for t in (0, 0.5, 1)
    )
    width, height = _PLOT + 2 * _MARGIN, _PLOT + 2 * _MARGIN
    middle = _MARGIN + _PLOT / 2
    return (
        f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}" role="img" '
        'font-size="12" aria-label="stated probability against share right">'
        f'<rect x="{_MARGIN}" y="{_MARGIN}" width="{_PLOT}" height="{_PLOT}" fill="none" '
        'stroke="var(--soft)"/>'
        f'<line x1="{_along(0)}" y1="{_up(0)}" x2="{_along(1)}" y2="{_up(1)}" '
        'stroke="var(--soft)"/>'
        f'{ticks}<text x="{middle}" y="{height - 6}" text-anchor="middle">stated probability</text>'
        f'<text x="12" y="{middle}" text-anchor="middle" transform="rotate(-90 12 {middle})">'
        f"share right</text>{''.join(marks)}</svg>"
    )


def _along(share: float) -> float:
    return _MARGIN + float(share) * _PLOT


def _up(share: float) -> float:
    return _MARGIN + (1.0 - float(share)) * _PLOT
