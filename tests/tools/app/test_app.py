"""The app: who may ask, what is limited and removed, and all of it in a browser where Gradio and one are installed."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import socket
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browsing import barriers

from saunet.errors import ConfigError
from saunet.io.video import VideoWriter
from saunet.synthetic import SyntheticDrive
from saunet.tools.app.tool import AppOptions, guarded, remove_old, serving

CONTROLS = (
    "Picture or video: drop a file", "Model", "Colors", "Camera: for points", "range slider for Field of view",
    "camera.yaml: drop a file", "Camera height, meters", "Predict again",
)  # fmt: skip
FOCUSED = """() => {
  const on = document.activeElement;
  return on.ariaLabel || on.labels?.[0]?.innerText || on.innerText;
}"""
"""What a screen reader says of the control that has the keyboard."""

with_gradio = pytest.mark.skipif(importlib.util.find_spec("gradio") is None, reason="Gradio is not installed")


def asked(name: str, listening: str = "127.0.0.1") -> tuple[int, dict[bytes, bytes]]:
    """Status and headers of an answer to a request for a host's name."""
    sent: list[dict[str, Any]] = []

    async def served(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"page"})

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    scope = {"type": "http", "headers": [(b"host", name.encode())]}
    asyncio.run(guarded(served, listening)(scope, None, send))
    return sent[0]["status"], dict(sent[0]["headers"])


def test_only_this_machine_is_answered_and_nothing_is_loaded_from_elsewhere() -> None:
    status, headers = asked("127.0.0.1:7860")
    assert status == 200
    assert b"default-src 'self'" in headers[b"content-security-policy"]
    assert asked("localhost")[0] == asked("[::1]:7860")[0] == 200
    assert asked("evil.example:7860")[0] == asked("")[0] == 403
    assert asked("lab.example:7860", listening="0.0.0.0")[0] == 200


def test_the_shipped_model_comes_first() -> None:
    assert AppOptions(checkpoints=("a.ckpt", "street")).models() == ["street", "a.ckpt"]
    with pytest.raises(ConfigError, match="port"):
        AppOptions(port=70000)


@pytest.mark.skipif(importlib.util.find_spec("gradio") is not None, reason="Gradio is installed")
def test_without_gradio_it_says_what_to_install() -> None:
    with pytest.raises(ConfigError, match=r"saunet\[app\]"), serving(AppOptions(port=0)):
        pass


@with_gradio
def test_what_cannot_be_served_is_said_at_once(tmp_path: Path) -> None:
    with (
        pytest.raises(ConfigError, match="no checkpoint"),
        serving(AppOptions(checkpoints=(str(tmp_path / "a.ckpt"),))),
    ):
        pass
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match="another port"), serving(AppOptions(port=port)):
            pass


def test_old_results_are_removed(tmp_path: Path) -> None:
    for name, age in (("old", 7200), ("new", 60)):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    remove_old(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


@with_gradio
def test_large_pictures_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from saunet.errors import DataError
    from saunet.tools.app import page

    cv2.imwrite(str(tmp_path / "x.png"), np.zeros((30, 40, 3), np.uint8))
    monkeypatch.setattr(page, "MAX_PIXELS", 1000)
    with pytest.raises(DataError, match="40x30 pixels"):
        page.answer(AppOptions(), tmp_path, tmp_path / "x.png", "street", "magma", 80.0, None, None)
    assert [path.name for path in tmp_path.iterdir()] == ["x.png"]


@with_gradio
@pytest.mark.slow  # only the session of the app installs Gradio
def test_meters_from_a_camera_file_and_a_video(tmp_path: Path) -> None:
    from saunet.tools.app.page import answer

    camera = tmp_path / "camera.yaml"
    camera.write_text("image_size: [384, 128]\nK: [223, 223, 191.5, 58.4]\ncamera_height: 1.65\n")
    drive = SyntheticDrive(seed=7, frames=3, height=128, width=384)
    with VideoWriter(tmp_path / "drive.mp4", 10.0) as video:
        for index in drive.indices:
            video.write(drive.image(index))
    given = (tmp_path / "drive.mp4", "street", "turbo", 80.0, str(camera), 0)
    hint, depth, movie, points, files = answer(AppOptions(device="cpu"), tmp_path, *given)
    assert not hint["visible"]
    assert "camera height 1.65 m" in depth["value"]
    assert movie["value"].endswith("_disparity.mp4")
    assert "iframe" in points["value"]
    assert {Path(each).suffix for each in files["value"]} == {".mp4", ".html"}


@with_gradio
@pytest.mark.slow  # only the session of the app installs Gradio
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_drop_a_picture_in_a_browser(browser: Any, tmp_path: Path, scheme: str) -> None:
    cv2.imwrite(str(tmp_path / "road.png"), np.random.default_rng(0).integers(0, 255, (96, 320, 3), dtype=np.uint8))
    requests: list[str] = []
    with serving(AppOptions(port=0, device="cpu")) as address:
        page = browser.new_page()
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": 1300, "height": 900})
        page.on("request", lambda request: requests.append(request.url))
        page.goto(address)
        page.get_by_role("button", name="Predict again").wait_for()
        reached = [page.evaluate(FOCUSED, page.keyboard.press("Tab")) for _ in range(10)]
        for name in CONTROLS:
            assert any(each.startswith(name) for each in reached), reached
        assert barriers(page, [scheme]) == []
        page.locator("input[type=file]").first.set_input_files(str(tmp_path / "road.png"))
        depth = page.frame_locator("iframe[title^=depth]").locator("#depth")
        depth.wait_for()
        assert float(depth.inner_text()) > 0  # relative: without a unit
        page.frame_locator("iframe[title^=points]").locator('body[data-frame="0"]').wait_for()
        for ending in ("disparity.png", "depth.png", "depth.npy", "points.ply", "points.html"):
            assert page.get_by_text(ending).count() or page.get_by_text(ending.rpartition(".")[0]).count()
        assert barriers(page, [scheme]) == []
        folder = Path(os.environ["GRADIO_TEMP_DIR"])
        assert list(folder.iterdir())
    assert not folder.exists()
    assert all(url.startswith((address, "data:", "blob:", "about:")) for url in requests)
