"""The README's demo, on few frames: what it scores, and what it draws."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2


def test_demo_shows_the_shipped_model_beside_the_trained_one(tool: Callable[..., Any], tmp_path: Path) -> None:
    few = ("data=synthetic_tiny", "model.encoder.weights=null", "trainer=smoke", "trainer.max_epochs=1")
    outcome = tool("demo", *few, "output_dir=run")
    assert outcome.code == 0, outcome.err
    for words in ("model", "street", "constant depth", "completeness", "last.ckpt"):
        assert words in outcome.out
    assert "learned from their video" in outcome.out
    assert "neither network has seen" in outcome.out
    run = tmp_path / "run"
    for place in ("driven", "unseen"):
        with (run / place / "per_image.csv").open() as file:
            rows = list(csv.DictReader(file))
        scored = {row["predictor"] for row in rows}
        assert scored == {"model", "street", "constant depth", "mean depth map"}
        names = {row["name"].split()[0] for row in rows}
        assert names == ({f"synthetic/00000{n}" for n in range(4)} if place == "driven" else {"synthetic/020000"})
        picture = cv2.imread(str(run / f"{place}.png"))
        assert picture.shape[1] >= 3 * 640, "three frames of 640 pixels stand side by side"
        assert picture.shape[0] > 5 * round(96 * 640 / 320), "input, both predictions, truth and error"
        assert json.loads((run / place / "metrics.json").read_text())
    assert (run / "depth.mp4").stat().st_size > 0
