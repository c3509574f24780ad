"""Score a checkpoint's depth and motion on the real frames of kitti_mini: ``python evaluate.py street.ckpt [ROOT]``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from real import real_frames, score
from train_pose import score as pose_score

from saunet.weights.files import read_model


def main() -> None:
    """Print one line per clip, with and without the mirrored image, and one for the motion."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", help="a checkpoint, or the name of a shipped model")
    parser.add_argument(
        "root", type=Path, nargs="?", default=Path(os.environ.get("SAUNET_TEST_DATA", "../../../shared")) / "kitti_mini"
    )
    options = parser.parse_args()
    found = read_model(options.checkpoint)
    depth, pose = found.networks()
    size = (found.record.height, found.record.width)
    clips = real_frames(options.root)
    for flip in (False, True):
        for clip, (abs_rel, delta, ratio) in score(depth, clips, size, flip).items():
            print(f"{clip} flip={flip}: Abs Rel {abs_rel:.3f}, δ1 {delta:.3f}, median scale {ratio:.3f}")
    if pose is not None:
        print(f"06 motion: {pose_score(pose.eval(), options.root, (96, 320))}")


if __name__ == "__main__":
    main()
