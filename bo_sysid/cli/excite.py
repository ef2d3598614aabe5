"""`bo-sysid excite`: a safe and informative trajectory to record."""

import argparse
from pathlib import Path

from bo_sysid.cli.common import Verbs, add_study, load_study, run_folder
from bo_sysid.cli.progress import shown


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "excite",
        help="plan a safe trajectory from which the parameters can be identified",
        description="Plan controls that keep the study's limits and from which its parameters can "
        "be identified as well as possible, through the simulator. Writes a CSV file, a picture, "
        "predicted intervals.",
    )
    add_study(parser)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="runs/<study>-excite otherwise")
    parser.add_argument(
        "--seconds",
        type=float,
        default=10.0,
        metavar="S",
        help="length of the trajectory in s (default: %(default)g)",
    )
    parser.add_argument(
        "--interval",
        type=float,
        default=0.01,
        metavar="S",
        help="time between two controls in s (default: %(default)g)",
    )
    parser.add_argument(
        "--budget",
        type=int,
        default=2400,
        metavar="N",
        help="trajectories that are tried, 28 or more (default: %(default)s)",
    )
    parser.add_argument(
        "--effects", action="store_true", help="also friction, damping, armature, springs of joints"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Plan, write, and print what the trajectory will tell."""
    study = load_study(args)
    folder = run_folder(args, "excite")
    folder.mkdir(parents=True, exist_ok=True)  # before the search, which takes minutes

    from bo_sysid.excite.excite import excite
    from bo_sysid.excite.trial import PROOF
    from bo_sysid.execution import Progress, use_threads
    from bo_sysid.report.check_figures import recording_figure
    from bo_sysid.report.figures import save
    from bo_sysid.report.text import table
    from bo_sysid.runs import atomic

    with use_threads(args.threads), shown("excite") as progress:
        found = excite(
            study,
            seconds=args.seconds,
            interval=args.interval,
            budget=args.budget,
            effects=args.effects,
            report=lambda done, cost: progress(Progress(min(done, args.budget), args.budget)),
        )
    for name, frame in (("controls.csv", found.controls), ("parameters.csv", found.parameters)):
        with atomic(folder / name) as path:
            frame.to_csv(path, index=False)
    with atomic(folder / "predicted.png") as path:
        save(recording_figure(found.predicted, limits=found.limits), path)
    shown_columns = {"sigma": "± (68 %)", "of_range": "of range", "determined": "identifiable"}
    print("What a recording of this trajectory would tell at best:")
    print(table(found.parameters.rename(columns=shown_columns)))
    print(
        f"\n{100 * found.used:.0f} % of the limits are used by the machines that were tried: the "
        f"nominal one, {PROOF} within the parameters' bounds, and corners of these."
        if found.used
        else "\nNo limits were kept: neither the study nor the model states any for these joints."
    )
    for note in found.notes:
        print(f"- {note}")
    print(f"\n{folder}: controls.csv (hold each row until the next), parameters.csv, predicted.png")
