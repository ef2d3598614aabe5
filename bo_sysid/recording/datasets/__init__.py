"""Public datasets of real machines, each with an adapter from its authors' files."""

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.datasets import emps
from bo_sysid.recording.datasets.registry import DATASETS, Dataset, dataset

__all__ = ["DATASETS", "Dataset", "dataset", "emps", "load_dataset"]


def load_dataset(name: str) -> Dataset:
    """Return a public dataset with its default split.

    Raises:
        RecordingError: there is no such dataset, or its files are not there.
    """
    if name not in DATASETS:
        raise RecordingError(f"unknown dataset {name!r}; {nearest(name, DATASETS)}")
    return DATASETS[name]()
