"""Training from stereo pairs gives meters: the command of docs/scale.md, run, and its depth held against the truth."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pages import commands

import saunet
from saunet.synthetic import SyntheticDrive


@pytest.mark.slow
def test_stereo_training_is_metric(tmp_path: Path) -> None:
    (command,) = (line for page, line in commands("") if page == "scale.md" and "data.stereo=true" in line)
    overrides = [*shlex.split(command)[2:], f"output_dir={tmp_path}", f"hydra.run.dir={tmp_path}"]
    subprocess.run(
        [sys.executable, "-m", "saunet.cli.train", *overrides], check=True, capture_output=True, timeout=1500
    )
    predictor = saunet.load(tmp_path / "checkpoints" / "last.ckpt")
    for street in (0, 1):
        drive = SyntheticDrive(seed=street, frames=40)
        ratios = []
        for frame in list(drive.indices)[::6]:
            prediction, truth = predictor.predict(drive.image(frame)), drive.depth(frame)
            assert prediction.metric
            known = (truth > 0) & (truth < 80)
            ratios.append(np.median(truth[known]) / np.median(prediction.depth[known]))
        print(f"street {street}: {np.mean(ratios):.3f} ± {np.std(ratios):.3f}")
        assert abs(np.mean(ratios) - 1) < 0.1
