"""A process that has imported what the tools need, and forks: ``python preloaded.py FD``, started by `processes`.

Only forks leave `serve`, with the words of a Python command line, and end as any Python process does.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import runpy
import signal
import socket
import sys
from typing import Any

MODULES = (
    "saunet.cli.app",
    "saunet.cli.compose",
    "saunet.cli.help",
    "saunet.evaluation.tool",
    "saunet.exporting.tool",
    "saunet.prediction.tool",
    "saunet.synthetic",
    "saunet.training.tool",
)


def serve(asked: socket.socket) -> list[str]:
    """Answer each request by a fork; return in the fork, with the words of its command line."""
    signal.signal(signal.SIGCHLD, lambda *_: _reap())
    while True:
        word, fds, *_ = socket.recv_fds(asked, 1, 5)
        if not word:  # the tests have ended
            os._exit(0)
        if os.fork() == 0:
            break
        for fd in fds:
            os.close(fd)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    asked.close()
    answer, request, *streams = fds
    with os.fdopen(request) as file:
        file.seek(0)
        wanted: dict[str, Any] = json.load(file)
    pid = os.fork()
    if pid:  # this one waits, so that each request has somebody who knows how it ended
        for fd in streams:
            os.close(fd)
        signal.signal(signal.SIGALRM, lambda *_: os.kill(pid, signal.SIGKILL))
        signal.alarm(wanted["timeout"])
        os.write(answer, str(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])).encode())
        os._exit(0)
    for fd, stream in enumerate(streams):
        os.dup2(stream, fd)
    for fd in (answer, *streams):
        os.close(fd)
    os.environ.clear()
    os.environ.update(wanted["environment"])
    os.chdir(wanted["folder"])
    words: list[str] = wanted["words"]
    return words


def _reap() -> None:
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        pass


def become(words: list[str]) -> None:
    """Do what ``python WORDS`` does: ``-m MODULE``, ``-c CODE``, or a program's file, with its arguments."""
    kind, *rest = words
    if kind == "-m":
        sys.argv, sys.path[0] = rest, os.getcwd()
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    elif kind == "-c":
        sys.argv, sys.path[0] = ["-c", *rest[1:]], ""
        exec(compile(rest[0], "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.argv, sys.path[0] = words, os.path.dirname(kind)
        runpy.run_path(kind, run_name="__main__")


if __name__ == "__main__":
    for module in MODULES:
        importlib.import_module(module)
    gc.freeze()  # forks share what is there
    become(serve(socket.socket(fileno=int(sys.argv[1]))))
