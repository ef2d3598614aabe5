"""`bo-sysid demo`: the main job on an embedded study, from recording to the repaired model."""

import argparse
import shlex
from importlib import resources
from pathlib import Path

from bo_sysid.cli.common import RUNS, Verbs
from bo_sysid.cli.diagnose import diagnose_into, print_run
from bo_sysid.cli.progress import shown

FILES = ("arm.yaml", "arm.xml")


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "demo",
        help="find out what the model of a simulated arm lacks, in a minute",
        description="Record a simulated two-link arm that has something its model lacks, find out "
        "what and where, and leave the repaired model and pictures.",
    )
    parser.add_argument(
        "--out", type=Path, default=RUNS / "demo", metavar="FOLDER", help="default: %(default)s"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Record the arm, diagnose it, and print what was found and what was true."""
    from bo_sysid.execution import use_threads
    from bo_sysid.plants.recorded import record_into
    from bo_sysid.runs import Run, atomic
    from bo_sysid.study import Study

    for name in FILES:
        with atomic(args.out / name) as path:
            path.write_bytes(resources.files(__package__).joinpath(name).read_bytes())
    study = Study.load(args.out / FILES[0])
    folder = args.out / "record"
    with Run.open(folder, study.resolved(folder), "record") as run, shown("record") as progress:
        recorded, _ = record_into(run, study, "arm", progress)
    study = Study.load(recorded)
    folder = args.out / "diagnose"
    with use_threads(None), Run.open(folder, study.resolved(folder), "diagnose") as run:
        diagnose_into(run, study)
    print_run(run)
    assert study.plant is not None  # noqa: S101 - the embedded study has one
    truth = ", ".join(f"{name} {value:g}" for name, value in study.plant.parameters.items())
    print(f"\nThe recorded arm had: {truth}.")
    repaired = shlex.quote(str(folder / "study_repaired.yaml"))
    print(f"To go on with the repaired model: bo-sysid identify {repaired}")
