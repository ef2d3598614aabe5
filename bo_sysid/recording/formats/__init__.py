"""File formats of logs: a module a family, whose readers register themselves by file ending."""

from bo_sysid.recording.formats import arrays, parquet, text
from bo_sysid.recording.formats.registry import READERS, Reader, reader

__all__ = ["READERS", "Reader", "arrays", "parquet", "reader", "text"]
