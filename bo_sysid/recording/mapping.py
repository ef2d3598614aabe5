"""From the columns of a file to the channels of a recording.

Columns that follow the convention (``time``, ``qpos.<joint>``, …) map by themselves; the rules of a
study say the rest. A column ``time.<kind>`` or ``time.<channel>`` is the clock of that kind or
channel. Nothing is guessed, and what was done is said in the recording's notes.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.cleaning import (
    Clock,
    clock_flaws,
    coarse_clock,
    motion_flaws,
    read_clock,
    refuse,
    repeats,
    usable_rows,
)
from bo_sysid.recording.columns import ClockRule, ColumnRule
from bo_sysid.recording.outliers import find_outliers, in_words
from bo_sysid.recording.table import ROWS, RawTable
from bo_sysid.recording.units import UNITS, is_unit, require_scale, unit_of_kind
from bo_sysid.recording.value import (
    HELD_KINDS,
    KINDS,
    UNUSED,
    Channel,
    Hold,
    Recording,
    kind_of,
    stated_for,
    wrong_name,
)

_SEVERAL = 20  # stamps, from which their distance is looked at
_FAST, _SLOW = 5e-5, 0.5  # [s] between which motions are sampled
_DATES = {"M": ("Dates", "seconds since 1970"), "m": ("Durations", "seconds")}


def to_recording(
    table: RawTable,
    columns: Mapping[str, Any] | None = None,
    clocks: Mapping[str, Any] | None = None,
    *,
    name: str = "recording",
    strict: bool = False,
    no_channels: Collection[str] = (),
) -> Recording:
    """Map a raw table to a recording.

    Args:
        table: what a reader returned.
        columns: by channel (or ``time``), a `ColumnRule` or what stands for it in a study.
        clocks: by kind or channel, a `ClockRule` or what stands for it in a study.
        name: name of the recording where the file does not say one.
        strict: refuse what is otherwise used and noted (gaps, jitter, duplicate stamps, outliers,
            …).
        no_channels: columns that are called like channels and are none.

    Raises:
        RecordingError: the message names file, column, row, the rule and the nearest choice.
    """
    rules = {k: ColumnRule.parse(k, r) for k, r in (columns or {}).items()}
    clock_rules = {k: ClockRule.parse(k, r) for k, r in (clocks or {}).items()}
    read = {rule.source for rule in rules.values()}
    for column in table.columns:
        # "qpos.elbow [deg]" that a rule reads is no other channel, which could not be called so
        none = column in no_channels or (column in read and wrong_name(column))
        if kind_of(column) in KINDS and "." in column and not none:
            rules.setdefault(column, ColumnRule())
    name = table.name or name
    if (timed := rules.get("time")) and timed.rate:
        table, rules["time"] = table.counted(timed.rate), ColumnRule(ROWS, "s")
    mapper = _Mapper(table, rules, clock_rules, name)
    shown = {c: mapper.channel(c) for c in rules if c != "time"}
    channels = {c: mapper.own_part(c, shown) for c in shown}
    if all(channel.continuous for channel in channels.values()):
        raise RecordingError(
            f"{table.source}: no column is a measured channel (qpos.<joint>, qvel.<joint>, "
            f"sensor.<name>); it has {', '.join(map(repr, table.columns))}. "
            "Say which is which, for instance columns: {qpos.elbow: {from: theta2, unit: deg}}"
        )
    flaws = [*mapper.flaws(), *motion_flaws(table.source, channels)]
    if strict:
        refuse(table.source, flaws)
    notes = (*table.notes, *mapper.notes, *mapper.summary(channels), *flaws)
    return Recording(name, channels, tuple(dict.fromkeys(notes)))


class _Mapper:
    """Reads channels and clocks from one table and collects what was done."""

    def __init__(
        self,
        table: RawTable,
        rules: Mapping[str, ColumnRule],
        clock_rules: Mapping[str, ClockRule],
        name: str,
    ) -> None:
        self.table = table
        self.name = name
        self.rules = rules
        self.clock_rules = clock_rules
        self.notes: list[str] = []
        self._clocks: dict[ColumnRule, Clock] = {}
        self._dropped: dict[ColumnRule, np.ndarray] = {}
        self._measured: dict[ColumnRule, dict[bytes, np.ndarray]] = {}
        self._outliers: list[str] = []
        self._coarse: list[str] = []
        for key in clock_rules:
            if not any(channel == key or kind_of(channel) == key for channel in rules):
                raise RecordingError(
                    f"{table.source}: clocks: {key!r} fits no channel; {nearest(key, rules)}"
                )

    def channel(self, name: str) -> Channel:
        """Read one channel."""
        table, rule = self.table, self.rules[name]
        column = rule.source or name
        where = f"{table.source}: {name}, column {column!r}"
        raw = table.column(column, name)
        hold = self._hold(name, rule, column)
        stated = self._stated_clock(name, rule, column)
        clock = self._clock(stated)
        skip = rule.missing == "skip"
        rows, notes = usable_rows(raw, clock, where, hold=hold, skip_missing=skip)
        filled = np.flatnonzero(~np.isnan(raw))
        dropped = np.setdiff1d(filled, rows) if skip else clock.duplicates
        self._dropped[stated] = np.union1d(self._dropped[stated], dropped)
        if hold == "none" and not name.rpartition(".")[2].isdecimal():  # of one coordinate
            again = repeats(raw[rows])
            if again.any():
                each = round(len(rows) / np.count_nonzero(~again))
                rows = rows[~again]
                notes.append(
                    f"each value stands in about {each} rows, since its sensor is slower than the "
                    f"log; the {np.count_nonzero(again)} rows that repeat one are left out"
                )
        if hold == "none":
            self._coarse += [] if skip else coarse_clock(raw, clock, rows, name)
            if stated not in self._measured:
                self._require_fast(stated, clock)
            self._measured.setdefault(stated, {})[rows.tobytes()] = rows
        self.notes += [f"{name}: {note}." for note in notes]
        values, si, converted = self._converted(name, rule, column, raw[rows], where)
        position = hold == "none" and kind_of(name) == "qpos"
        if position and (found := find_outliers(clock.stamps[rows], values)):
            text = in_words(found, raw[rows], rows)
            self._outliers.append(f"{self.name}: {name} jumps to {text}; all are used.")
        source = f"{table.source}: {column}"
        return Channel(clock.stamps[rows], values, si, source, hold, converted)

    def own_part(self, name: str, shown: Mapping[str, Channel]) -> Channel:
        """Return a channel without what its column shows of another, which is interpolated."""
        channel, less = shown[name], self.rules[name].less
        if less is None:
            return channel
        if less not in shown:
            raise RecordingError(
                f"{self.table.source}: columns: {name}: less: {less!r} is not in this log; "
                f"{nearest(less, shown)}"
            )
        self.notes.append(f"{name} is what its column shows less {less}.")
        other = np.interp(channel.time, shown[less].time, shown[less].values)
        return replace(channel, values=channel.values - other)

    def flaws(self) -> list[str]:
        """Return sentences about all clocks that were read, and about outliers of positions."""
        clocks = [
            sentence
            for key, clock in self._clocks.items()
            for sentence in clock_flaws(
                clock, self._dropped[key], self._measured.get(key, {}).values()
            )
        ]
        return [*self._coarse[:1], *clocks, *self._outliers]

    def summary(self, channels: Mapping[str, Channel]) -> list[str]:
        """Return sentences about holds and about columns that were not used."""
        sentences = []
        held = [n for n, c in channels.items() if c.hold == "zero"]
        if held:
            sentences.append(f"Held between samples (zero order): {', '.join(held)}.")
        interpolated = [n for n, c in channels.items() if c.hold == "linear"]
        if interpolated:
            sentences.append(f"Interpolated between samples: {', '.join(interpolated)}.")
        used = {rule.source or name for name, rule in self.rules.items()}
        used |= {clock.column for clock in self._clocks.values()}
        unused = [column for column in self.table.columns if column not in used]
        if unused:
            sentences.append(f"{UNUSED}{', '.join(unused)}.")
        return sentences

    def _hold(self, name: str, rule: ColumnRule, column: str) -> Hold:
        clock_rule = self._clock_rule(name)
        stated = rule.hold or (clock_rule.hold if clock_rule else None)
        default: Hold = "zero" if kind_of(name) in HELD_KINDS else "none"
        if stated and (stated == "none") != (default == "none"):
            inputs = ", ".join(sorted(HELD_KINDS))
            why = f"which is for inputs ({inputs}); what is predicted is never held or interpolated"
            if stated == "none":
                why = f"and inputs ({inputs}) act between their samples: zero or linear"
            raise RecordingError(f"{self.table.source}: {name}: hold is {stated!r}, {why}")
        return stated or self.table.holds.get(column, default)

    def _clock_rule(self, name: str) -> ClockRule | None:
        return stated_for(name, self.clock_rules, None)

    def _stated_clock(self, name: str, rule: ColumnRule, column: str) -> ColumnRule:
        """Return the rule for a channel's clock; the most specific statement about it wins."""
        table, clock_rule = self.table, self._clock_rule(name)
        timed = self.rules.get("time", ColumnRule("time"))
        own = next(
            (c for c in (f"time.{name}", f"time.{kind_of(name)}") if c in table.columns),
            table.clocks.get(column),
        )
        if rule.clock is not None:
            stated = ColumnRule(rule.clock)
        elif clock_rule is not None and clock_rule.source is not None:
            named = clock_rule.source
            stated = timed if named == "time" else ColumnRule(named, clock_rule.unit)
        elif own is not None:
            stated = ColumnRule(own)
        else:
            stated = timed
        if stated.source == (timed.source or "time"):  # one column is read in one way
            stated = replace(timed, unit=stated.unit or timed.unit)
        if clock_rule is not None and rule.clock in (None, clock_rule.source or rule.clock):
            stated = replace(stated, unit=clock_rule.unit or stated.unit)
        if clock_rule is not None and clock_rule.shift:
            stated = replace(stated, offset=stated.offset + clock_rule.shift)
            self.notes.append(f"{name}: stamps shifted by {1e3 * clock_rule.shift:g} ms.")
        return stated

    def _clock(self, stated: ColumnRule) -> Clock:
        if stated not in self._clocks:
            self._clocks[stated] = self._read_clock(stated)
            self._dropped[stated] = np.empty(0, int)
        return self._clocks[stated]

    def _read_clock(self, stated: ColumnRule) -> Clock:
        table, column = self.table, stated.source or "time"
        if column not in table.columns:
            raise RecordingError(
                f"{table.source}: no column {column!r} with time stamps "
                f"({nearest(column, table.columns)}). "
                "Say which it is, for instance columns: {time: {from: t, unit: ms}}, or where rows "
                "came at a steady rate without stamps: columns: {time: {rate: 500}}, in Hz"
            )
        where = f"{table.source}: time stamps in column {column!r}"
        named = stated.unit or table.units.get(column) or "s"
        factor = unit_of_kind(named, "time", where).factor or 1.0
        kind = table.columns[column].dtype.kind
        if kind in _DATES:
            what, target = _DATES[kind]
            if factor != 1.0:
                raise RecordingError(
                    f"{where} are {what.lower()}, which are read in s; unit is {named!r}, leave it "
                    "out"
                )
            self.notes.append(f"{what} in column {column!r} converted to {target}.")
        if factor != 1.0:
            self.notes.append(f"Time stamps in column {column!r} converted from {named} to s.")
        raw = table.column(column)
        if stated.signed:
            raw = twos_complement(raw, stated.signed, where)
            self.notes.append(
                f"Time stamps in column {column!r} read as signed numbers of {stated.signed} bits."
            )
        # 70 ms / 1000 is the number that 0.07 s is read as, 0.001 * 70 ms the one beside it
        scaled = stated.scale * raw
        stamps = scaled / round(1 / factor) if factor < 1 else scaled * factor
        if stated.period:
            filled = ~np.isnan(stamps)
            unwrapped = _counted_on(stamps[filled], stated.period)
            jumps = _jumps(stamps[filled], unwrapped, stated.period)
            self.notes.append(
                f"Time stamps in column {column!r} unwrapped ({jumps} jumps of {stated.period:g})."
            )
            stamps[filled] = unwrapped
        return read_clock(column, stamps + stated.offset, where)

    def _require_fast(self, stated: ColumnRule, clock: Clock) -> None:
        """Refuse stamps without a unit that are seconds apart and would be usual in another."""
        if stated.unit or self.table.units.get(clock.column) or len(clock.stamps) < _SEVERAL:
            return
        apart = float(np.nanmedian(np.diff(np.unique(clock.stamps))))  # a stamp may be twice
        units = (u for u in ("ms", "us", "ns") if _FAST < (UNITS[u].factor or 1.0) * apart < _SLOW)
        if apart > _SLOW and (fitting := next(units, None)):
            raise RecordingError(
                f"{self.table.source}: time stamps in column {clock.column!r} are {apart:g} s "
                f"apart, which is no sampling of a motion; are they in {fitting}? "
                f"Say so: columns: {{time: {{from: {clock.column}, unit: {fitting}}}}} (unit: s "
                "where they are seconds)"
            )

    def _converted(
        self, name: str, rule: ColumnRule, column: str, raw: np.ndarray, where: str
    ) -> tuple[np.ndarray, str, str]:
        """Return samples in SI units, that and the former unit, and note what was done."""
        written = rule.unit if rule.unit is not None else self.table.units.get(column, "")
        if written and (rule.unit is not None or is_unit(written)):
            where += "" if rule.unit is not None else ", as the file says"
            found = unit_of_kind(written, kind_of(name), where)
            require_scale(found, written, rule.scale, where)
            si, factor = found.si, found.factor or 1.0
        else:
            si, factor = written, 1.0
        done = []
        if rule.signed:
            raw = twos_complement(raw, rule.signed, where)
            done.append(f"read as a signed number of {rule.signed} bits")
        values = raw if factor * rule.scale == 1.0 else factor * rule.scale * raw
        if factor != 1.0:
            done.append(f"converted from {written} to {si or 'a plain number'}")
        if rule.scale != 1.0:
            done.append(f"scaled by {rule.scale:g}")
        if rule.period:
            finite = values[np.isfinite(values)]
            within = bool(finite.size) and bool(np.ptp(finite) <= rule.period)
            unwrapped = np.unwrap(values, period=rule.period)
            jumps = _jumps(values, unwrapped, rule.period)
            done.append(f"unwrapped ({jumps} jumps of {rule.period:g})")
            values = unwrapped
        if rule.sign < 0:
            values = -values
            done.append("sign reversed")
        if rule.offset:
            values = values + rule.offset
            done.append(f"offset by {rule.offset:g}")
        if rule.period and within:
            if turns := turns_at_start(values, rule.period):
                done.append(f"moved by {-turns:+d} x {rule.period:g}, to begin nearest to zero")
            values = values - turns * rule.period
        if done or column != name:
            self.notes.append(f"{name} is " + ", ".join([f"column {column!r}", *done]) + ".")
        return values, si, written if factor != 1.0 else ""


def _counted_on(stamps: np.ndarray, period: float) -> np.ndarray:
    """Return the stamps of a counter that begins anew after each period: it only goes forward."""
    back = np.diff(stamps, prepend=stamps[:1]) < -period / 2
    return np.asarray(stamps + period * np.cumsum(back))


def twos_complement(values: np.ndarray, bits: int, where: str) -> np.ndarray:
    """Return what unsigned integers mean where they hold signed ones.

    Raises:
        RecordingError: a value is none of a register of so many bits; begins with `where`.
    """
    known = values[np.isfinite(values)]
    wrong = known[(known < 0) | (known >= 2**bits) | (known != np.rint(known))]
    if wrong.size:
        raise RecordingError(
            f"{where}: signed: {bits} is for the raw numbers of a register, from 0 to "
            f"{2**bits - 1}; {wrong[0]:g} is none"
        )
    return np.where(values >= 2 ** (bits - 1), values - 2**bits, values)


def turns_at_start(values: Float[np.ndarray, " n"], period: float) -> int:
    """Return how many whole turns from zero angles begin that were unwrapped.

    Of two logs of one machine, one begins at 1 degree and one at 359.
    """
    begin = next(iter(values[np.isfinite(values)]), 0.0)
    return round(float(begin) / period)


def _jumps(values: np.ndarray, unwrapped: np.ndarray, period: float) -> int:
    return int(np.count_nonzero(np.diff(np.rint((unwrapped - values) / period))))
