"""Public datasets by name."""

from collections.abc import Callable
from dataclasses import dataclass

from bo_sysid.errors import RecordingError
from bo_sysid.recording.value import Recording


@dataclass(frozen=True)
class Dataset:
    """Recordings of a machine that its authors published.

    Attributes:
        name: name in a study, ``dataset: <name>``.
        train: recordings to identify and diagnose on.
        holdout: recordings that are read once, after the answer is frozen.
        citation: whom to cite.
        notes: the split, and what was converted.
    """

    name: str
    train: tuple[Recording, ...]
    holdout: tuple[Recording, ...]
    citation: str
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.train or not self.holdout:
            raise RecordingError(f"dataset {self.name}: both parts of the split need a recording")


Loader = Callable[[], Dataset]
DATASETS: dict[str, Loader] = {}
"""Loader by name of the dataset."""


def dataset(name: str) -> Callable[[Loader], Loader]:
    """Register the decorated function as the loader of the dataset `name`."""

    def register(function: Loader) -> Loader:
        DATASETS[name] = function
        return function

    return register
