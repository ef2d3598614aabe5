"""Public datasets by name."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from bo_sysid.recording.value import Recording


@dataclass(frozen=True)
class Dataset:
    """Recordings of a machine that its authors published, with a default split.

    The files of a part are opened when the part is first asked for: what is held out stays
    untouched until then.

    Attributes:
        name: name in a study, ``dataset: <name>``.
        read_train: reads the recordings to identify and diagnose on.
        read_holdout: reads those that are looked at once, after the answer is frozen.
        citation: whom to cite.
        notes: the split, and what was converted.
    """

    name: str
    read_train: Callable[[], tuple[Recording, ...]]
    read_holdout: Callable[[], tuple[Recording, ...]]
    citation: str
    notes: tuple[str, ...] = ()

    @cached_property
    def train(self) -> tuple[Recording, ...]:
        """The recordings to identify and diagnose on."""
        return self.read_train()

    @cached_property
    def holdout(self) -> tuple[Recording, ...]:
        """The recordings that are looked at once, after the answer is frozen."""
        return self.read_holdout()


Loader = Callable[[], Dataset]
DATASETS: dict[str, Loader] = {}
"""Loader by name of the dataset."""


def dataset(name: str) -> Callable[[Loader], Loader]:
    """Register the decorated function as the loader of the dataset `name`."""

    def register(function: Loader) -> Loader:
        DATASETS[name] = function
        return function

    return register
