"""One self-contained HTML page of a run: what a person opens, and mails to a colleague."""

from pathlib import Path
from typing import Any

from bo_sysid.errors import RunError
from bo_sysid.report.parts import Found
from bo_sysid.runs import FORMAT, atomic, read_json

NAME = "report.html"


def write_page(folder: str | Path) -> Path:
    """Write the page of a run into its folder.

    A run that is unfinished, damaged or from another version shows what can be shown, and says
    what is missing and why.

    Args:
        folder: the run folder.

    Raises:
        RunError: the folder is no run.
    """
    path = Path(folder) / NAME
    text = page(folder)
    with atomic(path) as beside:
        beside.write_text(text, encoding="utf-8")
    return path


def page(folder: str | Path, *, live: bool = False) -> str:
    """Return the page of a run as HTML.

    Args:
        folder: the run folder.
        live: let the page look for news of a run that is going on.

    Raises:
        RunError: the folder is no run.
    """
    from jinja2 import Environment, PackageLoader
    from plotly.offline import get_plotlyjs

    from bo_sysid.report import sections

    folder = Path(folder)
    if not (folder / "run.json").is_file():
        raise RunError(f"{folder}: not a run folder (it has no run.json)")
    found = Found(folder)
    record = _record(found)
    shown = list(found.sections(*sections.MAKERS))
    environment = Environment(
        loader=PackageLoader("bo_sysid.report", "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        head=sections.headline(found),
        record=record,
        sections=shown,
        problems=found.problems,
        plotly=get_plotlyjs(),
        live=live,
        folder=folder.resolve().name,
    )


def _record(found: Found) -> dict[str, Any]:
    """Return `run.json` as far as it can be read."""
    try:
        record = read_json(found.folder, "run.json")
    except RunError as error:
        found.problems.append(str(error))
        record = {}
    if not isinstance(record, dict):
        record = {}
    if record.get("format") not in (None, FORMAT):
        found.problems.append(
            f"The run was written in format {record['format']}, this version reads {FORMAT}."
        )
    status = record.get("status", "unknown")
    if status != "finished":
        found.problems.append(f"The run is not finished: its status is {status}.")
    return {"command": "?", "sessions": [], **record, "status": status}
