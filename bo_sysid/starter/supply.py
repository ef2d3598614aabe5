"""The voltage of a supply, among the columns that no joint and no actuator has."""

from collections.abc import Sequence
from dataclasses import replace

from bo_sysid.recording import RawTable
from bo_sysid.starter.columns import describe
from bo_sysid.starter.guess import Rules
from bo_sysid.starter.matching import Guess

_CALLED = frozenset(
    {"vbus", "vbat", "vbatt", "vcc", "vin", "vsupply", "battery", "supply", "voltage", "volts"}
)
_CHANNEL, _VOLT = "aux.voltage", "V"
_LIKELY = 0.75


def with_supply(tables: Sequence[RawTable], rules: Rules) -> Rules:
    """Return the rules with a supply's voltage, where one column that is left is called so.

    A supply that sags takes torque from the drives (`voltage_sag`), which nothing else tells.
    """
    left = [c for c in describe(tables[0]) if c.name in rules.unused and _CALLED & set(c.words)]
    if len(left) != 1 or _CHANNEL in rules.columns:
        return rules
    (column,) = left
    if not all(column.name in t.columns and (t.column(column.name) > 0).all() for t in tables):
        return rules
    unit = column.unit or _VOLT
    guess = Guess(_CHANNEL, column.name, unit, "the name of a supply", _LIKELY)
    return replace(
        rules,
        columns={**rules.columns, _CHANNEL: {"from": column.name, "unit": unit}},
        guesses={**rules.guesses, _CHANNEL: guess},
        unused=tuple(n for n in rules.unused if n != column.name),
    )
