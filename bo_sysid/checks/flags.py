"""What a check says about recordings: one frozen value for each thing that deserves a word."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

Level = Literal["wrong", "look", "note"]


@dataclass(frozen=True)
class Flag:
    """Something about the recordings, the model or the study.

    Attributes:
        level: "wrong" where it must be corrected before anything is fitted, "look" where a person
            should decide, "note" where it is good to know.
        kind: what it is about: sign, unit, scale, order, swap, zero, wrap, range, clock, sampling,
            excitation, identifiability, bounds, noise, saturation, frozen, outlier, step, far,
            divergence, contact, balance, load.
        channels: channels, joints or parameters concerned.
        sentence: in words, with the figures that support it.
        evidence: those figures by name.
    """

    level: Level
    kind: str
    channels: tuple[str, ...]
    sentence: str
    evidence: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "evidence", MappingProxyType(dict(self.evidence)))
