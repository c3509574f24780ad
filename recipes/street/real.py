"""Score on the few real frames in ``SAUNET_TEST_DATA/kitti_mini``, which are never trained on."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from saunet.data.kitti.files import lidar_depth
from saunet.data.lidar import read_scan
from saunet.metrics.protocols import evaluate_image, protocol

Frame = tuple[np.ndarray, Tensor, str]


def real_frames(root: Path) -> dict[str, list[Frame]]:
    """Return images (RGB, native size), true depths (meters, 0 where unknown) and the protocol, for each clip."""
    day = root / "raw/2011_09_26"
    values = {}
    for name in ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt"):
        for line in (day / name).read_text().splitlines():
            key, _, rest = line.partition(":")
            values[key] = rest
    read = lambda key, *shape: np.array(values[key].split(), float).reshape(shape)  # noqa: E731
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = read("R", 3, 3), read("T", 3)
    drive = day / "2011_09_26_drive_9015_sync"
    clips: dict[str, list[Frame]] = {"9015": [], "06": []}
    for path in sorted((drive / "image_02/data").iterdir()):
        image = cv2.imread(str(path))[..., ::-1]
        scan = read_scan(drive / f"velodyne_points/data/{path.stem}.bin")
        depth = lidar_depth(scan, read("P_rect_02", 3, 4), read("R_rect_00", 3, 3), T, image.shape[:2])
        clips["9015"].append((image, torch.from_numpy(depth), "eigen_camera_z"))
    with np.load(root / "odometry/depth/06.npz") as data:
        for key in sorted(k[:6] for k in data.files if k.endswith("_depth")):
            image = cv2.imread(str(root / f"odometry/sequences/06/image_0/{key}.png"))[..., ::-1]
            depth = np.zeros(image.shape[:2], np.float32)
            depth[data[f"{key}_rows"], data[f"{key}_cols"]] = data[f"{key}_depth"]
            clips["06"].append((image, torch.from_numpy(depth), "synthetic"))
    return clips


@torch.inference_mode()
def score(
    network: nn.Module, clips: dict[str, list[Frame]], size: tuple[int, int], flip: bool = False, finest: int = 0
) -> dict[str, tuple[float, float, float]]:
    """Return the mean Abs Rel, mean δ1 and median scale ratio of each clip.

    Args:
        network: A depth network of saunet.
        clips: From `real_frames`.
        size: (height, width) that the network sees.
        flip: Average the disparity with that of the mirrored image.
        finest: Scale whose disparity counts; 0 is the full size.
    """
    network.eval()
    out = {}
    for name, frames in clips.items():
        rows = []
        for image, depth, rules in frames:
            x = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255
            batch = torch.from_numpy(x).permute(2, 0, 1)[None]
            disparity = network(batch).disparity[finest]
            if flip:
                disparity = (disparity + network(batch.flip(-1)).disparity[finest].flip(-1)) / 2
            result = evaluate_image(disparity[0, 0], depth, protocol(rules))
            rows.append((float(result.errors[0]), float(result.errors[4]), float(result.ratio)))
        table = np.array(rows)
        out[name] = (float(table[:, 0].mean()), float(table[:, 1].mean()), float(np.median(table[:, 2])))
    return out
