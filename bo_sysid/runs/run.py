"""A run folder, which a killed command goes on with."""

import contextlib
import json
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Literal

from bo_sysid.errors import RunError, UserError, is_interrupt
from bo_sysid.runs.files import (
    UNFINISHED,
    atomic,
    digest,
    inside,
    plain,
    read_frame,
    read_json,
)
from bo_sysid.runs.lock import NAME as LOCK
from bo_sysid.runs.lock import locked
from bo_sysid.runs.packages import PACKAGES, versions
from bo_sysid.runs.record import FORMAT, RECORD, STUDY, existing
from bo_sysid.yaml_text import dumped

if TYPE_CHECKING:
    import pandas as pd

FITS = "fits"
"""Folder of a run with the fits that an unfinished diagnosis goes on with, as `*.npz`."""

Status = Literal["running", "finished", "interrupted", "failed"]

_MADE_OF = ("inputs.json", "problems.json", "recorded.json")
"""What `learn`, `compare` and `record` write of their files before they compute anything."""


class Run:
    """A run folder that this process writes to.

    Use it as a context manager: leaving it writes the status (finished, interrupted or failed) and
    lets go of the folder.
    """

    def __init__(self, folder: Path, record: dict[str, Any], lock: IO[str], *, created: bool):
        self.folder = folder
        self.ended = _when_finished(record)
        """When a finished run of the folder ended; empty where the last one did not finish."""
        self._record = record
        self._lock = lock
        self._created = created
        self._untouched = False  # whether it is a finished run to which nothing was written since

    @classmethod
    def open(
        cls,
        folder: str | Path,
        study: Mapping[str, Any],
        command: str,
        *,
        seed: int | None = None,
        arguments: Sequence[str] = (),
        raised: Sequence[str] = (),
    ) -> "Run":
        """Make a run folder, or go on with one of the same study and command.

        Args:
            folder: the run folder; made where it does not exist.
            study: the resolved study, with paths relative to `folder`.
            command: the verb.
            seed: seed of everything drawn at random.
            arguments: of the command line, for who wants to run it again; empty in Python.
            raised: keys of the study, with dots, that say how much is computed; one that is larger
                than in the folder makes its run go on, even where it was finished.

        Raises:
            RunError: another process writes to the folder, or the folder holds another study or
                command, another format, or something that is no run.
        """
        folder = Path(folder)
        if folder.is_file():
            raise RunError(f"{folder}: a file; --out names the folder of a run")
        created = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        lock = locked(folder)
        try:
            text = dumped(study)
            record = existing(folder, study, text, command, raised)
            _remove_leftovers(folder)
            run = cls(folder, record or _new_record(study, command, seed), lock, created=created)
            run._begin(text, arguments)
        except BaseException:
            lock.close()
            raise
        return run

    def _begin(self, study: str, arguments: Sequence[str]) -> None:
        """Write that the command runs."""
        session: dict[str, Any] = {"started": _now(), "versions": versions()}
        if arguments:
            session["arguments"] = list(arguments)
        self._record["status"] = "running"
        self._record["sessions"].append(session)
        try:
            self.write_text(STUDY, study)
            self.write_json(RECORD, self._record)
        except KeyboardInterrupt:
            self.close("interrupted")
            raise
        self._untouched = bool(self.ended)

    @property
    def record(self) -> Mapping[str, Any]:
        """What `run.json` holds: command, seed, arguments, versions, hash of the study, status."""
        return self._record

    def require_same_packages(self) -> None:
        """Refuse to go on with numbers that other packages computed.

        This package's own changes are allowed: a defect may be repaired while a run waits.

        Raises:
            RunError: the message names the packages.
        """
        first, now = self._record["sessions"][0]["versions"], versions()
        others = [
            f"{p} {first[p]} (here {now[p]})"
            for p in PACKAGES
            if p in first and p in now and first[p] != now[p]
        ]
        if others:
            raise RunError(
                f"{self.folder}: began with {', '.join(others)}; results of both would be mixed: "
                "install those, use another --out, or remove the folder"
            )

    def path(self, name: str) -> Path:
        """Return where a file of the run is.

        Raises:
            RunError: `name` leads out of the run folder.
        """
        return inside(self.folder, name)

    def has(self, name: str) -> bool:
        """Return whether a file has been written."""
        return self.path(name).is_file()

    def write_bytes(self, name: str, content: bytes) -> Path:
        """Write a file."""
        with self.writing(name) as path:
            path.write_bytes(content)
        return self.path(name)

    def write_text(self, name: str, content: str) -> Path:
        """Write a text file in UTF-8."""
        return self.write_bytes(name, content.encode())

    def write_json(self, name: str, value: Any) -> Path:
        """Write JSON, keys in the order given.

        Raises:
            ValueError: a number is NaN or infinite, which JSON does not have.
        """
        return self.write_text(name, json.dumps(plain(value, name), indent=2) + "\n")

    def write_frame(self, name: str, frame: "pd.DataFrame") -> Path:
        """Write a Parquet file."""
        with self.writing(name) as path:
            frame.to_parquet(path)
        return self.path(name)

    @contextlib.contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Yield a path to write to, which becomes the file `name` when the block has ended well.

        For what writes files by itself, such as figures; the path has the ending of `name`.
        """
        self._untouched = False
        with atomic(self.path(name)) as path:
            yield path

    def read_json(self, name: str) -> Any:
        """Read a JSON file of the run."""
        return read_json(self.folder, name)

    def read_frame(self, name: str) -> "pd.DataFrame":
        """Read a Parquet file of the run."""
        return read_frame(self.folder, name)

    def close(self, status: Status) -> None:
        """Write how the command ended, and let go of the folder."""
        self._record["status"] = status
        self._record["sessions"][-1]["ended"] = _now()
        self.write_json(RECORD, self._record)
        self._lock.close()

    def __enter__(self) -> "Run":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None or (self._untouched and isinstance(error, UserError)):
            self.close("finished")
            return
        if self._created and isinstance(error, UserError) and self._is_bare():
            # by the one that holds it: another process could begin in it as soon as it is let go
            if sys.platform == "win32":  # where what is open cannot be removed
                self._lock.close()
            shutil.rmtree(self.folder)
            self._lock.close()
            return
        self.close("interrupted" if is_interrupt(error) else "failed")

    def _is_bare(self) -> bool:
        """Whether the input was wrong before anything was computed."""
        return {p.name for p in self.folder.iterdir()} <= {RECORD, STUDY, LOCK, *_MADE_OF}


def _new_record(study: Mapping[str, Any], command: str, seed: int | None) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "command": command,
        "seed": seed,
        "study_sha256": digest(study),
        "status": "running",
        "sessions": [],
    }


def _when_finished(record: Mapping[str, Any]) -> str:
    if record["status"] != "finished":
        return ""
    return str(record["sessions"][-1].get("ended", ""))


def _remove_leftovers(folder: Path) -> None:
    """Remove what a killed process was writing."""
    for path in folder.rglob(f"{UNFINISHED}*"):
        if path.is_file():
            path.unlink(missing_ok=True)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
