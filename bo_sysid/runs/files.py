"""Files of run folders: each is there as a whole or not at all."""

import contextlib
import hashlib
import json
import math
import os
import uuid
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bo_sysid.errors import RunError

if TYPE_CHECKING:
    import pandas as pd

UNFINISHED = ".tmp-"
"""How the name of a file begins while it is being written."""


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to `path`, and rename it to `path` when the block has succeeded.

    No other writer has it, on this machine or another that shares the folder.

    Raises:
        OSError: the disk is full, or the folder cannot be written to; it names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{UNFINISHED}{uuid.uuid4().hex}-{path.name}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        if error.filename is None or str(error.filename) == str(temporary):
            error.filename = str(path)
        raise
    finally:
        with contextlib.suppress(OSError):  # as it did not get there
            temporary.unlink()


def plain(value: Any, key: str = "value") -> Any:
    """Return `value` with NumPy's types as Python's, for JSON.

    Raises:
        ValueError: a number is NaN or infinite; the message names its key.
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(k): plain(v, f"{key}.{k}") for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v, f"{key}.{i}") for i, v in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{key} is {value}; JSON has no such number")
    return value


def canonical(value: Any) -> bytes:
    """Return JSON of which there is only one: keys sorted, no spaces, ASCII, no NaN.

    Published commitments are hashes of it, see `proof.seal`: what it returns must never change.

    Raises:
        ValueError: a number is NaN or infinite; the message names its key.
    """
    return json.dumps(
        plain(value), sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False
    ).encode()


def digest(value: Any) -> str:
    """Return SHA-256 of canonical JSON, as 64 hexadecimal digits.

    Raises:
        ValueError: a number is NaN or infinite; the message names its key.
    """
    return hashlib.sha256(canonical(value)).hexdigest()


def finite(value: Any) -> Any:
    """Return figures as JSON has them, however deep: a number that is NaN or infinite is None."""
    if isinstance(value, Mapping):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(folder: str | Path, name: str) -> Any:
    """Read a JSON file of a run folder.

    Raises:
        RunError: it is missing or damaged.
    """
    path = written(Path(folder), name)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RunError(f"{path}: damaged, not JSON ({error})") from None


def read_frame(folder: str | Path, name: str, columns: Collection[str] = ()) -> "pd.DataFrame":
    """Read a Parquet file of a run folder, which must have some columns.

    Raises:
        RunError: it is missing or damaged.
    """
    import pandas as pd

    path = written(Path(folder), name)
    try:
        frame = pd.read_parquet(path)
    except (ValueError, OSError) as error:
        raise RunError(f"{path}: damaged, not Parquet ({error})") from None
    missing = [c for c in columns if c not in frame]
    if missing:
        raise RunError(f"{path}: damaged, without {', '.join(map(repr, missing))}")
    return frame


def inside(folder: Path, name: str) -> Path:
    """Return where a file of a run folder is.

    Raises:
        RunError: `name` leads out of the folder.
    """
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise RunError(f"{name!r} leads out of the run folder {folder}")
    return path


def written(folder: Path, name: str) -> Path:
    """Return where a file of a run folder is, which must be there.

    Raises:
        RunError: it is missing.
    """
    path = inside(folder, name)
    if not path.is_file():
        raise RunError(f"{path}: missing; the run is unfinished or damaged")
    return path


def _sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk, where the system can."""
    with contextlib.suppress(OSError):
        fd = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)
