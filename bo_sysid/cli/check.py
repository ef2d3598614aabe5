"""`bo-sysid check`: what is wrong with a log, before anything is fitted."""

import argparse
import itertools
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bo_sysid.cli.common import Verbs, add_out, add_strict, add_study, load_study
from bo_sysid.cli.progress import shown

if TYPE_CHECKING:
    from bo_sysid.checks.check import Checked
    from bo_sysid.study import Study

_LONGEST = 160  # bytes of a recording's name in that of its picture, of the 255 of a file's name


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "check",
        help="wiring, clocks, excitation and what can be identified, without fitting",
        description="Load the model and the recordings of a study and say how they fit together: "
        "signs, units, order, zeros, clocks, excitation, what the recordings can say about the "
        "parameters. Nothing is fitted; a folder is written only with --out.",
    )
    add_study(parser)
    add_strict(parser)
    add_out(parser, "none is written otherwise")
    parser.add_argument(
        "--render", action="store_true", help="also say whether MuJoCo can render on this machine"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Check, and print what was found."""
    study = load_study(args)

    from bo_sysid.checks.check import check
    from bo_sysid.execution import use_threads
    from bo_sysid.report.check_text import checked_text

    with use_threads(args.threads), shown("check") as progress:
        found = check(study, strict=args.strict, progress=progress)
    print(checked_text(found))
    if args.render:
        print(f"\n{rendering(study, args.out)}")
    if args.out is None:
        print("\n--out FOLDER writes the tables and a picture of each recording.")
    else:
        write(found, args.out)
        print(f"\n{args.out}: the tables, and a picture of each recording.")


def rendering(study: "Study", folder: Path | None) -> str:
    """Render the model, into a folder where one is given; say what did it, or what to do."""
    from bo_sysid.report.render import rendered
    from bo_sysid.study.inputs import load_model

    with tempfile.TemporaryDirectory() as spare:
        place = folder or Path(spare)
        place.mkdir(parents=True, exist_ok=True)
        model = Path(spare) / "model.xml"
        load_model(study).export(model)
        backend = rendered(model, {}, [], place / "render.png")
    if backend is None:
        return (
            "Rendering: neither EGL nor OSMesa works here; sketches are drawn instead. "
            "apt-get install libegl1 (with a GPU's driver or Mesa) or libosmesa6 provides one."
        )
    return f"Rendering: works with MUJOCO_GL={backend}."


def write(found: "Checked", folder: Path) -> None:
    """Write what was found: the text, tables, the proposal and a picture of each recording."""
    from bo_sysid.report.check_figures import recording_figure
    from bo_sysid.report.check_text import checked_text
    from bo_sysid.report.figures import save
    from bo_sysid.runs import atomic

    with atomic(folder / "check.txt") as place:
        place.write_text(checked_text(found, whole=True) + "\n", encoding="utf-8")
    tables = {
        "motion": found.motion,
        "delays": found.wiring.delays,
        "balance": found.wiring.balance,
        "parameters": found.parameters,
        "step": found.step,
    }
    for name, table in tables.items():
        with atomic(folder / f"{name}.csv") as place:
            table.to_csv(place, index=False)
    proposed = folder / "recordings.yaml"
    if found.proposal:
        with atomic(proposed) as place:
            place.write_text(found.proposal + "\n", encoding="utf-8")
    else:  # that of an earlier check is no longer proposed
        proposed.unlink(missing_ok=True)
    flagged = {n for f in found.flags if f.level != "note" for n in f.channels}
    order = list(found.summary.channels["channel"])
    titles = _titles([recording.name for recording in found.recordings])
    for recording, title in zip(found.recordings, titles, strict=True):
        with atomic(folder / f"{title}.png") as place:
            save(recording_figure(recording, flagged, order=order), place)


def _titles(names: Sequence[str]) -> list[str]:
    """Return a name for the picture of each recording, which leads nowhere else.

    What a file says of its own name is not to be trusted; two logs may have one name.
    """
    taken = {"render"}  # the picture of --render
    titles = []
    for name in names:
        plain = re.sub(r"[^\w.-]+", "-", name).strip("-.").encode()[:_LONGEST]
        short = plain.decode(errors="ignore") or "recording"  # of a letter that was cut, nothing
        numbered = (f"{short}-{k}" for k in itertools.count(2))
        title = next(t for t in itertools.chain([short], numbered) if t.lower() not in taken)
        taken.add(title.lower())
        titles.append(title)
    return titles
