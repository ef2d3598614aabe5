"""Recordings: the value, readers and writers, clocks, noise, and public datasets by name."""

from bo_sysid.recording.alignment import Sampling, control_steps, sampling
from bo_sysid.recording.columns import ClockRule, ColumnRule
from bo_sysid.recording.datasets import DATASETS, Dataset, load_dataset
from bo_sysid.recording.readers import READERS, read_recording, read_table, reader
from bo_sysid.recording.table import RawTable
from bo_sysid.recording.value import HELD_KINDS, KINDS, Channel, Hold, Recording

__all__ = [
    "DATASETS",
    "HELD_KINDS",
    "KINDS",
    "READERS",
    "Channel",
    "ClockRule",
    "ColumnRule",
    "Dataset",
    "Hold",
    "RawTable",
    "Recording",
    "Sampling",
    "control_steps",
    "load_dataset",
    "read_recording",
    "read_table",
    "reader",
    "sampling",
]
