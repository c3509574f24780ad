"""A tiny KITTI raw tree whose scans cover the picture."""

from __future__ import annotations

import cv2
import numpy as np

DATE = "2011_09_26"
CALIBRATION = """S_rect_02: 6.000000e+01 2.000000e+01
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 50 0 30 0 0 50 10 0 0 0 1 0
P_rect_02: 50 0 30 0 0 50 10 0 0 0 1 0
"""
SCANNER = "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n"


def name(number):
    return f"{DATE}/{DATE}_drive_{number:04d}_sync"


def make_tree(root):
    """A KITTI raw tree of two drives, left camera, 20 x 60, with a scan of a road and a wall for each frame."""
    date = root / DATE
    date.mkdir(parents=True)
    (date / "calib_cam_to_cam.txt").write_text(CALIBRATION)
    (date / "calib_velo_to_cam.txt").write_text(SCANNER)
    rng = np.random.default_rng(0)
    for number, frames in ((1, 6), (2, 4)):
        images = root / name(number) / "image_02" / "data"
        scans = root / name(number) / "velodyne_points" / "data"
        images.mkdir(parents=True)
        scans.mkdir(parents=True)
        for frame in range(frames):
            small = rng.integers(0, 255, (5, 15, 3), dtype=np.uint8)
            cv2.imwrite(str(images / f"{frame:010d}.png"), cv2.resize(small, (60, 20), interpolation=cv2.INTER_CUBIC))
            x = rng.uniform(4, 20, 120).astype(np.float32)
            points = np.stack([x, x * rng.uniform(-0.5, 0.5, 120), x * rng.uniform(-0.15, 0.1, 120), x], -1)
            points.astype(np.float32).tofile(scans / f"{frame:010d}.bin")
