"""`bo-sysid reveal`: diagnose concealed cases, open the seals, score."""

import argparse
from pathlib import Path

from bo_sysid.cli.common import Verbs
from bo_sysid.cli.progress import shown


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "reveal",
        help="diagnose concealed cases, open their seals, and score",
        description="Diagnose the cases of bo-sysid conceal that have no answer yet, freeze the "
        "answers, check every hash, open the seals, and score. Answers that come after the seals "
        "were opened do not count. An interrupted run goes on with the same command.",
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="the run folder of conceal")
    parser.add_argument(
        "--seals",
        type=Path,
        metavar="FOLDER",
        help="where the answers are kept; <RUN>-sealed otherwise",
    )
    parser.add_argument(
        "--published", metavar="SHA256", help="the hash that conceal printed, to be compared"
    )
    parser.add_argument(
        "--first",
        type=int,
        metavar="N",
        help="only the first N cases, in their random order; others stay sealed for a later call",
    )
    parser.add_argument(
        "--answers-only",
        action="store_true",
        help="diagnose and freeze the answers; open nothing",
    )
    parser.add_argument(
        "--threads", type=int, metavar="N", help="number of processes; one a core otherwise"
    )
    parser.add_argument(
        "--engine",
        default="local",
        help="local, processes of this machine; or ray, a cluster whose machines all see RUN",
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=3600.0,
        metavar="SECONDS",
        help="longest time for one case, which then counts as unanswered (default: %(default)g)",
    )
    parser.add_argument("--address", help="of the Ray cluster; auto finds a running one")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Answer and reveal, and print the rates."""
    from bo_sysid.execution import open_engine, use_threads
    from bo_sysid.proof.answer import answer, frozen_digest
    from bo_sysid.proof.conceal import concealed_run
    from bo_sysid.proof.proof import PAGE, prove
    from bo_sysid.proof.reveal import require_published

    with (
        use_threads(args.threads),
        concealed_run(args.folder) as opened,
        shown("reveal") as progress,
    ):
        engine = open_engine(args.engine, args.address)
        if args.answers_only:
            require_published(opened.folder, args.published)
            answer(opened, first=args.first, engine=engine, limit=args.limit, progress=progress)
            which = "every case" if args.first is None else f"each of the first {args.first}"
            print(f"{args.folder}: {which} has an answer, frozen; no seal was opened.")
            frozen = frozen_digest(args.folder, args.first)
            print(f"Publish: SHA-256 of the frozen answers is {frozen}")
            return
        scores = prove(
            opened,
            first=args.first,
            seals=args.seals,
            published=args.published,
            engine=engine,
            limit=args.limit,
            progress=progress,
        )
    for what, count, of in scores.summary[["what", "count", "of"]].to_numpy():
        if of:
            print(f"{count:5d} of {of:<5d} {what}")
    print(f"{args.folder / PAGE}: all scores")
