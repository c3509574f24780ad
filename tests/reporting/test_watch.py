"""A run to look at, and its page on a local server."""

from __future__ import annotations

import json
import re
import socket
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browsing import barriers
from made_runs import make_run

import saunet
from saunet.errors import ConfigError, DataError
from saunet.io.images import read_image
from saunet.reporting.page import as_html
from saunet.reporting.run import page_of, write_results
from saunet.reporting.watch import WatchOptions, serving


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run in which a figure of health was noticed, with a picture of each epoch and a data set's findings."""
    samples = {"train": "train (1 of 1 drives): 4 frames used; left out: 2 without neighbor"}
    health = {"holes": "8 % of the pixels lie in holes"}
    path = make_run(tmp_path / "night", status="finished", samples=samples, health=health)
    log = path / "csv" / "metrics.csv"
    head, *lines = log.read_text().splitlines()
    log.write_text("\n".join([f"{head},health/holes", *(f"{line},0.08" for line in lines)]) + "\n")
    (path / "pictures").mkdir()
    for epoch in (2, 10):
        cv2.imwrite(str(path / "pictures" / f"epoch_{epoch:03d}.png"), np.full((8, 8, 3), 20 * epoch, np.uint8))
    return path


def test_a_run_is_read_shown_and_drawn(folder: Path) -> None:
    run = saunet.Run(folder)
    assert (run.status, run.name) == ("finished", "night")
    assert repr(run) == f"Run({folder}: finished, 9 steps, loss 1.2)"
    assert run.table.rows[0].cells[1] == "finished"
    assert run.plot()._repr_svg_().count("<svg") == 1
    assert re.fullmatch(r"Drawing\(\d+ kB of SVG; .*\)", repr(run.plot()))
    assert "<table>" in run._repr_html_()
    with pytest.raises(DataError, match="logged nothing"):
        saunet.Run(make_run(folder.parent / "new", status="running", abs_rel=())).plot()


def test_one_run_is_wanted(sweep: Path) -> None:
    with pytest.raises(DataError, match="holds 3 runs"):
        saunet.Run(sweep)


def test_the_page_of_a_run_has_curves_the_last_picture_health_and_data(folder: Path) -> None:
    page = page_of(folder)
    assert [section.title for section in page.sections] == ["Progress", "Last pictures", "Health", "Data"]
    text = as_html(page, live=5.0)
    assert "Epoch 11" in text
    assert "8 % of the pixels lie in holes" in text
    assert "4 frames used; left out: 2 without neighbor" in text
    assert "connect-src" in text
    assert "<script" not in as_html(page)


def test_the_table_of_a_sweep_says_how_many_jobs_have_ended(sweep: Path) -> None:
    (section,) = page_of(sweep).sections
    assert section.blocks[0].title == "3 of 3 jobs have ended"


def get(address: str, host: str | None = None, tag: str | None = None) -> tuple[int, str, str]:
    headers = {"Host": host} if host else {}
    request = urllib.request.Request(address, headers={**headers, **({"If-None-Match": tag} if tag else {})})
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.status, answer.read().decode(), answer.headers["ETag"]
    except urllib.error.HTTPError as error:
        return error.code, "", ""


def test_the_page_follows_the_run_and_answers_this_machine_only(folder: Path) -> None:
    with serving(WatchOptions(run=folder, port=0)) as address:
        assert address.startswith("http://127.0.0.1:")
        status, before, tag = get(address)
        assert status == 200
        assert get(address, tag=tag)[0] == 304
        record = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps({**record, "status": "failed", "error": "the loss became NaN"}))
        _, after, _ = get(address)
        assert "the loss became NaN" in after
        assert "the loss became NaN" not in before
        assert get(address + "/run.json")[0] == 404
        assert get(address, host="evil.example")[0] == 403


def test_what_cannot_be_served_is_said_at_once(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(DataError, match="check the path"), serving(WatchOptions(run=str(tmp_path / "none"), port=0)):
        pass
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match="another port"), serving(WatchOptions(run=str(folder), port=port)):
            pass


@pytest.mark.slow  # fast, but only the session of the slow tests installs playwright
def test_the_open_page_renews_itself_in_a_browser(browser: Any, folder: Path) -> None:
    requests: list[str] = []
    with serving(WatchOptions(run=folder, port=0, every=0.2)) as address:
        page = browser.new_page()
        page.on("request", lambda request: requests.append(request.url))
        page.goto(address)
        page.locator("h1", has_text="night").wait_for()
        record = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps({**record, "status": "failed", "error": "the loss became NaN"}))
        page.get_by_text("the loss became NaN").wait_for()
        assert barriers(page) == []
        page.get_by_role("button", name="Pause").click()
        assert page.locator("#live").inner_text() == "paused"
    assert all(url.startswith((address, "data:")) for url in requests)


def test_the_results_of_a_training_are_one_picture(folder: Path) -> None:
    (folder / "pictures" / "epoch_010.png").unlink()
    cv2.imwrite(str(folder / "pictures" / "epoch_010.png"), np.full((40, 100, 3), (0, 0, 250), np.uint8))
    path = write_results(folder)
    assert path == folder / "results.png"
    picture = read_image(path).astype(int)
    red = (picture[..., 0] > 240) & (picture[..., 1] < 10)
    assert red.mean() > 0.2, "the last panel"
    blue = (picture[..., 2] > 150) & (picture[..., 0] < 60)
    assert blue.any(axis=1)[: len(picture) // 2].any(), "the curves above it"
    assert write_results(make_run(folder.parent / "mute", status="finished", abs_rel=())) is None
