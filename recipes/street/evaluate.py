"""Score a checkpoint's depth and motion on the real frames of kitti_mini: ``python evaluate.py street.ckpt [ROOT]``.

``--openvino bf16`` (extra ``openvino``) scores what another runtime makes of it.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from types import SimpleNamespace

import torch
from real import real_frames, score
from torch import nn
from train_pose import score as pose_score

from saunet.exporting.openvino import export_openvino, run_openvino
from saunet.runs.checkpoint import Checkpoint
from saunet.weights.files import read_model


class InOpenVino(nn.Module):
    """A model's depth network as OpenVINO computes it, in float32 (``f32``) or bfloat16."""

    def __init__(self, model: Checkpoint, precision: str) -> None:
        super().__init__()
        depth = model.networks()[0].eval()
        with tempfile.TemporaryDirectory() as folder:
            graph, weights = Path(folder, "x.xml"), Path(folder, "x.bin")
            export_openvino(depth, model.record, graph, weights, batch="one")
            self._run = run_openvino(graph, weights, precision)

    def forward(self, image: torch.Tensor) -> SimpleNamespace:
        return SimpleNamespace(disparity=(torch.from_numpy(self._run(image.numpy())),))


def main() -> None:
    """Print one line per clip, with and without the mirrored image, and one for the motion."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", help="a checkpoint, or the name of a shipped model")
    parser.add_argument(
        "root", type=Path, nargs="?", default=Path(os.environ.get("SAUNET_TEST_DATA", "../../../shared")) / "kitti_mini"
    )
    parser.add_argument("--openvino", choices=("f32", "bf16"))
    options = parser.parse_args()
    found = read_model(options.checkpoint)
    depth, pose = found.networks()
    scored = InOpenVino(found, options.openvino) if options.openvino else depth
    size = (found.record.height, found.record.width)
    clips = real_frames(options.root)
    for flip in (False, True):
        for clip, (abs_rel, delta, ratio) in score(scored, clips, size, flip).items():
            print(f"{clip} flip={flip}: Abs Rel {abs_rel:.3f}, δ1 {delta:.3f}, median scale {ratio:.3f}")
    if pose is not None:
        print(f"06 motion: {pose_score(pose.eval(), options.root, (96, 320))}")


if __name__ == "__main__":
    main()
