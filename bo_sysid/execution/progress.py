"""How long computations report their progress."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """How far a long computation is.

    Attributes:
        step: units done.
        of: units in all.
        message: what is being done or was found, one short sentence.
        passing: whether the message is from within a unit of work; where lines are printed, it is
            shown only after a long silence.
        share: of the whole work that is done by then, roughly, in 0 to 1, where units differ;
            None where they take equally long.
    """

    step: int
    of: int
    message: str = ""
    passing: bool = False
    share: float | None = None


OnProgress = Callable[[Progress], None]
"""What a long computation calls with its progress; only the command line prints."""


def silent(_: Progress) -> None:
    """Report nothing."""
