"""`bo-sysid conceal`: draw machines that lack physics, and seal what it is."""

import argparse
import shlex
from pathlib import Path

from bo_sysid.cli.common import RUNS, Verbs, arguments
from bo_sysid.cli.progress import shown


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "conceal",
        help="draw cases in which physics is concealed, for a proof of the diagnosis",
        description="Draw the cases of a suite: per case what a person would have, and apart from "
        "it the sealed answer. Publish the hash that is printed; bo-sysid reveal diagnoses the "
        "cases, opens the seals and scores. An interrupted run goes on with the same command.",
    )
    parser.add_argument("suite", type=Path, metavar="SUITE", help="the suite file (YAML)")
    parser.add_argument(
        "--out", type=Path, metavar="RUN", help="the run folder; runs/<suite>-conceal otherwise"
    )
    parser.add_argument(
        "--seals",
        type=Path,
        metavar="FOLDER",
        help="where the answers are kept; <RUN>-sealed otherwise",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="replace a value of the suite, as in --set cases=20",
    )
    parser.add_argument(
        "--threads", type=int, metavar="N", help="number of processes; one a core otherwise"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Conceal, and print what is to be published."""
    from bo_sysid.execution import use_threads
    from bo_sysid.proof.conceal import COMMITMENTS, conceal, suite_record
    from bo_sysid.proof.seal import file_digest
    from bo_sysid.runs import Run
    from bo_sysid.study import parse_override

    overrides = dict(parse_override(text) for text in args.set)
    record = suite_record(args.suite, overrides)
    folder = args.out or RUNS / f"{args.suite.stem}-conceal"
    with (
        use_threads(args.threads),
        Run.open(folder, record, "conceal", arguments=arguments(args)) as opened,
        shown("conceal") as progress,
    ):
        said = conceal(opened, args.suite, overrides=overrides, seals=args.seals, progress=progress)
    print(f"{folder}: {len(said['cases'])} cases, their answers sealed apart.")
    print(f"Publish: SHA-256 of {COMMITMENTS} is {file_digest(folder / COMMITMENTS)}")
    print(f"Now: bo-sysid reveal {shlex.quote(str(folder))}")
