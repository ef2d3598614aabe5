"""What the verbs share: arguments, the study, the run folder."""

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bo_sysid.runs import Run
    from bo_sysid.study import Study

Verbs = argparse._SubParsersAction  # what add_subparsers returns; it has no public name
RUNS = Path("runs")


def add_study(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a verb that reads a study."""
    parser.add_argument("study", type=Path, metavar="STUDY", help="the study file (YAML)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="replace a value of the study, as in --set search.budget=20",
    )
    parser.add_argument("--seed", type=int, metavar="N", help="short for --set search.seed=N")
    parser.add_argument(
        "--threads", type=int, metavar="N", help="number of threads; all cores otherwise"
    )
    parser.add_argument(
        "--trust-code",
        action="store_true",
        help="run the Python files that the study names",
    )


def add_strict(parser: argparse.ArgumentParser) -> None:
    """Add the argument of a verb that reads recordings."""
    parser.add_argument(
        "--strict",
        action="store_true",
        help="refuse recordings with gaps, jitter, duplicate stamps or outliers",
    )


def add_out(
    parser: argparse.ArgumentParser, otherwise: str = "runs/<study>-<verb> otherwise"
) -> None:
    """Add the argument of a verb that writes a run folder."""
    parser.add_argument(
        "--out", type=Path, metavar="RUN", help=f"folder of the results; {otherwise}"
    )


def load_study(args: argparse.Namespace) -> "Study":
    """Return the study that the arguments name, with what they replace in it.

    Raises:
        StudyError: it is wrong, or names something that is not registered.
    """
    from bo_sysid.cli.names import check_names
    from bo_sysid.study import Study, parse_override

    overrides = dict(parse_override(text) for text in args.set)
    if args.seed is not None:
        overrides["search.seed"] = args.seed
    study = Study.load(args.study, overrides, trust_code=args.trust_code)
    check_names(study)
    return study


def run_folder(args: argparse.Namespace, verb: str) -> Path:
    """Return the folder that a verb writes to."""
    return args.out or RUNS / f"{args.study.stem}-{verb}"


@contextlib.contextmanager
def open_run(
    args: argparse.Namespace, study: "Study", verb: str, *, raised: Sequence[str] = ()
) -> Iterator["Run"]:
    """Yield the run folder of a verb, and use as many threads as the arguments say.

    Args:
        args: of the command line.
        study: that they name.
        verb: the command.
        raised: keys that may be larger than in the folder; see `Run.open`.
    """
    from bo_sysid.execution import use_threads
    from bo_sysid.runs import Run

    folder = run_folder(args, verb)
    with use_threads(args.threads):
        seed = study.search.seed
        told, said = study.resolved(relative_to=folder), arguments(args)
        with Run.open(folder, told, verb, seed=seed, arguments=said, raised=raised) as run:
            yield run


def arguments(args: argparse.Namespace) -> list[str]:
    """Return the command line as it was given, less where it writes to."""
    said: list[str] = []
    given = iter(getattr(args, "given", ()))
    for word in given:
        name, equals, _ = word.partition("=")
        if len(name) > 2 and "--out".startswith(name):  # argparse takes what is short of it, too
            if not equals:
                next(given, None)
        else:
            said.append(word)
    return said
