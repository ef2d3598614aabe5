"""Elements as MuJoCo has them, whatever the defaults of a model say."""

from copy import copy
from functools import cache
from typing import Any, SupportsInt

import mujoco

_NUMBERED = ("id", "signature")  # by MuJoCo


def add_plain(owner: mujoco.MjSpec | mujoco.MjsBody, kind: str, **values: Any) -> Any:
    """Add an element that takes nothing from the model's `<default>`.

    What is added by name and number means the same in every model: a gear, a range or a stiffness
    that a model gives to all of its own elements would change what it does.

    Args:
        owner: the spec, or for a joint its body; changed in place.
        kind: of the element, such as "actuator".
        values: its attributes; numbers among the others are MuJoCo's own.

    Returns:
        The element.
    """
    element = getattr(owner, f"add_{kind}")()
    for name, value in (*_plain(kind), *values.items()):
        setattr(element, name, value)
    return element


@cache
def _plain(kind: str) -> tuple[tuple[str, Any], ...]:
    """Return the numbers that MuJoCo gives an element, by name; asked for in every fit."""
    empty = mujoco.MjSpec()
    place = empty.worldbody if kind == "joint" else empty
    element = getattr(place, f"add_{kind}")()
    found = ((name, getattr(element, name)) for name in dir(element) if name not in _NUMBERED)
    return tuple((n, copy(value)) for n, value in found if isinstance(value, SupportsInt))
