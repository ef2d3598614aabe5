"""What several readings make of one channel."""

from collections.abc import Sequence

from bo_sysid.effects.parts import Part, Reading


def readings(parts: Sequence[Part]) -> dict[str, Reading]:
    """Return one reading for each channel that is read otherwise, by the channel's name.

    Where there are several of a channel, each reads what the one before it shows:
    (1 + s₂)·[(1 + s₁)·p(t - d₁ - d₂) + o₁] + o₂. What an encoder reads comes first, in the order
    in which a servo takes it: an offset after a scale is of the angle, (1 + s₁)·(p + o₂) + o₁, as
    it shifts a servo's goal. A swap says which quantity p is.
    """
    found: dict[str, Reading] = {}
    for r in sorted((r for r in parts if isinstance(r, Reading)), key=lambda r: not r.encoder):
        first = found.get(r.channel, Reading(r.channel))
        if r.encoder:
            offset = first.offset + (1.0 + first.scale) * r.offset
        else:
            offset = (1.0 + r.scale) * first.offset + r.offset
        found[r.channel] = Reading(
            r.channel,
            scale=(1.0 + r.scale) * (1.0 + first.scale) - 1.0,
            offset=offset,
            delay=first.delay + r.delay,
            source=r.source or first.source,
        )
    return found
