"""One process writes to a run folder at a time."""

import errno
import os
import platform
import sys
import time
from pathlib import Path
from typing import IO

from bo_sysid.errors import RunError

NAME = ".lock"
_BEYOND = 1 << 30  # byte that is locked on Windows, after all that is written
_TRIES, _MOMENT = 10, 0.02  # s
_HELD = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK)  # by another process


def locked(folder: Path) -> IO[str]:
    """Take the lock of a folder; the system lets go of it when this process ends, however."""
    lock = open(folder / NAME, "a+", encoding="utf-8")  # noqa: SIM115 - held as long as the run
    try:
        _lock_soon(lock)
    except OSError as error:
        if error.errno not in _HELD:  # a file system without locks: nothing is known of others
            lock.close()
            raise
        lock.seek(0)
        holder = lock.read().strip() or "another process"
        lock.close()
        raise RunError(
            f"{folder}: {holder} is writing to this run; wait for it, or use another --out"
        ) from None
    lock.truncate(0)
    lock.write(f"process {os.getpid()} on {platform.node()}")
    lock.flush()
    return lock


def _lock_soon(lock: IO[str]) -> None:
    """Lock a file, which `held` of another process may have locked for a moment."""
    for _ in range(_TRIES):
        try:
            return _lock_file(lock)
        except OSError as error:
            if error.errno not in _HELD:
                raise
            time.sleep(_MOMENT)
    _lock_file(lock)


def held(folder: Path) -> bool:
    """Return whether a process writes to a folder, also where that cannot be known."""
    try:
        with open(folder / NAME, "r+", encoding="utf-8") as lock:  # which makes none
            _lock_file(lock)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return False


if sys.platform == "win32":

    def _lock_file(lock: IO[str]) -> None:
        import msvcrt

        lock.seek(_BEYOND)  # beyond the text that names the holder: locked bytes are unreadable
        msvcrt.locking(lock.fileno(), msvcrt.LK_NBLCK, 1)

else:

    def _lock_file(lock: IO[str]) -> None:
        import fcntl

        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
