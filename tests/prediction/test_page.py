"""What a prediction shows of itself: a figure in a notebook, a page with the depth under the cursor, points."""

from __future__ import annotations

import base64
import json
import re
import webbrowser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import barriers

from saunet.errors import ConfigError
from saunet.prediction.page import depth_page
from saunet.prediction.prediction import Prediction
from saunet.runs.record import Scale


def ramp(scale: Scale | None = None, width: int = 40) -> Prediction:
    """Depth from 2 on the left to 20 on the right."""
    depth = np.repeat(np.linspace(2, 20, width, dtype=np.float32)[None], 30, axis=0)
    return Prediction(depth, 1 / depth, np.full((30, width, 3), 90, np.uint8), scale, "drives/<road>.png")


def test_a_notebook_shows_picture_beside_depth_with_unit_and_range() -> None:
    text = ramp(Scale(1.0, "camera height 1.65 m"))._repr_html_()
    assert text.count("data:image/jpeg;base64,") == 2
    assert "&lt;road&gt;.png: depth 2 to 20, meters (scale from camera height 1.65 m)" in text
    assert "relative" in ramp()._repr_html_()
    assert ramp()._repr_png_().startswith(b"\x89PNG")


def test_the_page_holds_depth_and_fetches_nothing(tmp_path: Path) -> None:
    ramp().save(tmp_path / "x.html")
    text = (tmp_path / "x.html").read_text()
    assert not re.search(r"https?://|@import|url\(|<road>", text)
    data = json.loads(re.findall(r'type="application/json">(.*?)</script>', text)[0])
    levels = np.frombuffer(base64.b64decode(data["disparity"]), "<u2").reshape(30, 40)
    disparity = data["low"] + (levels.astype(float) - 1) / 65534 * (data["high"] - data["low"])
    assert np.allclose(1 / disparity, ramp().depth, rtol=1e-3)
    assert data["size"] == data["shown"] == [40, 30]


def test_a_wide_prediction_is_shown_smaller() -> None:
    data = json.loads(re.findall(r'type="application/json">(.*?)</script>', depth_page(ramp(width=2560)))[0])
    assert (data["size"], data["shown"]) == ([2560, 30], [1280, 15])


def test_points_from_a_field_of_view_numbers_or_a_file(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text("image_size: [400, 30]\nK: [200, 200, 199.5, 14.5]\n")
    wide, file = ramp(width=400), tmp_path / "camera.yaml"
    clouds = [wide.point_cloud(camera) for camera in (90, [200, 200, 199.5, 14.5], file)]
    for cloud in clouds:
        assert np.allclose(cloud.points, clouds[0].points)
    near = wide.point_cloud(90, max_depth=5.0).points
    assert 0 < len(near) < len(clouds[0].points)
    assert np.allclose(near[0] / near[0, 2], [-199.5 / 200, -14.5 / 200, 1], atol=0.02)
    with pytest.raises(ConfigError, match="field of view"):
        ramp().point_cloud(200)


def test_outside_of_a_notebook_the_browser_opens(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(opened.append(address)))
    monkeypatch.setattr("tempfile.mkdtemp", lambda prefix: str(tmp_path))
    ramp().show()
    assert opened == [(tmp_path / "shown.html").as_uri()]
    assert (tmp_path / "shown.html").read_text() == depth_page(ramp())


@pytest.mark.slow  # fast, but only the session of the slow tests installs playwright
def test_the_depth_under_the_cursor_in_a_browser(browser: Any, tmp_path: Path) -> None:
    ramp(Scale(1.0, "speed"), width=400).save(tmp_path / "x.html")
    page = browser.new_page()
    page.goto((tmp_path / "x.html").as_uri())
    view = page.locator("#color")
    box = view.bounding_box()
    for part, depth in ((0.25, 6.5), (0.75, 15.5)):
        page.mouse.move(box["x"] + part * box["width"], box["y"] + box["height"] / 2)
        shown = page.locator("#depth").inner_text()
        assert shown.endswith(" m")
        assert float(shown[:-2]) == pytest.approx(depth, abs=0.1)
    before = shown
    page.locator("#pair").focus()
    page.keyboard.press("ArrowLeft")
    assert float(page.locator("#depth").inner_text()[:-2]) < float(before[:-2])
    assert barriers(page) == []
