"""A study as text, with a comment behind everything that was guessed."""

import json
from collections.abc import Mapping, Sequence
from math import ceil, floor, log10
from pathlib import Path

import pandas as pd

from bo_sysid.checks.proposal import flow
from bo_sysid.effects.units import at_slide
from bo_sysid.recording.table import FILL_IN
from bo_sysid.starter.guess import Rules

_WORDS = ((0.85, "sure"), (0.55, "likely"), (0.0, "GUESS, look at it"))
_FEW = 8  # columns that are named beside a channel
_SHARED = "no column is left; two motors on one command name one column"
_NOTHING_KNOWN = (
    "# Bounds of parameters and limits follow from the motion. Once the columns are stated, and",
    "# `bo-sysid check` agrees, add what is not known, for instance:",
    '# parameters: [{address: "joint[elbow].damping", low: 0, high: 1}]',
)


def study_text(
    name: str,
    model: str,
    train: Sequence[str],
    holdout: Sequence[str],
    rules: Rules,
    scales: pd.DataFrame,
    hints: Mapping[str, str],
    *,
    base_fixed: bool,
    notes: Sequence[str],
) -> str:
    """Return the YAML of a first study.

    Args:
        name: of the study.
        model: path of the model, relative to the study.
        train: paths of the logs to fit to.
        holdout: paths of the logs to judge by.
        rules: how the logs are read.
        scales: one row a joint: joint, slides (or turns), mute (why it gets no parameters, else
            empty), friction, damping, armature (upper bounds worth trying), low, high and speed
            recorded; empty where no joint was found in the logs.
        hints: by channel, what is to be known of it, on a line before it.
        base_fixed: whether a floating base is held.
        notes: what else is to be said at the top.
    """
    held = list(rules.held)
    source: dict[str, object] = {"file": model}
    source |= {"base": "fixed"} if base_fixed else {}
    source |= {"hold": held} if held else {}
    source |= {"unrecorded": dict.fromkeys(rules.following)} if rules.following else {}
    lines = [
        f"# {_one_line(name)}: a first study, written by `bo-sysid init`. Read the comments behind "
        "each line:",
        "# what is marked GUESS rests on little. Then: bo-sysid check",
        *(f"# {_one_line(n)}" for n in notes),
        "version: 1",
        f"name: {flow_text(name)}",
        f"model: {flow_text(model) if len(source) == 1 else flow(source)}" + _held(rules),
        "recordings:",
        f"  train: [{', '.join(map(flow_text, train))}]",
    ]
    if holdout:
        lines.append(
            f"  holdout: [{', '.join(map(flow_text, holdout))}]  # the last logs; never fitted to"
        )
    else:
        lines.append("  # no holdout: the last quarter of the log, by time, is set aside")
    lines += _block("columns", rules.columns, rules, hints) + _open(rules)
    if rules.unused:
        lines.append(f"    # columns not used: {_one_line(', '.join(rules.unused))}")
    lines += _block("clocks", rules.clocks, rules, {})
    if scales.empty:
        lines += ["", *_NOTHING_KNOWN]
    else:
        lines += ["", *_parameters(scales), "", *_deviation(scales), "", *_limits(scales)]
    return "\n".join(lines) + "\n"


def _open(rules: Rules) -> list[str]:
    """Return the channels that the user has to say, with the columns that are left."""
    left = "one of those below"
    if len(rules.unused) <= _FEW:
        left = f"one of: {_one_line(', '.join(rules.unused))}" if rules.unused else _SHARED
    lines = [] if rules.columns or not rules.to_fill_in else ["  columns:"]
    lines += [
        f"    {flow_text(c)}: {{from: {FILL_IN}}}  # not found; {left}" for c in rules.to_fill_in
    ]
    held = rules.of_held if rules.unused else ()
    return lines + [f"    # {_one_line(c)}: {{from: {FILL_IN}}}  # or held; {left}" for c in held]


def _held(rules: Rules) -> str:
    """Return what becomes of joints that were not recorded, as a comment."""
    held, following = (_one_line(", ".join(n)) for n in (rules.held, rules.following))
    notes = [f"held where the model puts them: {held}"] if held else []
    notes += (
        [f"left to move, since the model ties them to others: {following}"] if following else []
    )
    return f"  # not recorded, so {'; '.join(notes)}" if notes else ""


def flow_text(text: str) -> str:
    """Return a string as YAML writes it inside a line."""
    return flow({"x": text})[4:-1]


def _block(title: str, block: object, rules: Rules, hints: Mapping[str, str]) -> list[str]:
    if not isinstance(block, dict) or not block:
        return []
    lines = [f"  {title}:"]
    for channel, rule in block.items():
        key = f"clocks.{channel}" if title == "clocks" else channel
        if channel in hints:
            lines.append(f"    # {_one_line(hints[channel])}")
        lines.append(f"    {flow_text(channel)}: {flow(rule)}{_comment(key, rules)}")
    return lines


def _comment(key: str, rules: Rules) -> str:
    guess = rules.guesses.get(key)
    if guess is None:
        return ""
    word = next(w for least, w in _WORDS if guess.confidence >= least)
    return f"  # {word}: {_one_line(guess.reason)}"


def _one_line(text: str) -> str:
    """Return what stands in a comment: names of columns and joints may have more lines."""
    return " ".join(text.split())


def _parameters(scales: pd.DataFrame) -> list[str]:
    lines = [
        "# What models lack most often; the upper bounds follow from the forces in the log.",
        '# Add masses that you are not sure of: {address: "body[forearm].mass", apply: scale, …}',
        "# `diagnose` fits what stands here and names none of it: remove what it is to look for.",
        "parameters:" if scales["mute"].eq("").any() else "parameters: []",
    ]
    for row in scales.itertuples():
        if row.mute:
            lines.append(f"  # {_one_line(f'{row.joint!s} {row.mute!s}')}")
            continue
        for what, high, unit in (
            ("frictionloss", row.friction, "N m"), ("damping", row.damping, "N m s/rad"),
            ("armature", row.armature, "kg m²"),
        ):  # fmt: skip
            address = json.dumps(f"joint[{row.joint}].{what}", ensure_ascii=False)
            unit_text = at_slide(unit) if row.slides else unit
            lines.append(f"  - {{address: {address}, low: 0, high: {high:.2g}, unit: {unit_text}}}")
    return lines


def _deviation(scales: pd.DataFrame) -> list[str]:
    horizon = int(scales["horizon"].iloc[0])
    return [
        f"deviation: {{horizon: {horizon}, starts: fitted}}  # windows of about 0.3 s",
        "search: {candidates: {sobol: 10000}, budget: 100, refine: true}",
    ]


def _limits(scales: pd.DataFrame) -> list[str]:
    lines = [
        "# For `excite` and policies, before anything moves the machine: what was recorded, not",
        "# what the machine bears. Correct it, then remove the marks.",
        "# limits:",
    ]
    for row in scales.to_dict("records"):
        low, high = _outwards(row["low"], row["high"])
        lines.append(
            f"#   {_one_line(row['joint'])}: {{position: [{low}, {high}], "
            f"velocity: {row['speed']:.2g}}}"
        )
    return lines


def _outwards(low: float, high: float) -> tuple[str, str]:
    """Return the ends of a range, to about three digits of its width, and not within it."""
    places = 2 - floor(log10(max(high - low, 1e-4)))
    step = 10.0**-places
    ends = floor(low / step) * step, ceil(high / step) * step
    return f"{ends[0]:.{max(places, 0)}f}", f"{ends[1]:.{max(places, 0)}f}"


def relative(path: Path, folder: Path) -> str:
    """Return a path as a study in `folder` names it."""
    import os

    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
