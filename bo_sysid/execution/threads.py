"""How many threads computations use."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any

from bo_sysid.errors import StudyError

_threads: int | None = None


def cores() -> int:
    """Return $BO_SYSID_THREADS where it is set, else how many cores this process may use."""
    value = os.environ.get("BO_SYSID_THREADS", "")
    if value:
        if not value.isdecimal() or int(value) < 1:
            raise StudyError(f"$BO_SYSID_THREADS is {value!r}; it must be a whole number from 1")
        return int(value)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def threads() -> int:
    """Return the number of threads that computations use: all cores, unless set otherwise."""
    return _threads or cores()


@contextlib.contextmanager
def use_threads(number: int | None) -> Iterator[None]:
    """Simulate with `number` threads in the block (None: all cores).

    Results do not depend on it. Linear algebra uses one thread: its matrices are small. With two on
    two cores a search took 1.4 to 2.4 times as long, of grids and of 1 000 to 20 000 candidates.

    Raises:
        StudyError: the number is below 1.
    """
    global _threads
    if number is not None and number < 1:
        raise StudyError(f"--threads {number}: at least 1 (this machine offers {cores()})")
    before = _threads
    _threads = number
    try:
        threads()  # the variable is read, and refused where it is wrong, before anything is done
        with limit_threads(1):
            yield
    finally:
        _threads = before


@contextlib.contextmanager
def limit_threads(number: int) -> Iterator[None]:
    """Let BLAS, OpenMP and torch use at most `number` threads in the block.

    BLAS threads that spin while they wait halve the speed of a simulation on all cores: simulate
    under ``limit_threads(1)``.
    """
    from threadpoolctl import threadpool_limits

    torch: Any = sys.modules.get("torch")  # where it has not been imported, nothing is to be done
    before = torch.get_num_threads() if torch else 0
    with threadpool_limits(number):
        if torch:
            torch.set_num_threads(number)
        try:
            yield
        finally:
            if torch:
                torch.set_num_threads(before)
