"""``ddiffpg watch FOLDER``: the page on a run in progress, for this machine alone. Needs the extra ``plots``."""

import argparse
import errno
import gzip
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from sb3_ddiffpg.utils.versions import versions
from sb3_ddiffpg.visualization.page import render
from sb3_ddiffpg.visualization.runs import read_runs

#: Where it is served unless ``--port`` says otherwise
PORT = 8321
_LOOPBACK = "127.0.0.1"


class Watcher(ThreadingHTTPServer):
    """
    Serves the page on the loopback address alone. It reads, and writes nothing; two addresses are known, ``/`` and ``/now``
    (the same without the plotting library), and neither names a file.

    :param folder: Of a run, or of several
    :param port: 0: any that is free
    :raises OSError: If the port is in use
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, folder: Path, port: int = PORT) -> None:
        super().__init__((_LOOPBACK, port), _Handler)
        self.folder = folder
        self.made_with = ", ".join(f"{name} {number}" for name, number in versions().items())

    @property
    def address(self) -> str:
        """Of the page."""
        return f"http://{_LOOPBACK}:{self.server_port}/"

    def page(self, whole: bool) -> bytes:
        """
        :param whole: Whether with the plotting library
        :return: The page as of now
        """
        title = f"Runs in {self.folder.resolve().name}"
        return render(title, read_runs(self.folder), self.made_with, live=True, whole=whole).encode()


class _Handler(BaseHTTPRequestHandler):
    server: Watcher
    server_version, sys_version = "ddiffpg", ""
    timeout = 30

    def do_GET(self) -> None:
        self._answer()

    def do_HEAD(self) -> None:
        self._answer()

    def _answer(self) -> None:
        # A name that somebody makes point here (DNS rebinding) would let a stranger's page read this one
        if self.headers.get("Host") not in {f"{name}:{self.server.server_port}" for name in (_LOOPBACK, "localhost")}:
            self._send(403, b"this page is for 127.0.0.1 alone\n", "text/plain; charset=utf-8")
        elif self.path in ("/", "/now"):
            self._send(200, self.server.page(whole=self.path == "/"), "text/html; charset=utf-8")
        else:
            self._send(404, b"accepted is /\n", "text/plain; charset=utf-8")

    def _send(self, status: int, body: bytes, kind: str) -> None:
        packed = "gzip" in self.headers.get("Accept-Encoding", "")
        body = gzip.compress(body, 1) if packed else body
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(body))),
            *([("Content-Encoding", "gzip")] if packed else []),
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
        ):
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: a line every few seconds would tell nobody anything."""


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Command line, without the name of the program; that of the process when None
    :raises SystemExit: If there is no such folder, or the port is in use
    """
    parser = argparse.ArgumentParser(
        prog="ddiffpg watch",
        description="Shows runs in progress on a page, for this machine alone: modes born and lost, success, coverage.",
    )
    parser.add_argument("folder", metavar="LOGDIR", type=Path, help="of a run, or of several, at any depth")
    parser.add_argument("--port", type=int, default=PORT, help=f"{PORT} if left out; 0: any that is free")
    given = parser.parse_args(arguments)
    if not given.folder.is_dir():
        raise SystemExit(f"LOGDIR: {str(given.folder)!r} given, which is no folder")
    if not 0 <= given.port < 65536:
        raise SystemExit(f"--port: {given.port} given; accepted are 0 to 65535")
    try:
        server = Watcher(given.folder, given.port)
    except OSError as error:
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise
        raise SystemExit(f"--port: {given.port} given, which cannot be had ({error.strerror}); --port 0 takes any") from None
    with server:
        print(f"{given.folder} on {server.address} (Ctrl-C ends)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
