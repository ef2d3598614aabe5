"""`bo-sysid record`: roll the plant of a study out into recordings."""

import argparse
import shlex

from bo_sysid.cli.common import Verbs, add_out, add_study, load_study, open_run
from bo_sysid.cli.progress import shown


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "record",
        help="roll a simulated plant out into recordings",
        description="Move the plant of a study (its key plant) and write what its sensors tell, "
        "with a study on these recordings beside them.",
    )
    add_study(parser)
    add_out(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Record, and print where."""
    study = load_study(args)
    with open_run(args, study, "record") as run, shown("record") as progress:
        from bo_sysid.plants.recorded import record_into

        path, notes = record_into(run, study, args.study.stem, progress)
    for note in notes:
        print(note)
    verb = "identify" if study.parameters else "diagnose"
    print(f"{path.parent}: recordings of the plant. Now: bo-sysid {verb} {shlex.quote(str(path))}")
