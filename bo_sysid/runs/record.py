"""What a run folder says of itself, and whether a command may go on with it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from bo_sysid.errors import RunError
from bo_sysid.runs.files import UNFINISHED, digest, plain, read_json, written
from bo_sysid.runs.lock import NAME as LOCK

FORMAT = 1
"""Version of the layout of run folders."""

RECORD = "run.json"
STUDY = "study.yaml"


def read_record(folder: str | Path) -> dict[str, Any]:
    """Return what `run.json` of a run folder holds.

    Raises:
        RunError: the folder is no run, is damaged, or has another format.
    """
    folder = Path(folder)
    if not (folder / RECORD).is_file():
        raise RunError(f"{folder}: not a run folder (it has no {RECORD})")
    record = read_json(folder, RECORD)
    if not isinstance(record, dict) or not {"format", "command", "status"} <= set(record):
        raise RunError(f"{folder / RECORD}: damaged; remove the folder and run again")
    if record["format"] != FORMAT:
        raise RunError(
            f"{folder}: written in format {record['format']}, this version reads {FORMAT}; "
            "use another --out"
        )
    if not record.get("sessions"):
        raise RunError(f"{folder / RECORD}: damaged; remove the folder and run again")
    return record


def differences(old: Any, new: Any, key: str = "") -> list[str]:
    """Return in words where two resolved studies differ."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        keys = list(dict.fromkeys([*old, *new]))
        return [
            d for k in keys for d in differences(old.get(k), new.get(k), f"{key}.{k}".lstrip("."))
        ]
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        pairs = enumerate(zip(old, new, strict=True))
        return [d for k, (a, b) in pairs for d in differences(a, b, f"{key}.{k}")]
    return [] if old == new else [f"{key}: {json.dumps(old)} there, {json.dumps(new)} now"]


def existing(
    folder: Path, study: Mapping[str, Any], text: str, command: str, raised: Sequence[str]
) -> dict[str, Any] | None:
    """Return the record of the run in `folder`, None where there is none yet.

    A folder without a record is empty, or holds the very study file that a killed process wrote.
    """
    found = {p.name for p in folder.iterdir() if not p.name.startswith(UNFINISHED)} - {LOCK}
    if not found or (found == {STUDY} and (folder / STUDY).read_bytes() == text.encode()):
        return None
    if RECORD not in found:
        raise RunError(
            f"{folder}: not a run folder (it has no {RECORD}) and not empty (it holds "
            f"{min(found)}); use another --out"
        )
    record = read_record(folder)
    way_out = _way_out(folder)
    if record["command"] != command:
        raise RunError(f"{folder}: holds a run of {record['command']}, not {command}; {way_out}")
    now = plain(study)
    differ = differences(_with_raised(_study_there(folder), now, raised), now)
    if differ:
        listed = "".join(f"\n  {d}" for d in differ[:10])
        raise RunError(f"{folder}: holds a run of another study; {way_out}. It differs in{listed}")
    return {**record, "study_sha256": digest(study)}


def _way_out(folder: Path) -> str:
    """Return what to do instead; a folder with recordings of a machine is none to remove."""
    returned = sorted(folder.glob("recordings/trajectory-*"))
    if not returned:
        return "use another --out, or remove the folder"
    return (
        f"use another --out, and name {folder}/recordings/{returned[0].name} (and any others there)"
        " under recordings.train: they are recordings of the machine"
    )


def _with_raised(there: Any, now: Mapping[str, Any], raised: Sequence[str]) -> Any:
    """Return the study of a folder with the numbers that are larger now."""
    for key in raised:
        section, _, name = key.partition(".")
        try:
            grown = there[section][name] < now[section][name]
        except (KeyError, TypeError):  # one of the two does not say
            continue
        if grown:
            there = {**there, section: {**there[section], name: now[section][name]}}
    return there


def _study_there(folder: Path) -> Any:
    """Return the study that a run folder holds.

    Raises:
        RunError: it is missing or damaged.
    """
    path = written(folder, STUDY)
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        why = str(error).splitlines()[0]
        raise RunError(f"{path}: damaged, not YAML ({why}); use another --out") from None
