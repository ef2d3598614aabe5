"""Run folders: everything that a command produced, written atomically, resumable.

A file is either there as a whole or not at all: it is written beside its place, flushed to the
disk, and moved there. A command that is killed at any moment goes on from what is there.
"""

from bo_sysid.runs.files import atomic, canonical, digest, finite, plain, read_frame, read_json
from bo_sysid.runs.lock import held
from bo_sysid.runs.packages import versions
from bo_sysid.runs.record import FORMAT, read_record
from bo_sysid.runs.run import FITS, Run

__all__ = [
    "FITS",
    "FORMAT",
    "Run",
    "atomic",
    "canonical",
    "digest",
    "finite",
    "held",
    "plain",
    "read_frame",
    "read_json",
    "read_record",
    "versions",
]
