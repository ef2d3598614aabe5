"""Results of long fits, which a diagnosis that was killed finds again.

A fit is stored under a hash of all its inputs, so that a diagnosis that is resumed comes to the
same answer, whatever it was doing when it was killed.
"""

import hashlib
import json
import shutil
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bo_sysid.runs import FITS, Run
from bo_sysid.runs.files import atomic

_STAMP = "made_from.json"
_LONG = 0.3  # [s] fits that take longer are kept

Arrays = Mapping[str, np.ndarray]


class FitCache:
    """Arrays by a hash of what they are made from, in a folder of a run until it is finished.

    Args:
        folder: where they are; None keeps nothing.
        made_from: everything that they depend on beside what `arrays` is given.
    """

    def __init__(self, folder: Path | None = None, made_from: Mapping[str, Any] | None = None):
        self._folder = folder
        self._made_from = dict(made_from or {})

    @classmethod
    def of(cls, run: Run, made_from: Mapping[str, Any]) -> "FitCache":
        """Return what a run kept, which is dropped where it was made from something else."""
        stamp = f"{FITS}/{_STAMP}"
        kept = cls(run.path(FITS), made_from)
        if not run.has(stamp) or run.read_json(stamp) != made_from:
            kept.clear()
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
            except (ValueError, OSError, EOFError, zipfile.BadZipFile):
                path.unlink()  # damaged
        began = time.perf_counter()
        made = make()
        if time.perf_counter() - began > _LONG:
            self._keep(path, made)
        return made

    def clear(self) -> None:
        """Drop everything."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _keep(self, path: Path, made: Arrays) -> None:
        stamp = path.with_name(_STAMP)
        if not stamp.is_file():
            with atomic(stamp) as beside:
                beside.write_text(json.dumps(self._made_from), encoding="utf-8")
        with atomic(path) as beside:
            np.savez(beside, **made)  # type: ignore[arg-type]


NO_CACHE = FitCache()


def digest(inputs: tuple[object, ...]) -> str:
    """Return a hash of numbers, text, arrays, None, and tuples of these."""
    made = hashlib.sha256()
    for value in inputs:
        if isinstance(value, tuple):
            content = digest(value).encode()
        elif isinstance(value, np.ndarray):
            content = np.ascontiguousarray(value).tobytes()
            made.update(f"{value.dtype.str} {value.shape}".encode())
        elif value is None or isinstance(value, bool | int | float | str):
            content = repr(value).encode()
        else:
            raise TypeError(f"{type(value).__name__} has no hash that outlives a process")
        made.update(f"{type(value).__name__} {len(content)}:".encode())
        made.update(content)
    return made.hexdigest()
