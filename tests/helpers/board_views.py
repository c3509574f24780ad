"""Pictures of a calibration board as an ideal camera would take them: what calibration has to recover."""

from __future__ import annotations

import cv2
import numpy as np

K = np.array([[560.0, 0, 322.0], [0, 558.0, 236.0], [0, 0, 1]])
SIZE = (480, 640)


def poses(count, seed=0, tilt=0.6, spread=1.0):
    """Return count (rotation, shift) that tilt the board and move it over the image, near and far.

    Twice the ``spread`` takes it into the corners.
    """
    rng = np.random.default_rng(seed)
    for number in range(count):
        turn = np.array([rng.uniform(-tilt, tilt), rng.uniform(-tilt, tilt), rng.uniform(-0.3, 0.3)])
        place = np.array([(number % 3 - 1) * 0.05, (number // 3 % 3 - 1) * 0.04, rng.uniform(0.36, 0.48)])
        yield cv2.Rodrigues(turn)[0], place * [spread, spread, 1]


def views(
    board,
    count=14,
    distortion=None,
    seed=0,
    per_square=40,
    tilt=0.6,
    undistort=cv2.undistortPoints,
    spread=1.0,
    T_this_first=None,
):
    """Return pictures of the board, RGB, anti-aliased, with its center at each pose's place.

    ``undistort`` is the lens: `cv2.fisheye.undistortPoints` for a fisheye. ``T_this_first`` places the camera in a rig,
    of which the first sees the board at its poses.
    """
    T = np.eye(4) if T_this_first is None else T_this_first
    texture = board.picture(per_square)
    meters = board.square / per_square
    height, width = texture.shape
    # a texture pixel (u, v) lies at ((u + 0.5) * meters - ..., ...) on the board, the board's middle in the origin
    A = np.array([[meters, 0, (0.5 - width / 2) * meters], [0, meters, (0.5 - height / 2) * meters], [0, 0, 1]])
    finer = 3
    S = np.array([[finer, 0, (finer - 1) / 2], [0, finer, (finer - 1) / 2], [0, 0, 1.0]])
    pictures = []
    for R, t in ((T[:3, :3] @ R, T[:3, :3] @ t + T[:3, 3]) for R, t in poses(count, seed, tilt, spread)):
        H = S @ K @ np.c_[R[:, :2], t] @ A
        large = cv2.warpPerspective(
            texture,
            H,
            (SIZE[1] * finer, SIZE[0] * finer),
            flags=cv2.INTER_AREA,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=128,
        )
        straight = cv2.resize(large, SIZE[::-1], interpolation=cv2.INTER_AREA)
        if distortion is not None:
            v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
            seen = undistort(np.stack([u, v], -1).reshape(-1, 1, 2), K, np.array(distortion), P=K)
            maps = seen.reshape(*SIZE, 2).astype(np.float32)
            straight = cv2.remap(straight, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderValue=128)
        pictures.append(np.repeat(straight[..., None], 3, axis=2))
    return pictures
