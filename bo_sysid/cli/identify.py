"""`bo-sysid identify`: find the parameters that fit, and how sure one can be."""

import argparse
from functools import partial
from typing import TYPE_CHECKING

from bo_sysid.cli.common import Verbs, add_out, add_strict, add_study, load_study, open_run
from bo_sysid.cli.finished_runs import once
from bo_sysid.cli.progress import shown

if TYPE_CHECKING:
    from bo_sysid.runs import Run
    from bo_sysid.study import Study

_RESULTS = ("identification.json", "belief.parquet", "model_identified.xml", "traces.parquet")


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "identify",
        help="find the parameters that fit, and how sure one can be",
        description="Find the parameters of the model that predict the recordings best, and how "
        "sure one can be. An interrupted run goes on with the same command; a finished one is told "
        "again.",
    )
    add_study(parser)
    add_strict(parser)
    add_out(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Identify, and print what was found."""
    study = load_study(args)

    from bo_sysid.study.overview import overview, require_searchable

    # wrong input is told before torch is loaded
    require_searchable(study, overview(study, strict=args.strict).candidates)
    with open_run(args, study, "identify") as run:
        compute = partial(identify_into, run, study, strict=args.strict)
        once(run, study, compute, _RESULTS, strict=args.strict)
    print_run(run)


def identify_into(run: "Run", study: "Study", *, strict: bool = False) -> None:
    """Identify into a run folder, with progress, and draw what was found.

    Raises:
        UserError: the study, its model or its recordings are wrong.
    """
    with shown("identify") as progress:
        from bo_sysid.identify import identify

        identify(study, run, progress=progress, strict=strict)

    from bo_sysid.report.write import write_figures

    write_figures(run)


def print_run(run: "Run") -> None:
    """Print what a run found, and where it is."""
    from bo_sysid.report.text import run_text

    print(run_text(run.folder))
    print(f"\nFigures: {run.path('figures')}. Model: {run.path('model_identified.xml')}.")
