"""What is told about the progress of long computations."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """How far a long computation is.

    Attributes:
        step: units done.
        of: units in all.
        message: what is being done or was found, one short sentence.
    """

    step: int
    of: int
    message: str = ""


Report = Callable[[Progress], None]
"""What a long computation calls with its progress; only the command line prints."""


def silent(_: Progress) -> None:
    """Report nothing."""
