"""`bo-sysid init`: a first study from a model and logs."""

import argparse
import shlex
from pathlib import Path

from bo_sysid.cli.common import Verbs


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "init",
        help="write a first study from a model and logs, guesses marked",
        description="Match the columns of logs with the joints and actuators of a model, by name "
        "and by behaviour, and write a commented study. Every guess stands with its reason.",
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="an MJCF or URDF file")
    parser.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="logs of one machine")
    parser.add_argument(
        "--out", type=Path, metavar="STUDY", help="the study; <model>.yaml in this folder otherwise"
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=0.0,
        metavar="HZ",
        help="rows per second, where no column has time stamps",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Write the study, and say what was guessed."""
    import pandas as pd

    from bo_sysid.report.text import table
    from bo_sysid.starter.init import init

    started = init(
        args.model, args.logs, args.out or Path(f"{args.model.stem}.yaml"), rate=args.rate
    )
    guesses = pd.DataFrame(
        {
            "channel": [g.channel for g in started.rules.guesses.values()],
            "column": [g.column for g in started.rules.guesses.values()],
            "confidence": [g.confidence for g in started.rules.guesses.values()],
            "because of": [g.reason for g in started.rules.guesses.values()],
        }
    )
    print(table(guesses))
    for note in started.notes:
        print(f"- {note}")
    if started.rules.held:
        held = ", ".join(started.rules.held)
        print(
            f"- Not recorded, held where the model puts them: {held}. If they move (a base that "
            "rolls, a passive joint), list them under `unrecorded` instead, in `model:`."
        )
    if following := started.rules.following:
        joints = ", ".join(following)
        print(f"- Not recorded, left to move, since the model ties them to others: {joints}.")
    print(f"\n{started.path}: read it, then: bo-sysid check {shlex.quote(str(started.path))}")
