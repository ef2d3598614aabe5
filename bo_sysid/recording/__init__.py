"""Recordings: the value, readers and writers, clocks, noise, and public datasets by name."""

from bo_sysid.recording.alignment import Sampling, control_steps
from bo_sysid.recording.columns import ClockRule, ColumnRule
from bo_sysid.recording.datasets import DATASETS, Dataset, load_dataset
from bo_sysid.recording.formats import READERS, reader
from bo_sysid.recording.noise import noise_sigma, sensor_noise
from bo_sysid.recording.readers import read_recording, read_recordings, read_table, read_tables
from bo_sysid.recording.table import RawTable
from bo_sysid.recording.value import (
    HELD_KINDS,
    KINDS,
    Channel,
    Hold,
    Recording,
    kind_of,
    stated_for,
)
from bo_sysid.recording.writers import WRITERS, write_recording

__all__ = [
    "DATASETS",
    "HELD_KINDS",
    "KINDS",
    "READERS",
    "WRITERS",
    "Channel",
    "ClockRule",
    "ColumnRule",
    "Dataset",
    "Hold",
    "RawTable",
    "Recording",
    "Sampling",
    "control_steps",
    "kind_of",
    "load_dataset",
    "noise_sigma",
    "read_recording",
    "read_recordings",
    "read_table",
    "read_tables",
    "reader",
    "sensor_noise",
    "stated_for",
    "write_recording",
]
