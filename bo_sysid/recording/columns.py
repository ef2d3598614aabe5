"""Rules that say which column of a file is which channel, and in which unit, sign and clock.

They stand in a study under ``columns:`` and ``clocks:``. A rule is validated when it is made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from math import pi
from typing import Any, Literal, get_args

import numpy as np

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.units import require_scale, unit_of_kind
from bo_sysid.recording.value import KINDS, Hold, kind_of, wrong_name

Missing = Literal["error", "skip"]
_CHOICES = {"hold": get_args(Hold), "missing": get_args(Missing)}
_NUMBERS = ("sign", "scale", "offset", "unwrap", "shift", "signed", "rate")
_BITS = (8, 16, 32)  # bits of integers
_NOT_OF_TIME = {"sign": 1, "missing": "error", "hold": None, "clock": None, "less": None}


@dataclass(frozen=True)
class ColumnRule:
    """How a channel is read from a column.

    The value is sign · unwrap(scale · factor(unit) · signed(raw)) + offset, in SI units; one that
    was unwrapped is moved by whole turns last, so that it begins nearest to zero. Of a joint whose
    column shows another joint's angle as well, as encoders do that count from the base, that angle
    is taken off then.

    Attributes:
        source: name of the column (``from`` in a study); None for the channel's own name.
        unit: unit of the column; None where the file says it or it is SI already.
        sign: 1 or -1.
        scale: factor beside the unit's own; for encoder ticks the SI value of one tick.
        offset: added last, in SI units.
        unwrap: True for an angle that jumps by a turn, or the size of the jump in SI units.
        signed: bits of an unsigned integer that holds a signed one, as registers do: above half of
            its range it is negative; 0 for a number as it stands.
        hold: "zero", "linear" or "none"; None for what the kind of channel says.
        clock: column of the time stamps, in [s] or as the rule of ``time`` reads that column; None
            for what ``clocks:`` or the file says.
        missing: what an empty cell means: "error", or "skip" where the row holds no new sample.
        less: channel whose own column shows what this column shows as well; None for nothing.
        rate: of ``time`` alone, where rows came at a steady rate and no column stamps them: rows
            per second in [Hz]; 0 where one does.

    The rule of ``time`` has no sign, hold, clock, missing or less, and states the size of a jump;
    one with a rate has nothing else.
    """

    source: str | None = None
    unit: str | None = None
    sign: int = 1
    scale: float = 1.0
    offset: float = 0.0
    unwrap: bool | float = False
    signed: int = 0
    hold: Hold | None = None
    clock: str | None = None
    missing: Missing = "error"
    less: str | None = None
    rate: float = 0.0

    def __post_init__(self) -> None:
        _require(self.sign in (1, -1), "sign", self.sign, "1 or -1")
        _require(np.isfinite(self.scale) and self.scale != 0, "scale", self.scale, "finite, not 0")
        _require(bool(np.isfinite(self.offset)), "offset", self.offset, "finite")
        positive = bool(np.isfinite(self.unwrap)) and self.unwrap >= 0
        _require(positive, "unwrap", self.unwrap, "true, or the size of the jump in SI units")
        steady = bool(np.isfinite(self.rate)) and self.rate >= 0
        _require(steady, "rate", self.rate, "positive, in Hz")
        bits = ", ".join(map(str, _BITS))
        _require(self.signed in (0, *_BITS), "signed", self.signed, f"a number of bits: {bits}")

    @classmethod
    def parse(cls, channel: str, rule: "ColumnRule | Mapping[str, Any] | str") -> "ColumnRule":
        """Return the rule of `channel` from what stands in a study; a bare name is the column.

        Raises:
            RecordingError: the channel is not one, a key is unknown or says nothing of it, or a
                value is wrong.
        """
        where = f"columns: {channel}"
        kind = kind_of(channel)
        if channel != "time" and (wrong := wrong_name(channel)):
            raise RecordingError(f"{where}: a channel is called 'time' or <kind>.<name>; {wrong}")
        if not isinstance(rule, ColumnRule):
            arguments = _arguments(where, rule, [f.name for f in fields(cls)])
            try:
                rule = cls(**arguments)
            except RecordingError as error:
                raise RecordingError(f"{where}: {error}") from None
        if channel == "time":
            _require_clock(rule, where)
        elif rule.rate:
            raise RecordingError(
                f"{where}: rate is {rule.rate:g}, but rows have one rate; say it once, as "
                f"columns: {{time: {{rate: {rule.rate:g}}}}}"
            )
        if rule.less is not None and (rule.less == channel or kind_of(rule.less) != kind):
            raise RecordingError(
                f"{where}: less is {rule.less!r}; it must be another channel of the kind {kind}"
            )
        if rule.unit is not None:
            require_scale(unit_of_kind(rule.unit, kind, where), rule.unit, rule.scale, where)
        return rule

    @property
    def period(self) -> float:
        """Size of the jump that unwrapping removes, in SI units; 0 for no unwrapping."""
        return 2 * pi if self.unwrap is True else float(self.unwrap)


@dataclass(frozen=True)
class ClockRule:
    """Where the time stamps of a kind of channel, or of one channel, come from.

    Attributes:
        source: column of the time stamps (``from`` in a study); None for the recording's time.
        unit: unit of that column; None where the file or the rule of ``time`` says it, or it is
            seconds.
        hold: "zero", "linear" or "none"; None for what the kind of channel says.
        shift: added to the stamps, in [s]: how much later than stamped its channels happened.
    """

    source: str | None = None
    unit: str | None = None
    hold: Hold | None = None
    shift: float = 0.0

    def __post_init__(self) -> None:
        _require(bool(np.isfinite(self.shift)), "shift", self.shift, "finite")
        if self.unit is not None:
            unit_of_kind(self.unit, "time", f"clock {self.source!r}")

    @classmethod
    def parse(cls, key: str, rule: "ClockRule | Mapping[str, Any] | str") -> "ClockRule":
        """Return the clock of `key`, a kind or a channel; a bare name is the column.

        Raises:
            RecordingError: the kind is unknown, a key is unknown or a value is wrong.
        """
        where = f"clocks: {key}"
        kind = kind_of(key)
        if kind not in KINDS:
            raise RecordingError(f"{where}: names no kind of channel; {nearest(kind, KINDS)}")
        if isinstance(rule, ClockRule):
            return rule
        arguments = _arguments(where, rule, [f.name for f in fields(cls)])
        try:
            return cls(**arguments)
        except RecordingError as error:
            raise RecordingError(f"{where}: {error}") from None


def _require_clock(rule: ColumnRule, where: str) -> None:
    """Refuse what says nothing of a clock, in a rule for the time stamps."""
    for key, none in _NOT_OF_TIME.items():
        if getattr(rule, key) != none:
            raise RecordingError(
                f"{where}: {key} is {getattr(rule, key)!r}, but time stamps have none; they take "
                "from, unit, scale, offset, unwrap and signed, or rate"
            )
    if rule.rate and rule != ColumnRule(rate=rule.rate):
        raise RecordingError(
            f"{where}: rate is {rule.rate:g}, which is for rows that no column stamps; leave "
            "everything else out, or leave rate out where a column stamps them"
        )
    if rule.unwrap is True:
        raise RecordingError(
            f"{where}: unwrap is true, which is a turn of an angle; for time stamps it must be the "
            "size of the jump in s (4294.967296 for a counter of µs with 32 bits)"
        )


def _arguments(where: str, rule: Mapping[str, Any] | str, names: Sequence[str]) -> dict[str, Any]:
    """Return keyword arguments from a rule in a study, where `source` is called ``from``."""
    given: Mapping[str, Any] = {"from": rule} if isinstance(rule, str) else rule
    keys = ["from" if name == "source" else name for name in names]
    arguments = {}
    for key, value in given.items():
        if key not in keys:
            raise RecordingError(f"{where}: unknown key {key!r}; {nearest(str(key), keys)}")
        if value is not None:
            arguments["source" if key == "from" else key] = _checked(f"{where}: {key}", key, value)
    return arguments


def _checked(where: str, key: str, value: object) -> object:
    """Return the value of a key, numbers as floats, or raise where its type is wrong."""
    if key in _NUMBERS:
        if not isinstance(value, int | float):
            raise RecordingError(f"{where} is {value!r}; it must be a number")
        return value if isinstance(value, bool) or key in ("sign", "signed") else float(value)
    if not isinstance(value, str):
        raise RecordingError(f"{where} is {value!r}; it must be text")
    if value not in _CHOICES.get(key, (value,)):
        raise RecordingError(f"{where} is {value!r}; {nearest(value, _CHOICES[key])}")
    return value


def _require(holds: bool, key: str, value: object, rule: str) -> None:
    if not holds:
        raise RecordingError(f"{key} is {value!r}; it must be {rule}")
