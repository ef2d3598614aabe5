"""`bo-sysid check`: what model, recordings and parameters are, before anything is fitted."""

import argparse

from bo_sysid.cli.common import Verbs, add_study, load_study


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "check",
        help="match recordings and parameters with the model, without fitting",
        description="Load the model and the recordings of a study and print how they fit together. "
        "Nothing is fitted, nothing is written.",
    )
    add_study(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Check, and print what was found."""
    study = load_study(args)

    from bo_sysid.report.text import check_text
    from bo_sysid.study.check import check

    print(check_text(check(study, strict=args.strict)))
