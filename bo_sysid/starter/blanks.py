"""Columns with empty cells, as of logs that were merged from several rates."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bo_sysid.checks.proposal import Rule
from bo_sysid.recording import RawTable
from bo_sysid.recording.table import ROWS
from bo_sysid.recording.value import KINDS, kind_of
from bo_sysid.starter.guess import Rules
from bo_sysid.starter.matching import Guess


def skipping(rules: Rules, tables: Sequence[RawTable]) -> Rules:
    """Return the rules with `missing: skip` for channels whose columns have empty cells.

    Raises:
        RecordingError: a cell is not a number.
    """
    named = [c for c in tables[0].columns if "." in c and kind_of(c) in KINDS]
    columns, guesses = dict(rules.columns), dict(rules.guesses)
    for channel in dict.fromkeys([*columns, *named]):
        if channel == "time":
            continue
        rule = columns.get(channel, {})
        empty, cells = _empty(channel, rule, rules, tables)
        if not empty:
            continue
        columns[channel] = rule | {"missing": "skip"}
        guess = guesses.get(channel, Guess(channel, channel, "", "the name", 1.0))
        reason = f"{guess.reason}; {empty} of {cells} cells are empty, and no new samples"
        guesses[channel] = replace(guess, reason=reason)
    return replace(rules, columns=columns, guesses=guesses)


def _empty(channel: str, rule: Rule, rules: Rules, tables: Sequence[RawTable]) -> tuple[int, int]:
    """Return how many cells with a time stamp are empty, and how many there are."""
    empty = cells = 0
    for table in tables:
        column = rule.get("from", channel)
        values, stamps = table.column(column, channel), _stamps(table, channel, column, rules)
        finite = np.isfinite(stamps[: len(values)])
        empty += int(np.isnan(values[: len(finite)][finite]).sum())
        cells += int(finite.sum())
    return empty, cells


def _stamps(table: RawTable, channel: str, column: str, rules: Rules) -> np.ndarray:
    """Return the time stamps of a channel, none where no column has them."""
    own = (f"time.{channel}", f"time.{channel.split('.', 1)[0]}", table.clocks.get(column))
    timed = rules.columns.get("time", {})
    clocks = (*own, timed.get("from", ROWS if "rate" in timed else "time"))
    found = next((c for c in clocks if c in table.columns), None)
    return np.empty(0) if found is None else table.column(found)
