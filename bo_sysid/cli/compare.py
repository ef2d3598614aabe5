"""`bo-sysid compare`: arms against each other, with paired seeds."""

import argparse

from bo_sysid.cli.common import Verbs, add_out, add_strict, add_study, load_study, open_run
from bo_sysid.cli.progress import shown


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "compare",
        help="compare ways of searching, with paired seeds",
        description="Run every arm of a study's key compare on every problem and seed, and tell "
        "what each needs to reach given regrets, with intervals and paired tests. --threads is the "
        "number of processes; execution: {engine: ray} runs them on a cluster. An interrupted "
        "comparison goes on with the same command, a finished one with more seeds "
        "(--set compare.seeds=60).",
    )
    add_study(parser)
    add_strict(parser)
    add_out(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Compare, and print what came of it."""
    study = load_study(args)
    with open_run(args, study, "compare", raised=["compare.seeds"]) as run:
        with shown("compare") as progress:
            from bo_sysid.compare.compare import compare

            compare(study, run, progress=progress, trust_code=args.trust_code, strict=args.strict)

        from bo_sysid.report.comparison import write_comparison_figures

        write_comparison_figures(run)

    from bo_sysid.report.text import run_text

    print(run_text(run.folder))
    print(f"\nFigures: {run.path('figures')}; tables: {run.folder}/*.parquet")
