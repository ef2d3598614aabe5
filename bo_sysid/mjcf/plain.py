"""Elements as MuJoCo has them, whatever the defaults of a model say."""

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
    empty = mujoco.MjSpec()
    other = empty if isinstance(owner, mujoco.MjSpec) else empty.worldbody
    element, plain = (getattr(place, f"add_{kind}")() for place in (owner, other))
    for name in dir(plain):
        value = getattr(plain, name)
        if name not in _NUMBERED and isinstance(value, SupportsInt):  # arrays, too
            setattr(element, name, value)
    for name, value in values.items():
        setattr(element, name, value)
    return element
