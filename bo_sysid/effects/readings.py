"""What several readings make of one channel."""

from collections.abc import Sequence

from bo_sysid.effects.contract import Part, Reading


def readings(parts: Sequence[Part]) -> dict[str, Reading]:
    """Return one reading for each channel that is read otherwise, by the channel's name.

    Where there are several, each reads what the one before it shows:
    (1 + s₂)·[(1 + s₁)·p(t - d₁ - d₂) + o₁] + o₂. A swap says which quantity p is.
    """
    found: dict[str, Reading] = {}
    for r in parts:
        if isinstance(r, Reading):
            first = found.get(r.channel, Reading(r.channel))
            found[r.channel] = Reading(
                r.channel,
                scale=(1.0 + r.scale) * (1.0 + first.scale) - 1.0,
                offset=(1.0 + r.scale) * first.offset + r.offset,
                delay=first.delay + r.delay,
                source=r.source or first.source,
            )
    return found
