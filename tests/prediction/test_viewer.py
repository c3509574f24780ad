"""The page holds the clip, fetches nothing, and works in a browser where one is installed."""

from __future__ import annotations

import base64
import itertools
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browsing import barriers

from saunet.errors import ConfigError, DataError
from saunet.prediction.pointcloud import Camera, ViewerWriter
from saunet.prediction.prediction import Prediction
from saunet.runs.record import Scale

CAMERA = Camera.from_numbers((120.0, 120.0, 79.5, 29.5), 60, 160)


def write_viewer(path: Path, predictions: Iterable[Prediction], camera: Camera, **more: Any) -> int:
    with ViewerWriter(path, camera, **more) as writer:
        for prediction in predictions:
            writer.add(prediction)
    return writer.count


def clip(count: int = 3) -> Iterator[Prediction]:
    """A wall that comes nearer, with a post in front of it."""
    for index in range(count):
        depth = np.full((60, 160), 20.0 - 2 * index, np.float32)
        depth[:, 70:80] = 8.0
        image = np.zeros((60, 160, 3), np.uint8)
        image[:, :, 0] = 60 * (index + 1)
        image[:, 70:80] = (0, 220, 0)
        yield Prediction(depth, 1 / depth, image, Scale(1.0, "construction"))


def content(path: Path) -> dict[str, Any]:
    """What the page says of the clip, and its frames, each in an element of its own."""
    text = path.read_text()
    (head,) = re.findall(r'<script id="clip" type="application/json">(.*?)</script>', text)
    frames = re.findall(r'<script class="frame" type="application/json">(.*?)</script>', text)
    return {**json.loads(head), "frames": [json.loads(frame) for frame in frames]}


def test_points_survive(tmp_path: Path) -> None:
    assert write_viewer(tmp_path / "x.html", clip(), CAMERA, width=80, edge=0.0, fps=5.0) == 3
    data = content(tmp_path / "x.html")
    assert (data["width"], data["height"], data["fps"]) == (80, 30, 5.0)
    assert data["unit"] == "meters (scale from construction)"
    assert data["intrinsics"] == pytest.approx([60, 60, 39.5, 14.5])
    for index, frame in enumerate(data["frames"]):
        levels = np.frombuffer(base64.b64decode(frame["disparity"]), "<u2").reshape(30, 80)
        disparity = frame["low"] + (levels.astype(float) - 1) / 65534 * (frame["high"] - frame["low"])
        assert disparity[15, 10] == pytest.approx(1 / (20 - 2 * index), rel=1e-4)
        assert disparity[15, 37] == pytest.approx(1 / 8, rel=1e-4)
        image = cv2.imdecode(np.frombuffer(base64.b64decode(frame["image"]), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (30, 80, 3)
        assert abs(int(image[15, 10, 2]) - 60 * (index + 1)) < 12


def test_far_points_and_the_ramps_of_edges_are_left_out(tmp_path: Path) -> None:
    def shown(prediction: Prediction, **more: Any) -> list[int]:
        write_viewer(tmp_path / "x.html", [prediction], CAMERA, width=160, **more)
        levels = np.frombuffer(base64.b64decode(content(tmp_path / "x.html")["frames"][0]["disparity"]), "<u2")
        return np.flatnonzero(levels.reshape(60, 160)[30]).tolist()

    (sharp,) = clip(1)
    assert shown(sharp, max_depth=10.0) == list(range(70, 80))
    disparity = sharp.disparity.copy()
    disparity[:, 69] = disparity[:, 80] = 1 / 12
    ramped = Prediction(1 / disparity, disparity, sharp.image, sharp.scale)
    assert shown(ramped) == [*range(69), *range(70, 80), *range(81, 160)]
    assert shown(ramped, edge=0.0) == list(range(160))


def test_page_fetches_nothing_and_a_title_cannot_break_it(tmp_path: Path) -> None:
    write_viewer(tmp_path / "x.html", clip(1), CAMERA, title="</script><b>x")
    text = (tmp_path / "x.html").read_text()
    assert not re.search(r"https?://|src=|@import|url\(", text)
    assert "default-src 'none'" in text
    assert content(tmp_path / "x.html")["title"] == "</script><b>x"


def test_no_text_in_the_page_grows_with_the_clip(tmp_path: Path) -> None:
    """Browsers limit the length of one text: half a gigabyte of JSON in one piece left the page blank."""
    longest = []
    for count in (1, 30):
        write_viewer(tmp_path / "x.html", itertools.islice(itertools.cycle(clip(1)), count), CAMERA, width=160)
        scripts = re.findall(r"<script[^>]*>(.*?)</script>", (tmp_path / "x.html").read_text(), re.DOTALL)
        longest.append(max(map(len, scripts)))
    assert longest[0] == longest[1]


def test_constant_depth(tmp_path: Path) -> None:
    depth = np.full((8, 8), 5.0, np.float32)
    write_viewer(tmp_path / "x.html", [Prediction(depth, 1 / depth, np.zeros((8, 8, 3), np.uint8))], CAMERA, width=8)
    frame = content(tmp_path / "x.html")["frames"][0]
    assert frame["low"] == frame["high"] == pytest.approx(0.2)


def test_refused_and_nothing_left(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"must end in \.html"):
        write_viewer(tmp_path / "x.htm1", clip(), CAMERA)
    with pytest.raises(DataError, match="no frame was given"):
        write_viewer(tmp_path / "x.html", [], CAMERA)
    with pytest.raises(ConfigError, match="width is 0"):
        write_viewer(tmp_path / "x.html", clip(), CAMERA, width=0)

    def broken() -> Iterator[Prediction]:
        yield from clip(1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_viewer(tmp_path / "x.html", broken(), CAMERA)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow  # fast, but only the session of the slow tests installs playwright
def test_orbit_scrub_and_play_in_a_browser(browser: Any, tmp_path: Path) -> None:
    write_viewer(tmp_path / "x.html", clip(), CAMERA, width=160)
    page = browser.new_page()
    problems: list[str] = []
    requests: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda message: problems.append(message.text))
    page.on("request", lambda request: requests.append(request.url))
    page.goto((tmp_path / "x.html").as_uri())

    def picture() -> Any:
        data = np.frombuffer(page.screenshot(), np.uint8)
        return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)[80:340, :560].astype(int)

    def green_columns(shot: Any) -> Any:
        return np.flatnonzero(((shot[:, :, 1] > 150) & (shot[:, :, 0] < 100)).any(axis=0))

    page.wait_for_selector('body[data-frame="0"]')
    first = picture()
    assert np.median(first[first[:, :, 0] > 40][:, 0]) == pytest.approx(60, abs=8), "the wall of frame 0"
    post = green_columns(first)
    assert 300 < post.mean() < 420, "the post is near the middle"
    zoom = float(page.locator("body").get_attribute("data-zoom"))
    page.locator("#scrub").fill("2")
    page.wait_for_selector('body[data-frame="2"]')
    last = picture()
    assert np.median(last[last[:, :, 0] > 40][:, 0]) == pytest.approx(180, abs=8), "the wall of frame 2"
    page.mouse.move(300, 200)
    page.mouse.down()
    page.mouse.move(340, 200, steps=4)
    page.mouse.up()
    assert float(page.locator("body").get_attribute("data-yaw")) == pytest.approx(0.16, abs=0.01)
    # 12 in front of the pivot at 20, 0.33 left of the axis, turned by 0.16 rad, seen with 600 pixels of focal length
    assert green_columns(picture()).mean() == pytest.approx(516.6, abs=4)
    page.get_by_role("button", name="reset view").click()
    assert float(page.locator("body").get_attribute("data-yaw")) == 0
    for key in ("d", "s", "+"):
        page.keyboard.press(key)
    turned = [float(page.locator("body").get_attribute(f"data-{name}")) for name in ("yaw", "pitch", "zoom")]
    assert turned == pytest.approx([0.1, 0.1, 0.9 * zoom], abs=1e-3)
    page.get_by_role("button", name="reset view").click()
    assert barriers(page) == []
    page.mouse.wheel(0, 500)
    page.get_by_role("button", name="play").click()
    page.wait_for_selector('body[data-frame="0"]')
    page.get_by_role("button", name="pause").click()
    assert problems == []
    assert all(url.startswith(("file:", "data:")) for url in requests)


@pytest.mark.slow  # as above
def test_a_damaged_page_says_so_in_a_browser(browser: Any, tmp_path: Path) -> None:
    write_viewer(tmp_path / "x.html", clip(), CAMERA, width=160)
    text = (tmp_path / "x.html").read_text()
    second = text.index('{"image"', text.index('{"image"') + 1)
    page = browser.new_page()
    for damaged, words in (
        (text[:second] + text[second + 1 :], "frame 2 cannot be read"),
        (text.replace('{"title"', '{"title', 1), "this page cannot be read"),
    ):
        (tmp_path / "x.html").write_text(damaged)
        page.goto((tmp_path / "x.html").as_uri())
        if words.startswith("frame"):
            page.wait_for_selector('body[data-frame="0"]')
            assert page.locator("#problem").is_hidden()
            page.locator("#scrub").fill("1")
        page.wait_for_selector("#problem:visible")
        assert words in page.locator("#problem").inner_text()
        assert "is the file whole?" in page.locator("#problem").inner_text()


@pytest.mark.slow
def test_a_road_has_no_gaps_from_above_and_no_surface_crosses_an_edge(browser: Any, tmp_path: Path) -> None:
    disparity = np.full((60, 160), 1 / 40, np.float32)
    disparity[14:] = np.arange(4, 50, dtype=np.float32)[:, None] / (120 * 1.3)
    disparity[:, 70:80] = np.maximum(disparity[:, 70:80], 1 / 8)  # a post, much nearer than the wall behind it
    image = np.full((60, 160, 3), 255, np.uint8)
    camera = Camera.from_numbers((120.0, 120.0, 69.5, 34.5), 60, 160)
    write_viewer(tmp_path / "x.html", [Prediction(1 / disparity, disparity, image)], camera, width=160)
    page = browser.new_page()
    page.goto((tmp_path / "x.html").as_uri())
    page.wait_for_selector('body[data-frame="0"]')

    def lit() -> Any:
        shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        return shot[80:340].min(axis=2) > 200  # below the caption and the photograph, above the bar

    def filled(columns: Any) -> float:
        """The fraction of lit pixels between the first and the last of each column."""
        spans = [column[column.argmax() : len(column) - column[::-1].argmax()] for column in columns.T if column.any()]
        return float(np.concatenate(spans).mean())

    columns = np.flatnonzero(lit().any(axis=0))
    assert columns[0] + columns[-1] == pytest.approx(799, abs=4), "the picture is in the middle"
    page.locator("#keys").wait_for(state="hidden")  # a single picture has no frames to step through
    for _ in range(5):
        page.keyboard.press("s")
    road = slice(480, 560)
    page.locator("#size").fill("1")
    joined = lit()[:, road]
    page.locator("#surfaces").uncheck()
    apart = lit()[:, road]
    assert filled(joined) > 0.99
    assert filled(apart) < 0.8
    page.locator("#surfaces").check()
    page.get_by_role("button", name="reset view").click()
    for _ in range(5):
        page.keyboard.press("d")
    across = lit()[60:100]
    assert filled(across.T) < 0.95, "the post hides a part of the road, which no surface bridges"
