"""Python in a process of its own, without the seconds that its imports take: forked from one that has made them.

Everything else is as with `subprocess`: folder, environment, streams, signals, exit code. Tests of what is imported,
and when, start a fresh Python instead.
"""

from __future__ import annotations

import atexit
import functools
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path


@functools.cache
def _server() -> socket.socket:
    ours, theirs = socket.socketpair()
    program = Path(__file__).with_name("preloaded.py")
    with theirs:
        server = subprocess.Popen([sys.executable, str(program), str(theirs.fileno())], pass_fds=[theirs.fileno()])

    def end() -> None:
        server.terminate()
        server.wait()

    atexit.register(end)
    return ours


def python(
    *words: str, cwd: Path | None = None, env: Mapping[str, str] | None = None, timeout: int = 900
) -> subprocess.CompletedProcess[str]:
    """Run ``python WORDS`` to its end: ``-m MODULE ...``, ``-c CODE ...`` or ``FILE ...``; killed after the timeout."""
    request = {
        "words": words,
        "folder": str(cwd or Path.cwd()),
        "environment": dict(os.environ if env is None else env),
        "timeout": timeout,
    }
    answer, out, err = (os.pipe() for _ in range(3))
    with tempfile.TemporaryFile("w+") as asked, open(os.devnull) as nothing:
        json.dump(request, asked)
        asked.flush()
        fds = [answer[1], asked.fileno(), nothing.fileno(), out[1], err[1]]
        socket.send_fds(_server(), [b"."], fds)
    for _, written in (answer, out, err):
        os.close(written)
    with ThreadPoolExecutor(3) as pool:
        code, *streams = pool.map(_all, (read for read, _ in (answer, out, err)))
    return subprocess.CompletedProcess([sys.executable, *words], int(code), *streams)


def _all(fd: int) -> str:
    with os.fdopen(fd) as stream:
        return stream.read()
