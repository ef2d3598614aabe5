"""Which columns are controls: goals of servos, and of motors what makes their force."""

from collections.abc import Sequence
from functools import partial

import mujoco
import numpy as np

from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.starter.matching import Guess, match
from bo_sysid.starter.naming import PLACED, WORDS, Column, words
from bo_sysid.starter.numbers import numbered
from bo_sysid.starter.reading import ControlKind, control_kind, driven, stated_unit

_SAME_NAME = 0.8  # confidence in a column that nothing but its name says to be a control
_SAYING: dict[ControlKind, frozenset[str]] = {
    "position": PLACED,
    "velocity": WORDS["velocity"],
    "force": WORDS["effort"] | {"u"},
}
"""Words of what a control sets, unless they are the name of an element."""
_FEEDING, _PLACES, _SPEEDS = (
    ("current", "voltage"), ("angle", "length"), ("angular velocity", "velocity")
)  # fmt: skip
_NEVER: dict[ControlKind, tuple[str, ...]] = {
    "position": (*_FEEDING, "torque", "force", "pressure", *_SPEEDS),
    "velocity": (*_FEEDING, "torque", "force", "pressure", *_PLACES),
    "force": _PLACES,
}
"""What a control is not measured in."""
_FEEDS = frozenset(
    {"current", "currents", "cur", "curr", "amps", "i", "pwm", "duty", "load", "volts", "voltage",
     "voltages", "throttle"}
)  # fmt: skip
"""Words of what feeds a motor: its control where the log has no force."""


def fits_control(compiled: mujoco.MjModel, actuator: str, column: Column) -> bool:
    """Whether a column can be a control: no effort is a servo's goal, no goal a motor's force."""
    what = control_kind(compiled, actuator)
    own = {*words(actuator), *words(driven(compiled, f"ctrl.{actuator}"))}
    kinds = {k for k, known in _SAYING.items() if known & (set(column.words) - own)}
    kinds |= {"force"} if column.kind == "effort" else set()
    if kinds and what not in kinds:
        return False
    return stated_unit(column.unit, column.name).quantity not in _NEVER[what]


def matched_controls(
    model: Model, compiled: mujoco.MjModel, columns: Sequence[Column]
) -> list[Guess]:
    """Match controls: goals for servos, efforts for motors; what is closest comes first."""
    found: list[Guess] = []
    wanted: tuple[ControlKind, ...] = ("position", "velocity", "force")
    for what in wanted:
        names = [n for n in model.controlled if control_kind(compiled, n) == what]
        also = [driven(compiled, f"ctrl.{n}") or n for n in names]
        for matching_kind in (True, False):
            used = {g.column for g in found}
            left = [n for n in names if f"ctrl.{n}" not in {g.channel for g in found}]
            some = [c for c in sorted(columns, key=_feeds) if c.commands and c.name not in used]
            some = [c for c in some if not matching_kind or _is_effort(c) is (what == "force")]
            beside = [also[names.index(n)] for n in left]
            found += match("ctrl", left, some, beside, fits=partial(fits_control, compiled))
    return found


def left_over(
    model: Model, table: RawTable, columns: Sequence[Column], known: Sequence[Guess]
) -> list[Guess]:
    """Match actuators without a column with columns that are left and change.

    By the same name; then one with the only one, several with as many whose names differ by a
    number alone, in its order.
    """
    used, channels = {g.column for g in known}, {g.channel for g in known}
    without = [a for a in model.controlled if f"ctrl.{a}" not in channels]
    never = ("time", "velocity", "foreign")
    left = [c for c in columns if c.name not in used and c.kind not in never]
    left = [c for c in left if np.ptp(table.column(c.name)) > 0]
    compiled = model.compile()
    same = _same_names(compiled, without, left)
    named = {g.channel for g in same}
    without = [a for a in without if f"ctrl.{a}" not in named]
    left = [c for c in left if c.name not in {g.column for g in same}]
    if not without:
        return same
    left = [c for c in left if all(fits_control(compiled, a, c) for a in without)]
    if len(without) == 1:
        reason, chosen = "nothing else is left", left if len(left) == 1 else []
    else:
        reason, chosen = "the order alone", numbered(left, len(without))
    return same + [
        Guess(f"ctrl.{a}", c.name, c.unit, reason, 0.3)
        for a, c in zip(without, chosen, strict=False)  # or there are none
    ]


def _same_names(
    compiled: mujoco.MjModel, actuators: Sequence[str], columns: Sequence[Column]
) -> list[Guess]:
    """Match actuators with the only column that is called like them."""
    found = []
    for a in actuators:
        same_name = [
            c for c in columns if words(c.name) == words(a) and fits_control(compiled, a, c)
        ]
        if len(same_name) == 1:
            (c,) = same_name
            found.append(Guess(f"ctrl.{a}", c.name, c.unit, "the same name", _SAME_NAME))
    return found


def _feeds(column: Column) -> bool:
    """Whether a column is a current, a voltage or the like: a force beside it goes first."""
    quantity = stated_unit(column.unit, column.name).quantity
    return bool(_FEEDS & set(column.words)) or quantity in _FEEDING


def _is_effort(column: Column) -> bool:
    if column.kind == "effort":
        return True
    return bool(WORDS["effort"] & set(column.words)) or column.words[-1:] == ("u",)
