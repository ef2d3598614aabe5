"""Results of long fits, which a diagnosis that was killed finds again.

A fit is known by a hash of all that it is made from, so that one that goes on comes to the same
answer, whatever it was doing when it was killed.
"""

import hashlib
import shutil
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.runs import Run
from bo_sysid.runs.files import atomic

FOLDER = "fits"
_STAMP = "made_from.json"
_LONG = 0.3  # [s] that a fit takes from which on it is kept

Arrays = Mapping[str, np.ndarray]


class Kept:
    """Arrays by a hash of what they are made from, in a folder of a run until it is finished.

    Args:
        folder: where they are; None keeps nothing.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder

    @classmethod
    def of(cls, run: Run, made_from: Mapping[str, Any]) -> "Kept":
        """Return what a run kept, which is dropped where it was made from something else.

        Args:
            run: of a diagnosis.
            made_from: everything that results depend on beside what `arrays` is given.
        """
        stamp = f"{FOLDER}/{_STAMP}"
        kept = cls(run.path(FOLDER))
        if not run.has(stamp) or run.read_json(stamp) != made_from:
            kept.clear()
            run.write_json(stamp, made_from)
        return kept

    def arrays(self, inputs: tuple[object, ...], make: Callable[[], Arrays]) -> Arrays:
        """Return the arrays that were made from these inputs, or make them.

        Args:
            inputs: numbers, text, arrays, and tuples of these.
            make: takes its time.
        """
        if self._folder is None:
            return make()
        path = self._folder / f"{digest(inputs)}.npz"
        if path.is_file():
            try:
                with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
                    return dict(found)
            except (ValueError, OSError, zipfile.BadZipFile):
                path.unlink()  # damaged
        began = time.perf_counter()
        made = make()
        if time.perf_counter() - began > _LONG:
            with atomic(path) as beside:
                np.savez(beside, **made)  # type: ignore[arg-type]
        return made

    def clear(self) -> None:
        """Drop everything."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)


NOTHING_KEPT = Kept()


def digest(inputs: tuple[object, ...]) -> str:
    """Return a hash of numbers, text, arrays, None, and tuples of these."""
    made = hashlib.sha256()
    for value in inputs:
        if isinstance(value, tuple):
            content = digest(value).encode()
        elif isinstance(value, np.ndarray):
            content = np.ascontiguousarray(value).tobytes()
            made.update(f"{value.dtype} {value.shape}".encode())
        elif value is None or isinstance(value, bool | int | float | str):
            content = repr(value).encode()
        else:
            raise TypeError(f"{type(value).__name__} has no hash that outlives a process")
        made.update(f"{type(value).__name__} {len(content)}:".encode())
        made.update(content)
    return made.hexdigest()
