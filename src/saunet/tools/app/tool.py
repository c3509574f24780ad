"""`app`: drop a picture or a video into the browser, see its depth, and save the results; works offline."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saunet.errors import ConfigError, checked, in_range, positive, usable_device
from saunet.weights.locate import DEFAULT, locate, shipped

LOCAL = ("127.0.0.1", "localhost", "[::1]")
"""Host names accepted by a server for this machine only."""
_KEPT = 1800.0
"""Seconds after which uploads and results are removed."""
_POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; connect-src 'self' data: blob: ws: wss:; "
    "form-action 'self'; object-src 'none'; base-uri 'self'"
)
"""What the browser may load: only from this server, whatever a library's page requests."""


@checked
@dataclass(frozen=True, kw_only=True)
class AppOptions:
    """Options of `app`: the models it offers, and its address.

    Args:
        checkpoints: Models to choose from, besides those that come with saunet: checkpoints, exported folders or files.
        host: Address to listen on; ``0.0.0.0`` lets other machines use the page too.
        port: Port to listen on; 0 uses any free one.
        max_megabytes: Largest file that can be dropped.
        max_frames: Largest number of frames of a video to predict.
        device: Where to predict; ``auto`` uses a GPU if there is one.

    Raises:
        ConfigError: if a number is out of range.

    Examples:
        >>> saunet.AppOptions(checkpoints=("last.ckpt",)).host
        '127.0.0.1'
    """

    checkpoints: Sequence[str] = ()
    host: str = "127.0.0.1"
    port: int = 7860
    max_megabytes: int = 200
    max_frames: int = 300
    device: str = "auto"

    def __post_init__(self) -> None:
        in_range("port", self.port, 0, 65535)
        positive("max_megabytes", self.max_megabytes)
        positive("max_frames", self.max_frames)

    def models(self) -> list[str]:
        """Return the available models, the default first."""
        own = sorted(shipped(), key=lambda name: name != DEFAULT)
        return list(dict.fromkeys([*own, *self.checkpoints]))


def app(options: AppOptions) -> None:
    """Serve the page until Ctrl-C.

    Args:
        options: The models it offers, and its address.

    Raises:
        ConfigError: if Gradio is missing, the port is taken, or there is no model to choose.
        CheckpointError: if a model does not exist.

    Examples:
        >>> saunet.app(saunet.AppOptions())  # doctest: +SKIP
        saunet is at http://127.0.0.1:7860 (Ctrl-C ends)
    """
    with serving(options) as address:
        print(f"saunet is at {address} (Ctrl-C ends)", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()


@contextlib.contextmanager
def serving(options: AppOptions) -> Iterator[str]:
    """Serve the page while the block runs; yields its address. Uploads and results are removed at the end."""
    os.environ.update(GRADIO_ANALYTICS_ENABLED="False", HF_HUB_DISABLE_TELEMETRY="1")  # read when it is imported
    try:
        import gradio
        import uvicorn
        from fastapi import FastAPI
    except ImportError as missing:
        raise ConfigError("saunet app needs Gradio; run `pip install 'saunet[app]'`") from missing
    from saunet.tools.app.page import LOOK, SCRIPT, THEME, build

    usable_device(options.device)
    for model in options.models():
        if not locate(model).exists():
            raise ConfigError(f"there is no checkpoint at {model}; check the path")
    try:
        listening = socket.create_server((options.host, options.port))
    except OSError as reason:
        raise ConfigError(
            f"cannot listen on {options.host}:{options.port}: {reason.strerror or reason}; choose another port, or 0"
        ) from reason
    before = os.environ.get("GRADIO_TEMP_DIR")
    with listening, tempfile.TemporaryDirectory(prefix="saunet-app-") as folder:
        os.environ["GRADIO_TEMP_DIR"] = folder  # uploads and results
        page = build(options, Path(folder))
        served = gradio.mount_gradio_app(
            FastAPI(docs_url=None, redoc_url=None, openapi_url=None),
            page,
            path="/",
            footer_links=[],
            run_history=False,
            max_file_size=options.max_megabytes * 2**20,
            theme=THEME(),
            css=LOOK,
            head=SCRIPT,
            show_error=True,
        )
        config = uvicorn.Config(guarded(served, options.host), log_level="critical", timeout_graceful_shutdown=2)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        ended = threading.Event()
        threading.Thread(target=_clean, args=(Path(folder), ended), daemon=True).start()
        try:
            yield f"http://{options.host}:{listening.getsockname()[1]}"
        finally:
            ended.set()
            server.should_exit = True
            thread.join(10)
            if before is None:
                os.environ.pop("GRADIO_TEMP_DIR", None)
            else:
                os.environ["GRADIO_TEMP_DIR"] = before


def _clean(folder: Path, ended: threading.Event) -> None:
    while not ended.wait(60):
        remove_old(folder)


def remove_old(folder: Path) -> None:
    """Remove old uploads and results."""
    for path in folder.iterdir():
        with contextlib.suppress(OSError):
            if time.time() - path.stat().st_mtime > _KEPT:
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def guarded(served: Any, host: str) -> Any:
    """Return an ASGI application that keeps pages from loading anything else, and answers only to its own host name.

    Another site could point its host name here, and its page would then read what is served to this machine.
    """
    local = host in ("127.0.0.1", "localhost", "::1")

    async def answer(scope: Any, receive: Any, send: Any) -> None:
        async def sending(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], (b"content-security-policy", _POLICY.encode())]
            await send(message)

        name = dict(scope.get("headers") or ()).get(b"host", b"").decode("latin-1")
        if local and scope["type"] == "http" and name.rpartition(":")[0] not in LOCAL and name not in LOCAL:
            await send({"type": "http.response.start", "status": 403, "headers": []})
            await send({"type": "http.response.body", "body": b"not a name of this machine"})
            return
        await served(scope, receive, sending)

    return answer
