"""`bo-sysid report`: what a run found, as text and as one page."""

import argparse
import contextlib
from importlib.util import find_spec
from pathlib import Path

from bo_sysid.cli.common import Verbs

_NEEDS = ("jinja2", "plotly")
_HINT = "pip install 'bo-sysid[report]'"


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "report",
        help="print what a run found, and write it as one HTML page",
        description="Print what a run found, and write one self-contained HTML page of it. A run "
        "that is unfinished says how far it came; what is damaged is named, the rest is shown.",
    )
    parser.add_argument("folder", type=Path, metavar="RUN", help="the run folder")
    parser.add_argument("--text", action="store_true", help="print only, write no page")
    parser.add_argument(
        "--serve",
        action="store_true",
        help="serve the page to this machine, where it follows a run that is going on",
    )
    parser.add_argument(
        "--port", type=int, default=8765, metavar="N", help="of --serve; default: %(default)s"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Print what a run found and write its page, or serve the page."""
    if args.serve:
        _serve(args.folder, args.port)
        return
    path = None if args.text else page_of(args.folder)

    from bo_sysid.errors import RunError
    from bo_sysid.report.text import run_text

    try:
        print(run_text(args.folder))
    except RunError:
        if path is not None:  # it has the rest
            print(f"Page: {path}")
        raise
    if path is not None:
        print(f"\nPage: {path}")
    elif not args.text:
        print(f"\nFor one HTML page of it: {_HINT}")


def page_of(folder: Path) -> Path | None:
    """Write the page of a run and return where it is; None where it cannot be made here."""
    if not _able():
        return None

    from bo_sysid.report.page import write_page

    return write_page(folder)


def _serve(folder: Path, port: int) -> None:
    from bo_sysid.errors import UserError

    if not _able():
        raise UserError(f"--serve needs {' and '.join(_NEEDS)}: {_HINT}")

    from bo_sysid.report.serve import HOST, make_server

    with make_server(folder, port) as server:
        print(f"http://{HOST}:{server.server_port} (Ctrl-C ends)")
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


def _able() -> bool:
    return all(find_spec(name) is not None for name in _NEEDS)
