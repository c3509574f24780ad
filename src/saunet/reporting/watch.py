"""`watch`: the page of a run or a sweep, served on this machine and updated while it is open."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from saunet.errors import ConfigError, SaunetError, checked, in_range, positive
from saunet.reporting.page import Document, as_html
from saunet.reporting.run import page_of

LOCAL = ("127.0.0.1", "localhost", "::1")
"""Addresses of a server for this machine only."""
_FRESH = 60.0
"""Seconds after which a page is made again even if no file has changed: a killed run writes nothing."""


@checked
@dataclass(frozen=True, kw_only=True)
class WatchOptions:
    """Options of `watch`: the run to show, and the address.

    Args:
        run: The folder of a run or a sweep, or a folder with several.
        host: Address to listen on; ``0.0.0.0`` lets other machines see the page too.
        port: Port to listen on; 0 uses any free one.
        every: Seconds between checks of the folder.

    Raises:
        ConfigError: if the port or the time is out of range.

    Examples:
        >>> saunet.WatchOptions(run="outputs/train").host
        '127.0.0.1'
    """

    run: str | Path
    host: str = "127.0.0.1"
    port: int = 6007
    every: float | int = 5.0

    def __post_init__(self) -> None:
        in_range("port", self.port, 0, 65535)
        positive("every", self.every)


def watch(options: WatchOptions) -> None:
    """Serve the page of a run or a sweep until Ctrl-C: current curves, pictures, health and data.

    Args:
        options: The run to show, and the address.

    Raises:
        ConfigError: if the port is taken.
        DataError: if there is no run.

    Examples:
        >>> saunet.watch(saunet.WatchOptions(run="outputs/train"))  # doctest: +SKIP
        watching outputs/train on http://127.0.0.1:6007 (Ctrl-C ends)
    """
    with serving(options) as address:
        print(f"watching {options.run} on {address} (Ctrl-C ends)", flush=True)
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            return


@contextmanager
def serving(options: WatchOptions) -> Iterator[str]:
    """Serve the page while the block runs; yields its address."""
    pages = _Pages(options)
    pages.current()  # report what cannot be read now
    local = options.host in LOCAL

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            name = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
            if local and name.strip("[]") not in LOCAL:  # the page of another site whose host name points here
                self.send_error(403)
            elif self.path != "/":
                self.send_error(404)
            else:
                self._answer(pages.current())

        def _answer(self, text: bytes) -> None:
            tag = f'"{hashlib.sha256(text).hexdigest()[:16]}"'
            same = self.headers.get("If-None-Match") == tag
            self.send_response(304 if same else 200)
            self.send_header("ETag", tag)
            self.send_header("Cache-Control", "no-cache")
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(0 if same else len(text)))
            self.end_headers()
            if not same:
                self.wfile.write(text)

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing: requests come every few seconds."""

    try:
        server = ThreadingHTTPServer((options.host, options.port), Handler)
    except OSError as reason:
        raise ConfigError(
            f"cannot listen on {options.host}:{options.port}: {reason.strerror or reason}; choose another port, or 0"
        ) from reason
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://{options.host}:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


class _Pages:
    """The current page, made again only when a file has changed or some time has passed."""

    def __init__(self, options: WatchOptions) -> None:
        self._path, self._every, self._lock = Path(options.run), float(options.every), threading.Lock()
        self._state, self._made, self._text = "", 0.0, b""

    def current(self) -> bytes:
        with self._lock:
            state = _state(self._path)
            if state != self._state or time.monotonic() - self._made > _FRESH:
                try:
                    document = page_of(self._path)
                except SaunetError as error:
                    if not self._text:
                        raise
                    document = Document("Nothing to see", (str(error),), (), ())
                self._text = as_html(document, live=self._every).encode()
                self._state, self._made = state, time.monotonic()
            return self._text


def _state(path: Path) -> str:
    """Return a text that changes whenever a file of a displayed run does."""
    found = hashlib.sha256()
    for pattern in ("**/run.json", "**/metrics.csv", "**/metrics.json", "**/pictures/*.png", "**/sweep.json"):
        for file in sorted(path.glob(pattern)):
            try:
                stat = file.stat()
            except OSError:  # just replaced
                continue
            found.update(f"{file}{stat.st_mtime_ns}{stat.st_size}".encode())
    return found.hexdigest()
