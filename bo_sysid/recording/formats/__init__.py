"""File formats of logs: a module a family, whose readers register themselves by file ending."""

from bo_sysid.recording.formats import arrays, bags, hdf5, lerobot, parquet, records, text
from bo_sysid.recording.formats.registry import FOLDERS, READERS, Reader, log_folder, reader

__all__ = [
    "FOLDERS",
    "READERS",
    "Reader",
    "arrays",
    "bags",
    "hdf5",
    "lerobot",
    "log_folder",
    "parquet",
    "reader",
    "records",
    "text",
]
