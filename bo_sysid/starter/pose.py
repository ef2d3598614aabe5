"""Which columns are the pose of a floating base: three of a position, four of a quaternion."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.mjcf.joints import FREE
from bo_sysid.recording import RawTable
from bo_sysid.starter.matching import Guess
from bo_sysid.starter.naming import WORDS, named_unit, words

_LETTER = re.compile(r"(?P<stem>.*?)[\s_.\-]?(?P<letter>[wxyz])", re.IGNORECASE)
_LENGTH = re.compile(r"(?P<plain>.*)[\s_.\-](?P<unit>mm|cm|m)", re.IGNORECASE)
_UNIT = 0.02  # by which the length of a quaternion may differ from 1
_CONFIDENCE = 0.7
_REASON = "the names, and a quaternion's length of 1; it must be in the model's world frame"


def pose_guesses(model: mujoco.MjModel, table: RawTable) -> list[Guess]:
    """Return the columns of the pose of the only free joint of a model, none where that is open.

    Columns that are called after one stem and end in x, y, z or in w, x, y, z (qw, quat_x, …), a
    unit behind it left aside (mocap_x_mm).
    """
    free = np.flatnonzero(model.jnt_type == FREE)
    stems = _stems(table)
    turns = [own for own in stems.values() if set(own) == set("wxyz") and _unit(table, own)]
    places = [own for own in stems.values() if set(own) == set("xyz")]
    if len(free) != 1 or len(turns) != 1 or not places:
        return []
    joint, (turned,) = model.joint(int(free[0])).name, turns
    place = _placed(places, turned)
    if place is None:
        return []
    units = {place[k]: _plain(place[k])[1] for k in "xyz"} | {turned[k]: "" for k in "wxyz"}
    return [
        Guess(f"qpos.{joint}.{i}", column, unit, _REASON, _CONFIDENCE)
        for i, (column, unit) in enumerate(units.items())
    ]


def pose_rule(table: RawTable, guess: Guess) -> dict[str, Any]:
    """Return the rule of a guess; a unit that the file states is read as it is."""
    unit = "" if table.units.get(guess.column) else guess.unit
    return {"from": guess.column, **({"unit": unit} if unit not in ("", "m") else {})}


def _placed(
    places: Sequence[Mapping[str, str]], turned: Mapping[str, str]
) -> Mapping[str, str] | None:
    """Return the position of a quaternion: one x, y and z that there is, or that is called so.

    A gyro or an accelerometer has an x, a y and a z as well.
    """
    (stem, *_), position_words = words(turned["x"]), WORDS["position"]
    called: list[Callable[[tuple[str, ...]], bool]] = [
        lambda name: True,
        lambda name: name[0] == stem,
        lambda name: bool(position_words & set(name[:-1])),
        lambda name: name == ("x",),
    ]
    for so in called:
        found = [p for p in places if so(words(p["x"]))]
        if len(found) == 1:
            return found[0]
    return None


def _stems(table: RawTable) -> dict[str, dict[str, str]]:
    """Return by stem the columns by the letter that they end in."""
    found: dict[str, dict[str, str]] = {}
    for name in table.columns:
        if match := _LETTER.fullmatch(_plain(name)[0]):
            found.setdefault(match["stem"].lower(), {})[match["letter"].lower()] = name
    return found


def _plain(name: str) -> tuple[str, str]:
    """Return a name without the unit that it carries, and that unit; empty if none."""
    plain, unit = named_unit(name)
    length = _LENGTH.fullmatch(plain)
    if not unit and length:
        plain, unit = length["plain"], length["unit"].lower()
    return plain.rstrip(" _.-"), unit


def _unit(table: RawTable, columns: dict[str, str]) -> bool:
    """Whether four columns make quaternions."""
    try:
        length = np.sqrt(sum(table.column(name) ** 2 for name in columns.values()))
    except RecordingError:
        return False
    return bool(np.nanmax(np.abs(length - 1.0)) < _UNIT)
