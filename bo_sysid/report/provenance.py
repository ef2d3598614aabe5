"""What was done to the data of a run, and how to run it again."""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from bo_sysid.errors import BoSysidError
from bo_sysid.report.parts import Found, Section, Table
from bo_sysid.runs import read_json
from bo_sysid.study import Study

PROOF = "proof.html"
_FILES = {
    PROOF: "all scores of the answers, case by case",
    "commitments.json": "hashes of the sealed answers, to be published before they are opened",
    "model_repaired.xml": "the repaired model, MJCF that plain MuJoCo loads",
    "model_repaired.json": "what stands beside it because MJCF cannot express it",
    "next_experiment.csv": "the controls of what to record next",
    "study_repaired.yaml": "the study that goes on with it",
    "model_identified.xml": "the model with the identified parameters",
    "diagnosis.json": "the diagnosis, to be read by programs",
    "identification.json": "the identification, to be read by programs",
    "learning.json": "the learning, to be read by programs",
    "policy.npz": "the learned policy",
    "policy.pt": "the same for the machine: a TorchScript module that gives commands",
    "policy.json": "what that module takes and gives, and how often",
    "paths.parquet": "every step of every run of the comparison",
    "study.yaml": "the study, with every default",
}


def data(found: Found) -> Section | None:
    """What was done to the data."""
    notes: Sequence[str] = found.summary.get("notes", ())
    if not notes and found.has("identification.json"):
        notes = read_json(found.folder, "identification.json").get("notes", ())
    if not notes:
        return None
    return Section("data", "What was done to the data", items=[str(n) for n in notes])


def again(found: Found) -> Section:
    """How to run it again: command, study, versions, files."""
    code = []
    record: Any = {}
    if found.has("run.json"):
        record = read_json(found.folder, "run.json")
        code.append(("Command", _command(found, record)))
    if found.has("study.yaml"):
        text = (found.folder / "study.yaml").read_text(encoding="utf-8", errors="replace")
        code.append(("Study", text))
    last = record["sessions"][-1]["versions"] if record.get("sessions") else {}
    versions = pd.DataFrame({"package": list(last), "version": list(last.values())})
    links = [(name, words) for name, words in _FILES.items() if found.has(name)]
    tables = [("Versions", Table.of(versions))] if last else []
    return Section("again", "Run it again", code=code, tables=tables, links=links)


def _command(found: Found, record: Mapping[str, Any]) -> str:
    """Return the command as it was given; of a run made in Python, one on the study in it."""
    sessions = record.get("sessions") or ()
    given = [s["arguments"] for s in sessions if s.get("arguments")]
    if given:
        return f"bo-sysid {shlex.join(given[-1])}"
    seed = f" --seed {record['seed']}" if record.get("seed") is not None else ""
    trust = " --trust-code" if _names_code(found) else ""
    return f"bo-sysid {record['command']} study.yaml{seed}{trust}"


def _names_code(found: Found) -> bool:
    """Whether the study names Python files, which no command runs unasked."""
    try:
        return bool(Study.load(found.folder / "study.yaml", trust_code=True).code)
    except BoSysidError:
        return False
