"""The command line: the only place that prints.

One module a verb, each with `add_parser` and `run`. They import what they need when they run, so
that ``--help`` and errors of input answer at once.
"""

import argparse
import io
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from typing import NoReturn

from bo_sysid import __version__
from bo_sysid.cli import (
    check,
    compare,
    conceal,
    demo,
    diagnose,
    effects,
    excite,
    identify,
    init,
    learn,
    play,
    record,
    report,
    reveal,
    schema,
)
from bo_sysid.errors import BoSysidError, UserError, is_input_error, is_interrupt

VERBS = (
    init,
    check,
    excite,
    identify,
    diagnose,
    learn,
    play,
    compare,
    record,
    report,
    conceal,
    reveal,
    effects,
    schema,
    demo,
)
"""The verbs, in the order of the help."""

RESUMED = ("identify", "diagnose", "learn", "compare", "record", "conceal", "reveal")
"""Verbs that go on where they were interrupted."""

DONE, DEFECT, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


class _Parser(argparse.ArgumentParser):
    """Reports wrong arguments like any other wrong input."""

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message} ({self.prog} --help)")


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of all verbs."""
    parser = _Parser(
        prog="bo-sysid",
        description="Find where a MuJoCo simulation and a real machine disagree, and repair the "
        "model.",
        epilog="Exit code: 0 done, 2 the study, model or recording is wrong, 130 interrupted "
        "(Ctrl-C, SIGTERM), 1 anything else.",
    )
    parser.add_argument("--version", action="version", version=f"bo-sysid {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for verb in VERBS:
        verb.add_parser(verbs)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Args:
        argv: the arguments; those of the process where left out.

    Returns:
        The exit code: 0 done; 2 the input is wrong, with one message; 130 interrupted, by Ctrl-C or
        by a SIGTERM to the process; 1 anything else, with a traceback where it is a defect.
    """
    # nothing is rendered unless a command asks for it, and dm_control warns without this
    os.environ.setdefault("MUJOCO_GL", "disable")
    if argv is None:  # a whole process: a scheduler that ends it is told what Ctrl-C is told
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # not in a notebook
            stream.reconfigure(errors="replace")  # names may hold any letter
    args = None
    try:
        args = make_parser().parse_args(argv)
        args.given = list(sys.argv[1:] if argv is None else argv)
        args.run(args)
        sys.stdout.flush()
    except SystemExit as end:  # --help and --version
        return int(end.code or DONE)
    except UserError as error:
        return _say(str(error), WRONG_INPUT)
    except BoSysidError as error:  # a job failed
        return _say(str(error), DEFECT)
    except BrokenPipeError:  # whoever read the output has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as error:  # a missing file, no permission, a full disk
        where = f"{error.filename}: " if error.filename else ""
        code = WRONG_INPUT if is_input_error(error) else DEFECT
        return _say(f"{where}{error.strerror or error}", code)
    except KeyboardInterrupt:
        return _interrupted(args)
    except MemoryError as error:
        return _say(f"there is not enough memory for this: {error}", WRONG_INPUT)
    except Exception as error:
        if is_interrupt(error):
            return _interrupted(args)
        traceback.print_exc()
        return _say("this is a defect of bo-sysid: please report the lines above", DEFECT)
    return DONE


def _interrupted(args: argparse.Namespace | None) -> int:
    goes_on = args is not None and args.verb in RESUMED
    how = "; run the same command again to resume" if goes_on else ""
    return _say(f"interrupted{how}", INTERRUPTED)


def _say(message: str, code: int) -> int:
    print(f"bo-sysid: {message}", file=sys.stderr)
    return code
