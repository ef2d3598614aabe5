"""Reveal: check every hash, then open the seals, then score.

Opening is recorded twice, in the run and beside the seals, together with the hash of the record of
every answer whose seal is opened. An answer that is not in that list came too late. Seals may be
opened in instalments; what was opened stays in every later score. What the checks catch is said in
the message; the first thing that is wrong ends the reveal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bo_sysid.errors import RunError
from bo_sysid.proof.answer import (
    ANSWERS,
    OPENED,
    answer_files,
    answers_at_opening,
    commitments,
    judged,
    openings_in,
    record_of,
)
from bo_sysid.proof.conceal import CASES, COMMITMENTS, seals_of
from bo_sysid.proof.seal import Seal, file_digest, write_json
from bo_sysid.runs import Run, read_json


@dataclass(frozen=True)
class Revealed:
    """A case with its answer and the truth, both as they were sealed and frozen.

    Attributes:
        name: of the case.
        truth: what was concealed.
        answer: content of `diagnosis.json`; None where the diagnosis failed.
        error: why it failed.
        seconds: that the diagnosis took.
        versions: of what made the answer.
    """

    name: str
    truth: Mapping[str, Any]
    answer: Mapping[str, Any] | None
    error: str | None
    seconds: float
    versions: Mapping[str, str]


def reveal(
    run: Run,
    *,
    first: int | None = None,
    seals: str | Path | None = None,
    published: str | None = None,
) -> tuple[Revealed, ...]:
    """Check a run and open its seals.

    Args:
        run: with every case answered.
        first: only so many of them, see `judged`; the seals of the others stay closed, for a
            later call.
        seals: folder of the seals; beside the run where left out.
        published: SHA-256 of `commitments.json`, where it was published elsewhere.

    Raises:
        RunError: anything that is hashed differs, an answer is missing, or an answer came after
            the seals were opened.
    """
    folder = run.folder
    committed = commitments(folder)
    require_published(folder, published)
    held = require_seals(folder, seals, judged(folder, first))
    _check_shown(folder, committed["cases"])
    records = {name: _checked_record(folder, name) for name in judged(folder, first)}
    _open(folder, held, records)
    found = []
    for name, record in records.items():
        truth = _opened_seal(folder, held, name, committed["cases"][name])
        answer = None if record["error"] else read_json(folder, f"{ANSWERS}/{name}/diagnosis.json")
        error, seconds = record["error"], float(record["seconds"])
        found.append(Revealed(name, truth, answer, error, seconds, record["versions"]))
    return tuple(found)


def require_published(folder: Path, published: str | None) -> None:
    """Refuse commitments that are not those that were published; None was published nowhere.

    Raises:
        RunError: they are others.
    """
    if published is not None and file_digest(folder / COMMITMENTS) != published.strip().lower():
        raise RunError(f"{folder / COMMITMENTS}: not the commitments that were published")


def require_seals(folder: Path, seals: str | Path | None, names: Sequence[str]) -> Path:
    """Return the folder of the seals, by default that beside the run.

    Raises:
        RunError: it lacks a seal of one of the cases.
    """
    held = Path(seals) if seals else seals_of(folder.resolve())
    for name in names:
        path = held / f"{name}.json"
        if not path.is_file():
            raise RunError(f"{path}: the seal is missing; without it nothing can be revealed")
    return held


def _check_shown(folder: Path, cases: Mapping[str, Any]) -> None:
    """Refuse where what is shown is not what was published."""
    there = {p.name for p in (folder / CASES).iterdir()} if (folder / CASES).is_dir() else set()
    for name in sorted(there ^ set(cases)):
        what = "was not published" if name in there else "is missing"
        raise RunError(f"{folder / CASES / name}: this case {what}")
    for name, case in cases.items():
        place = folder / CASES / name
        shown = {p.relative_to(place).as_posix() for p in place.rglob("*") if p.is_file()}
        for file in sorted(shown ^ set(case["files"])):
            what = "was not published" if file in shown else "is missing"
            raise RunError(f"{place / file}: this file {what}")
        for file, sha256 in case["files"].items():
            _require(file_digest(place / file) == sha256, place / file, "was changed since")


def _checked_record(folder: Path, name: str) -> Mapping[str, Any]:
    """Return the record that froze an answer, after comparing it with the answer.

    Raises:
        RunError: there is none, or it is not about this answer.
    """
    path = folder / record_of(name)
    if not path.is_file():
        raise RunError(f"{path}: case {name} has no answer; nothing is opened before all have one")
    record: Mapping[str, Any] = read_json(folder, record_of(name))
    known = {"case", "frozen", "commitments", "files", "seconds", "error", "versions"}
    _require(known <= set(record) and record["case"] == name, path, "is damaged")
    same = record["commitments"] == file_digest(folder / COMMITMENTS)
    _require(same, path, "answers other commitments than those of this run")
    now = answer_files(folder, name)
    for file in sorted(set(now) ^ set(record["files"])):
        raise RunError(
            f"{folder / ANSWERS / name / file}: not as it was when the answer was frozen"
        )
    for file, sha256 in record["files"].items():
        changed = folder / ANSWERS / name / file
        _require(now[file] == sha256, changed, "was changed after the answer was frozen")
    if record["error"] is None:
        _require("diagnosis.json" in now, path, "says that there is an answer; there is none")
    return record


def _open(folder: Path, seals: Path, records: Mapping[str, Mapping[str, Any]]) -> None:
    """Record the opening of seals that are still closed; compare the others with their record."""
    frozen = {name: file_digest(folder / record_of(name)) for name in records}
    commitment = file_digest(folder / COMMITMENTS)
    places = (seals / OPENED, folder / OPENED)
    openings: list[dict[str, Any]] = []
    copies = {p: openings_in(p.parent) for p in places if p.is_file()}
    for place, copy in copies.items():
        own = read_json(place.parent, OPENED)["commitments"] == commitment
        _require(own, place, "is of another run")
        short, long = sorted((openings, copy), key=len)
        # one of them lacks the last where an opening was interrupted
        same = long[: len(short)] == short
        _require(same, places[1], "differs from its copy beside the seals")
        openings = long
    known = answers_at_opening(openings)
    for name in frozen.keys() & known.keys():
        same = known[name] == frozen[name]
        _require(same, folder / record_of(name), "came after its seal was opened")
    fewer = f"says that {len(known)} cases were opened, not {len(frozen)}"
    _require(known.keys() <= frozen.keys(), places[0], fewer)
    new = {name: sha256 for name, sha256 in frozen.items() if name not in known}
    if new:
        now = datetime.now(UTC).isoformat(timespec="microseconds")
        for name in new:
            early = str(records[name]["frozen"]) <= now
            _require(early, folder / record_of(name), "is frozen at a time that is yet to come")
        openings = [*openings, {"opened": now, "answers": new}]
    for place in places:
        if place not in copies or copies[place] != openings:
            write_json(place, {"commitments": commitment, "openings": openings})


def _opened_seal(
    folder: Path, seals: Path, name: str, case: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Return the truth of a case, after comparing it with its commitment."""
    path = seals / f"{name}.json"
    seal = Seal.read(path)
    _require(seal.commitment == case["sha256"], path, "is not what was committed to")
    _require(seal.answer.get("name") == name, path, "is the seal of another case")
    same = seal.answer.get("files") == case["files"]
    _require(same, folder / CASES / name, "is not the case that was sealed")
    return seal.answer


def _require(holds: bool, path: Path, what: str) -> None:
    if not holds:
        raise RunError(f"{path}: {what}; nothing is scored")
