"""Results as text: what the command line prints, and `bo-sysid report` again later."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from bo_sysid.errors import RunError
from bo_sysid.runs import FITS, held, read_frame, read_json, read_record
from bo_sysid.study.overview import Overview

_FEW = 12  # notes that are shown; all are in the run folder


def run_text(folder: str | Path) -> str:
    """Return what a run folder holds, in words and tables.

    A run that is unfinished says how far it came.

    Raises:
        RunError: the folder is no run, or is damaged.
    """
    folder = Path(folder)
    record = read_record(folder)
    head = f"{folder}: {record['command']}, {_status(folder, record)}"
    for name, say in _ANSWERS.items():
        if (folder / name).is_file():
            return f"{head}\n{_answer_text(say, folder, name)}"
    if (folder / "evaluations.parquet").is_file():
        frame = read_frame(folder, "evaluations.parquet", ["deviation"])
        return (
            f"{head}\n{len(frame)} evaluations so far, lowest deviation "
            f"{frame['deviation'].min():.4g}. Run the same command again to resume."
        )
    recorded = sorted(p.name for p in folder.glob("*.parquet"))
    if record["command"] == "record" and recorded:
        return f"{head}\nRecordings of the plant: {', '.join(recorded)}. Study: {_study(folder)}."
    if record["command"] == "conceal" and (folder / "commitments.json").is_file():
        return f"{head}\n{_concealed(folder)}"
    rounds = len(list(folder.glob("iterations/*/iteration.json")))
    if rounds:
        return (
            f"{head}\nIterations so far: {rounds}, each with the policy that it learned "
            "(iterations/*/policy.npz). Run the same command again to resume."
        )
    if record["command"] == "learn" and (begun := _begun(folder)):
        return f"{head}\n{begun} Run the same command again to resume."
    compared = len(list(folder.glob("records/*/*/[0-9]*.json")))
    if record["command"] == "compare" and compared:
        return f"{head}\nRuns of arms so far: {compared}. Run the same command again to resume."
    fits = len(list((folder / FITS).glob("*.npz")))
    if fits:
        return (
            f"{head}\nNothing is decided yet; fits so far: {fits}. Run the same command again to "
            "resume."
        )
    return f"{head}\nNothing was computed yet."


def _begun(folder: Path) -> str:
    """Say how far the first iteration of `learn` is; empty where nothing is there."""
    sentences = []
    if real := len(list(folder.glob("trajectories/*.parquet"))):
        sentences.append(f"Real trajectories so far: {real} (trajectories/*.parquet).")
    if list(folder.glob("iterations/*/identified.json")):
        sentences.append("The model is identified (iterations/*/belief.parquet).")
    if list(folder.glob("iterations/*/training/*.npz")):
        sentences.append("TRPO has begun.")
    return " ".join([*sentences, "No policy was learned yet."]) if sentences else ""


def _concealed(folder: Path) -> str:
    """Say how far the cases of `conceal` are, and what goes on with them."""
    cases = len(read_json(folder, "commitments.json")["cases"])
    answered = len(list(folder.glob("answers/*.json")))
    after = (
        f"All scores are in {folder / 'proof.html'}."
        if (folder / "proof.html").is_file()
        else f"Go on with: bo-sysid reveal {shlex.quote(str(folder))}"
    )
    return f"Concealed cases: {cases}, with an answer: {answered}. {after}"


def _status(folder: Path, record: Mapping[str, Any]) -> str:
    """Return how far a run is; one of `learn` may wait for a person."""
    if (folder / "learning.json").is_file():
        learning = read_json(folder, "learning.json")
        if isinstance(learning, Mapping) and learning.get("status") == "waiting":
            return "waiting for a recording"
    if record["status"] == "running" and not held(folder):
        return "interrupted"  # it was killed, and could not say so
    return str(record["status"])


def _answer_text(say: Callable[[Any, Path], str], folder: Path, name: str) -> str:
    """Return the words of an answer; where it is not as it is written, the file is named."""
    content = read_json(folder, name)
    try:
        return say(content, folder)
    except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
        problem = f"{type(error).__name__}: {error}"
        raise RunError(
            f"{folder / name}: damaged, not as this version writes it ({problem}); run the command "
            "again, with another --out"
        ) from None


def _identified(content: Any, _: Path) -> str:
    return identification_text(content)


def _learned(content: Any, folder: Path) -> str:
    from bo_sysid.report.learning import learning_text

    return learning_text(content, folder)


def _compared(content: Any, folder: Path) -> str:
    from bo_sysid.report.comparison import comparison_text

    return comparison_text(content, folder)


def _diagnosed(content: Any, folder: Path) -> str:
    from bo_sysid.report.diagnosis_text import diagnosis_text

    summary = _if_there(folder, "summary.json", read_json)
    sessions = _if_there(folder, "sessions.parquet", read_frame)
    return diagnosis_text(content, summary if isinstance(summary, dict) else None, sessions)


def _frozen(content: Any, folder: Path) -> str:
    """Return a diagnosis' answer of which the hold-out was not read yet."""
    sentences = [str(f["sentence"]) for f in content["findings"]] or ["Nothing is named."]
    pending = "The unseen recordings were not compared yet. Run the same command again to resume."
    return "\n".join([*sentences, pending])


_ANSWERS: Mapping[str, Callable[[Any, Path], str]] = {
    "identification.json": _identified,
    "learning.json": _learned,
    "comparison.json": _compared,
    "diagnosis.json": _diagnosed,
    "answer.json": _frozen,
}
"""The files that hold what a run found, each with what puts it into words."""


def _study(folder: Path) -> str:
    """Return the study that `record` wrote beside its recordings."""
    written = [p.name for p in folder.glob("*.yaml") if p.name != "study.yaml"]
    return min(written, default="not written yet")


def _if_there(folder: Path, name: str, read: Callable[[Path, str], Any]) -> Any:
    return read(folder, name) if (folder / name).is_file() else None


def identification_text(summary: Mapping[str, Any]) -> str:
    """Return an identification's `summary` in words and tables."""
    parameters = pd.DataFrame(summary["parameters"])
    shown = [c for c in ("name", "unit", "nominal", "value", "low95", "high95") if c in parameters]
    parts = [
        f"{summary['name']}: {summary['evaluations']} of {summary['candidates']} candidates were "
        f"tried. {summary['stopped']}",
        "",
        table(parameters[shown]),
    ]
    bound = parameters.loc[parameters["at_bound"].astype(bool), "name"]
    if len(bound):
        parts += ["", f"On a bound, so that the truth may lie beyond: {', '.join(bound)}."]
    unsure = summary.get("unsure", [])
    parts += ["", *unsure] if unsure else []
    parts += [
        "",
        "Root mean square errors of prediction:",
        table(compared_table(summary["errors"])),
    ]
    return "\n".join([*parts, *notes_text(summary["notes"])])


def compared_table(errors: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return an identification's `errors` as they are shown: shares of diverged windows where any.

    Args:
        errors: of `identification.json`; None for an error that is not known. Those of earlier
            versions have no shares.
    """
    frame = pd.DataFrame(list(errors))
    frame = frame.astype({c: float for c in ("nominal", "identified") if c in frame})
    shares = [c for c in ("nominal_diverged", "identified_diverged") if c in frame]
    calm = not frame[shares].to_numpy(float).any()
    return frame.drop(columns=shares) if calm else frame


def overview_text(found: Overview, *, most: int | None = _FEW) -> str:
    """Return what a study is made of, in words and tables, with `most` notes (None: all)."""
    several = "s" if len(found.recordings) > 1 else ""
    channels = found.channels.rename(columns={"interval": "interval [ms]"})
    parts = [
        f"{found.name}: model {found.model} at {1e3 * found.timestep:g} ms, "
        f"{len(found.recordings)} training recording{several} ({', '.join(found.recordings)})",
        "",
        table(channels),
    ]
    if len(found.parameters):
        addresses = found.parameters["addresses"].map(_shortened)
        parts += [
            "",
            table(found.parameters.assign(addresses=addresses)),
            "",
            f"B has {found.candidates:,} candidates.",
        ]
    else:
        parts += ["", "Nothing is uncertain: the study names no parameters."]
    return "\n".join([*parts, *notes_text(found.notes, most)])


def table(frame: pd.DataFrame) -> str:
    """Return a DataFrame as aligned columns; numbers have four digits, what is missing is empty."""
    rows = [[cell(value) for value in row] for row in frame.to_numpy(object)]
    cells = [[str(c) for c in frame.columns], *rows]
    numeric = [pd.api.types.is_numeric_dtype(frame[c]) for c in frame.columns]
    widths = [max(len(row[k]) for row in cells) for k in range(len(numeric))]
    lines = []
    for row in cells:
        padded = [
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ]
        lines.append("  ".join(padded).rstrip())
    return "\n".join(lines)


def cell(value: object) -> str:
    """Return a value as a table shows it."""
    if isinstance(value, float):
        return "" if pd.isna(value) else f"{value:.4g}"
    return "" if value is None else str(value)


def _shortened(addresses: str, most: int = 2) -> str:
    parts = addresses.split(", ")
    more = f" and {len(parts) - most} more" if len(parts) > most else ""
    return ", ".join(parts[:most]) + more


def notes_text(notes: Sequence[str], most: int | None = _FEW) -> list[str]:
    """Return the lines that say what was done to the data, which column is which at the end."""
    if not notes:
        return []
    notes = sorted(notes, key=lambda note: " is column '" in note)
    left = len(notes[most:]) if most is not None else 0
    more = [f"- and {left} more"] if left else []
    return ["", "What was done to the data:", *[f"- {n}" for n in notes[:most]], *more]
