"""`bo-sysid diagnose`: which physics the model leaves out, and the model with it put in."""

import argparse
from functools import partial
from typing import TYPE_CHECKING

from bo_sysid.cli.common import Verbs, add_out, add_strict, add_study, load_study, open_run
from bo_sysid.cli.finished_runs import once
from bo_sysid.cli.progress import shown
from bo_sysid.cli.report import page_of

if TYPE_CHECKING:
    from bo_sysid.runs import Run
    from bo_sysid.study import Study

_RESULTS = ("diagnosis.json", "summary.json", "model_repaired.xml", "study_repaired.yaml")


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "diagnose",
        help="find the physics that the model leaves out, and put it in",
        description="Find where model and recordings disagree and which physics the model leaves "
        "out, put it into the model, and say how well that predicts recordings that were never "
        "used.",
    )
    add_study(parser)
    add_strict(parser)
    add_out(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Diagnose, and print what was found."""
    study = load_study(args)
    with open_run(args, study, "diagnose") as run:
        compute = partial(diagnose_into, run, study, strict=args.strict)
        once(run, study, compute, _RESULTS, strict=args.strict)
    print_run(run)


def diagnose_into(run: "Run", study: "Study", *, strict: bool = False) -> None:
    """Diagnose into a run folder, with progress, and draw what was found.

    Raises:
        UserError: the study, its model or its recordings are wrong.
    """
    with shown("diagnose") as progress:
        from bo_sysid.diagnosis import diagnose

        diagnose(study, run, progress=progress, strict=strict)

    from bo_sysid.report.write import write_diagnosis_figures

    write_diagnosis_figures(run)


def print_run(run: "Run") -> None:
    """Print what a run found, and where it is."""
    from bo_sysid.report.text import run_text

    print(run_text(run.folder))
    page = page_of(run.folder)
    print(
        f"\nModel: {run.path('model_repaired.xml')}. Study: {run.path('study_repaired.yaml')}. "
        f"Figures: {run.path('figures')}." + (f" Page: {page}." if page else "")
    )
