"""The page of a run that is going on, served to this machine alone."""

import hashlib
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

from bo_sysid.errors import RunError, UserError
from bo_sysid.report.page import NAME, page

HOST = "127.0.0.1"
_OF_A_RUN = (".json", ".parquet", ".npz")
_LARGEST = 65535  # number of a port


def make_server(folder: Path, port: int = 0) -> ThreadingHTTPServer:
    """Return a server of the page of a run, made anew for each visit.

    Args:
        folder: the run folder.
        port: 0 for any that is free.

    Raises:
        RunError: the folder is no run.
        UserError: the number is none of a port, or the port is taken or not to be had.
    """
    if not 0 <= port <= _LARGEST:
        raise UserError(f"--port {port}: must be from 0 (any that is free) to {_LARGEST}")
    page(folder)  # tells at once what is wrong with the folder

    try:
        return ThreadingHTTPServer((HOST, port), _answering(folder))
    except OSError as error:
        raise UserError(
            f"--port {port}: {error.strerror or error}; name another one, or 0 for any that is free"
        ) from None


def _answering(folder: Path) -> type[BaseHTTPRequestHandler]:
    """Return the handler that answers with what is in a folder."""

    class Handler(BaseHTTPRequestHandler):
        """Answers with the page, with its version, or with a file that the page links to."""

        def do_GET(self) -> None:
            wanted = unquote(self.path.split("?")[0]).lstrip("/")
            try:
                if not self._asked_here():
                    self.send_error(HTTPStatus.FORBIDDEN, "This machine alone is answered")
                elif wanted in ("", NAME):
                    self._send("text/html; charset=utf-8", page(folder, live=True).encode())
                elif wanted == "version":
                    self._send("text/plain", version(folder).encode())
                elif wanted in {p.name for p in folder.iterdir() if p.is_file()}:
                    self._send("application/octet-stream", (folder / wanted).read_bytes())
                else:
                    self.send_error(HTTPStatus.NOT_FOUND)
            except ConnectionError:  # the page was closed
                return
            except (RunError, OSError) as error:
                self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, explain=str(error))

        def _asked_here(self) -> bool:
            """Whether this machine is asked by its own name; a page of another may lead here.

            The port may be another one, of a tunnel.
            """
            try:
                asked = urlsplit(f"//{self.headers.get('Host', '')}").hostname
            except ValueError:  # not a name of any machine
                return False
            return asked in (HOST, "localhost")

        def log_message(self, *_: object) -> None:
            """Keep the terminal free."""

        def _send(self, kind: str, content: bytes) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(content)

    return Handler


def version(folder: Path) -> str:
    """Return a hash that changes when a file of the run does, at whatever depth.

    One that goes while it is looked at, as what is kept for a run that is killed does, has changed.
    """
    state = []
    for path in sorted(p for p in folder.rglob("*") if p.suffix in _OF_A_RUN):
        try:
            found = path.stat()
        except FileNotFoundError:
            continue
        state.append((str(path.relative_to(folder)), found.st_mtime_ns, found.st_size))
    return hashlib.sha256(repr(state).encode()).hexdigest()[:16]
