"""`bo-sysid report`: what a run found, as text."""

import argparse
from pathlib import Path

from bo_sysid.cli.common import Verbs


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "report",
        help="print what a run found",
        description="Print what a run found. A run that is unfinished says how far it came.",
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="the run folder")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Print what a run found."""
    from bo_sysid.report.text import run_text

    print(run_text(args.folder))
