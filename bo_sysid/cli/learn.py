"""`bo-sysid learn`: a policy from few real trajectories."""

import argparse
import shlex

from bo_sysid.cli.common import Verbs, add_out, add_strict, add_study, load_study, open_run
from bo_sysid.cli.progress import shown


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "learn",
        help="learn a policy with few real trajectories",
        description="Learn a policy for the task of a study: record a trajectory, identify the "
        "model on all recordings, learn on it, and so on. Without the key plant the machine is "
        "yours: the policy is written, and the same command goes on once its recording is there. "
        "An interrupted run goes on with the same command, and one whose trajectories are spent "
        "with more of them (--set learn.trajectories=6).",
    )
    add_study(parser)
    add_strict(parser)
    add_out(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Learn, and print what came of it."""
    study = load_study(args)
    with open_run(args, study, "learn", raised=["learn.trajectories"]) as run:
        with shown("learn") as progress:
            from bo_sysid.learn.learn import learn

            learn(study, run, progress=progress, strict=args.strict)

        from bo_sysid.report.learning import write_learning_figures

        write_learning_figures(run)

    from bo_sysid.report.text import run_text

    print(run_text(run.folder))
    trust = " --trust-code" if study.code else ""
    folder = shlex.quote(str(run.folder))
    see = f" See the policy: bo-sysid play {folder}{trust}" if study.plant else ""
    print(f"\nFigures: {run.path('figures')}.{see}")
