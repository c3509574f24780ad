"""The README's demo, on few frames: what it scores, and what it draws."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2


def test_demo_shows_the_shipped_model_and_a_small_sau_net_beside_the_trained_one(
    tool: Callable[..., Any], tmp_path: Path
) -> None:
    # The network's own words are for the demo's, not for the small SAU-Net, which has an encoder of its own.
    few = ("data=synthetic_tiny", "model.encoder.weights=null", "trainer=smoke", "trainer.max_epochs=1")
    outcome = tool("demo", *few, "output_dir=run")
    assert outcome.code == 0, outcome.err
    for words in ("model", "street", "sau_net_nano", "constant depth", "completeness", "last.ckpt"):
        assert words in outcome.out
    assert "learned from their video" in outcome.out
    assert "no network has seen" in outcome.out
    run = tmp_path / "run"
    for place in ("driven", "unseen"):
        with (run / place / "per_image.csv").open() as file:
            rows = list(csv.DictReader(file))
        scored = {row["predictor"] for row in rows}
        assert scored == {"model", "street", "sau_net_nano", "constant depth", "mean depth map"}
        names = {row["name"].split()[0] for row in rows}
        assert names == ({f"synthetic/00000{n}" for n in range(4)} if place == "driven" else {"synthetic/020000"})
        picture = cv2.imread(str(run / f"{place}.png"))
        assert picture.shape[1] >= 4 * 640, "four frames of 640 pixels stand side by side"
        assert picture.shape[0] > 6 * round(96 * 640 / 320), "input, three predictions, truth and error"
        assert json.loads((run / place / "metrics.json").read_text())
    assert (run / "depth.mp4").stat().st_size > 0
    nano = json.loads((run / "nano" / "run.json").read_text())
    assert nano["status"] == "finished"
    assert nano["config"]["data"]["train_drives"] == 4, "the same streets, so the words about data hold for it too"
    assert (nano["config"]["data"]["height"], nano["config"]["data"]["width"]) == (64, 192)
    assert "stratified" in nano["config"]["model"]["encoder"]["_target_"]
    assert nano["config"]["init_from"] is None
