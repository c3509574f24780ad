"""A tiny tree in KITTI's raw layout."""

from __future__ import annotations

import cv2
import numpy as np

DATE = "2011_09_26"
CALIBRATION = """calib_time: 09-Jan-2012 13:57:47
corner_dist: 9.950000e-02
S_rect_00: 6.000000e+01 2.000000e+01
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 50 0 30 0 0 50 10 0 0 0 1 0
S_rect_02: 6.000000e+01 2.000000e+01
P_rect_02: 50 0 30 3 0 50 10 0 0 0 1 0
S_rect_03: 6.000000e+01 2.000000e+01
P_rect_03: 55 0 31 -30 0 55 9 0 0 0 1 0
"""
# scanner axes: x forward, y left, z up
SCANNER = "calib_time: x\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\ndelta_f: 0 0\n"


def name(number):
    return f"{DATE}/{DATE}_drive_{number:04d}_sync"


def make_drive(root, number, frames=range(6), sides=(2, 3), scans=True, suffix=".png", size=(20, 60)):
    date = root / DATE
    date.mkdir(parents=True, exist_ok=True)
    (date / "calib_cam_to_cam.txt").write_text(CALIBRATION)
    (date / "calib_velo_to_cam.txt").write_text(SCANNER)
    drive = root / name(number)
    for side in sides:
        folder = drive / f"image_{side:02d}" / "data"
        folder.mkdir(parents=True)
        for frame in frames:
            cv2.imwrite(str(folder / f"{frame:010d}{suffix}"), np.full((*size, 3), (0, side, frame), np.uint8))
    if scans:
        folder = drive / "velodyne_points" / "data"
        folder.mkdir(parents=True)
        for frame in frames:
            points = np.array([[10, 0, 0, 0.5], [20, -2, 1.2, 0.5], [-5, 0, 0, 0.5]], np.float32)
            points.tofile(folder / f"{frame:010d}.bin")
    return drive
