"""`bo-sysid demo`: the main job on an embedded study, from recording to pictures."""

import argparse
from importlib import resources
from pathlib import Path

from bo_sysid.cli.common import RUNS, Verbs
from bo_sysid.cli.identify import identify_into, print_run
from bo_sysid.cli.progress import shown
from bo_sysid.cli.record import record_into

FILES = ("pendulum.yaml", "pendulum.xml")


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "demo",
        help="identify a simulated pendulum, in a minute",
        description="Record a simulated pendulum that differs from its model, find out in what, "
        "and leave tables and pictures.",
    )
    parser.add_argument(
        "--out", type=Path, default=RUNS / "demo", metavar="FOLDER", help="default: %(default)s"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Record the pendulum, identify it, and print what was found."""
    from bo_sysid.runs import Run, atomic
    from bo_sysid.study import Study

    for name in FILES:
        with atomic(args.out / name) as path:
            path.write_bytes(resources.files(__package__).joinpath(name).read_bytes())
    study = Study.load(args.out / FILES[0])
    folder = args.out / "record"
    with Run.open(folder, study.resolved(folder), "record") as run, shown("record") as progress:
        recorded = record_into(run, study, "pendulum", progress)
    study = Study.load(recorded)
    folder = args.out / "identify"
    with Run.open(folder, study.resolved(folder), "identify") as run:
        identify_into(run, study)
    print_run(run)
    assert study.plant is not None  # noqa: S101 - the embedded study has one
    truth = ", ".join(f"{name} {value:g}" for name, value in study.plant.parameters.items())
    print(f"\nThe recorded pendulum had: {truth}.")
