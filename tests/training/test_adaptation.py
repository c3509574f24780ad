"""`experiment=quick` makes `street` better on clips it has never seen, at no step worse, in bends as on straights."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from lightning import Callback
from numpy.typing import NDArray
from omegaconf import OmegaConf
from torch import nn
from training_options import train_options

import saunet
from saunet.cli.compose import register_configs
from saunet.cli.table import config_dir
from saunet.io.images import write_image
from saunet.metrics.protocols import evaluate_image, protocol
from saunet.synthetic import SyntheticDrive
from saunet.synthetic.world import turn

SIZE = (128, 416)
Frame = tuple[NDArray[np.uint8], torch.Tensor, str]


class Winding(SyntheticDrive):
    """A rendered street driven in bends to both sides, 0.45 m a frame, and up to 2.4 degrees a frame."""

    bend = 15.0

    def pose(self, index: int) -> NDArray[np.float64]:
        heading = np.radians(self.bend) * np.sin(2 * np.pi * np.arange(index + 1) / 40)
        T = super().pose(0).copy()
        T[:3, :3] = turn(heading[-1]) @ T[:3, :3]
        T[0, 3] += 0.45 * np.sin(heading).sum()
        T[2, 3] += 0.45 * np.cos(heading).sum()
        return T


class Straight(Winding):
    bend = 0.0


class Scores(Callback):
    """Depth's mean Abs Rel and δ1 on some frames, before the first step and every so many."""

    def __init__(self, clips: dict[str, list[Frame]], every: int) -> None:
        self.clips, self.every, self.rows = clips, every, []

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self.look(0, pl_module)

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *rest: Any) -> None:
        if trainer.global_step % self.every == 0:
            self.look(trainer.global_step, pl_module)

    @torch.no_grad()
    def look(self, step: int, module: Any) -> None:
        module.depth.eval()
        self.rows.append({name: score(module.depth, frames) for name, frames in self.clips.items()})
        module.train()
        print(step, {name: f"{a:.3f} / {b:.3f}" for name, (a, b) in self.rows[-1].items()}, flush=True)


def score(network: nn.Module, frames: list[Frame]) -> tuple[float, float]:
    rows = []
    for image, depth, rules in frames:
        small = cv2.resize(image, SIZE[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        disparity = network(torch.from_numpy(small).permute(2, 0, 1)[None]).disparity[0][0, 0]
        errors = evaluate_image(disparity, depth, protocol(rules)).errors
        rows.append((float(errors[0]), float(errors[4])))
    mean = np.mean(rows, axis=0)
    return float(mean[0]), float(mean[1])


def adapt(clips: Path, frames: dict[str, list[Frame]], folder: Path, every: int, *overrides: str) -> Scores:
    scores = Scores(frames, every)
    register_configs()
    with initialize_config_dir(str(config_dir()), version_base="1.3"):
        given = ["experiment=quick", f"data.root={clips}", "data.workers=0", f"output_dir={folder}", *overrides]
        chosen = train_options(OmegaConf.to_container(compose("train", given), resolve=True))  # type: ignore[arg-type]
    saunet.train(saunet.TrainOptions(**{**vars(chosen), "trainer": {**chosen.trainer, "callbacks": [scores]}}))
    return scores


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Winding, Straight])
def test_rendered_clips(kind: type[Winding], tmp_path: Path) -> None:
    frames: dict[str, list[Frame]] = {}
    for seed in (21, 22):
        drive = kind(seed=seed, frames=48, height=144, width=480)
        for index in drive.indices:
            write_image(tmp_path / "clips" / f"{seed}" / f"{index:06d}.png", drive.image(index))
        K = [float(drive.intrinsics(0)[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2))]
        (tmp_path / "clips" / f"{seed}" / "camera.yaml").write_text(
            yaml.safe_dump({"image_size": [480, 144], "K": K, "fps": 10})
        )
        looked_at = list(drive.indices)[::6]
        frames[str(seed)] = [(drive.image(i), torch.from_numpy(drive.depth(i)), "synthetic") for i in looked_at]
    rows = adapt(tmp_path / "clips", frames, tmp_path / "run", 50, "trainer.max_steps=100").rows
    for name in frames:
        start, *later = (row[name][0] for row in rows)
        assert max(later) < start + 0.01
        assert later[-1] < 0.95 * start  # which knows such streets


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_real_clips(seed: int, kitti_mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three clips of KITTI, learned from together; two of them have true depth, in heavy traffic and on a free road."""
    monkeypatch.setattr(sys, "path", [str(Path(__file__).parents[2] / "recipes" / "street"), *sys.path])
    from real import real_frames

    for name, (source, K) in real_clips(kitti_mini).items():
        for path in sorted(source.iterdir()):
            image = cv2.imread(str(path))[..., ::-1]
            small = cv2.resize(image, (640, 192), interpolation=cv2.INTER_AREA)
            write_image(tmp_path / "clips" / name / f"{path.stem}.png", small)
        sx, sy = 640 / image.shape[1], 192 / image.shape[0]
        K = [K[0, 0] * sx, K[1, 1] * sy, (K[0, 2] + 0.5) * sx - 0.5, (K[1, 2] + 0.5) * sy - 0.5]
        text = yaml.safe_dump({"image_size": [640, 192], "K": [float(each) for each in K], "fps": 10})
        (tmp_path / "clips" / name / "camera.yaml").write_text(text)
    rows = adapt(tmp_path / "clips", real_frames(kitti_mini), tmp_path / "run", 50, f"seed={seed}").rows
    for name, bound in (("9015", 0.85), ("06", 0.55)):
        start, *later = (row[name][0] for row in rows)
        assert max(later) < start + 0.01
        assert later[-1] < bound * start


def real_clips(root: Path) -> dict[str, tuple[Path, NDArray[np.float64]]]:
    """Return folders of frames and their K."""
    read: Callable[[Path, str], NDArray[np.float64]] = lambda path, key: np.array(
        next(line.split()[1:] for line in path.read_text().splitlines() if line.startswith(f"{key}:")), np.float64
    ).reshape(3, 4)
    day = root / "raw" / "2011_09_26"
    K = read(day / "calib_cam_to_cam.txt", "P_rect_02")
    drives = {name: (day / f"2011_09_26_drive_{name}_sync" / "image_02" / "data", K) for name in ("9005", "9015")}
    sequence = root / "odometry" / "sequences" / "06"
    return {**drives, "06": (sequence / "image_0", read(sequence / "calib.txt", "P0"))}
