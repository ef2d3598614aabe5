"""`bo-sysid effects`: the catalogue of physics that a diagnosis looks for."""

import argparse
import json
from pathlib import Path

from bo_sysid.cli.common import Verbs


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "effects",
        help="list the physics that a diagnosis looks for",
        description="List the effects that a model can lack or have wrong: where they act, in "
        "which unit (at a hinge) they are told, what gives them away in recordings, and what they "
        "become in a model.",
    )
    parser.add_argument("--json", action="store_true", help="print all that is known, as JSON")
    parser.add_argument(
        "--file",
        action="append",
        default=[],
        type=Path,
        metavar="PYTHON",
        help="run this file with effects of your own first",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Print the catalogue."""
    from bo_sysid.effects import catalogue, listing

    found = listing(catalogue(args.file).values())
    if args.json:
        print(json.dumps(found.to_dict("records"), indent=2, ensure_ascii=False))
        return

    from bo_sysid.report.text import table

    shown = found[["id", "site", "unit", "model", "evidence"]]
    print(table(shown.rename(columns={"model": "in the model", "evidence": "what gives it away"})))
