"""Public datasets of real machines, each with an adapter from its authors' files."""

from bo_sysid.errors import RecordingError, nearest
from bo_sysid.recording.datasets import (
    bam_xl330,
    contactnets_cube,
    dfki_double_pendulum,
    emps,
    quanser_qube,
)
from bo_sysid.recording.datasets.registry import DATASETS, Dataset, dataset

__all__ = [
    "DATASETS",
    "Dataset",
    "bam_xl330",
    "contactnets_cube",
    "dataset",
    "dfki_double_pendulum",
    "emps",
    "load_dataset",
    "quanser_qube",
]


def load_dataset(name: str) -> Dataset:
    """Return a public dataset with its default split.

    The authors' files are looked up under ``$BO_SYSID_DATA``; where they are not, those that have a
    stable public address are downloaded once and checked.

    Raises:
        RecordingError: there is no such dataset, or its files are neither there nor to be had.
    """
    if name not in DATASETS:
        raise RecordingError(f"unknown dataset {name!r}; {nearest(name, DATASETS)}")
    return DATASETS[name]()
