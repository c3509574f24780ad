#!/usr/bin/env bash
# Guess: what cv2.fisheye.calibrate returns as K can be given to cv2.fisheye's other functions, whose results then fit as well as its RMS error says.
# Seen: OpenCV 5.0.0 (opencv-python-headless 5.0.0.93, Python 3.11). From exact points of a lens with a skew of 12 pixels, calibrate (without
#   CALIB_FIX_SKEW, which is not set by default) recovers K, skew in K[0, 1] included, with an RMS error of 5e-14 pixels. projectPoints with that K is
#   7.2 pixels off, because it takes the skew from a parameter of its own (alpha, 0 by default) and not from K; undistortPoints is 8.0 pixels off and has
#   no such parameter. So a calibration with skew cannot be used by the functions beside it, and its RMS error does not show it.
#   Lesson: calibrate with CALIB_FIX_SKEW, or project and undistort with code of one's own.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q opencv-python-headless==5.0.0.93 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
import cv2
import numpy as np

K, D = np.array([[400.0, 12, 320], [0, 400, 240], [0, 0, 1]]), np.array([0.05, -0.01, 0.002, -0.0005])
board = np.array([[0.1 * x, 0.1 * y, 0] for y in range(6) for x in range(9)]).reshape(1, -1, 3)
rng = np.random.default_rng(0)
points, pixels = [], []
while len(points) < 40:
    rotation = rng.normal(0, 0.35, (1, 1, 3))
    shift = rng.uniform([-0.6, -0.4, 0.5], [0.2, 0.1, 1.0]).reshape(1, 1, 3)
    seen = cv2.fisheye.projectPoints(board, rotation, shift, K, D, alpha=K[0, 1] / K[0, 0])[0].reshape(1, -1, 2)
    if seen.min() >= 0 and (seen <= [639, 479]).all():
        points.append(board)
        pixels.append(seen)
flags = cv2.CALIB_RECOMPUTE_EXTRINSIC
rms, K, D, rotations, shifts = cv2.fisheye.calibrate(points, pixels, (640, 480), np.eye(3), np.zeros((4, 1)), flags=flags)


def worst(alpha: float) -> float:
    found = 0.0
    for seen, rotation, shift in zip(pixels, rotations, shifts):
        again = cv2.fisheye.projectPoints(board, rotation.reshape(1, 1, 3), shift.reshape(1, 1, 3), K, D, alpha=alpha)[0]
        found = max(found, float(np.abs(again.reshape(-1, 2) - seen.reshape(-1, 2)).max()))
    return found


straight = cv2.fisheye.undistortPoints(pixels[0], K, D).reshape(-1, 2)
ahead = board[0] @ cv2.Rodrigues(rotations[0])[0].T + shifts[0].reshape(3)
off = float(np.abs(straight - ahead[:, :2] / ahead[:, 2:]).max() * K[0, 0])
plain, told = worst(0.0), worst(K[0, 1] / K[0, 0])
print(f"OpenCV {cv2.__version__}: skew {K[0, 1]:.3f}, RMS {rms:.1e} pixels")
print(f"projectPoints with this K: {plain:.2f} pixels off; with alpha too: {told:.1e}; undistortPoints: {off:.2f} pixels off")
assert rms < 1e-6 and abs(K[0, 1] - 12) < 1e-6 and told < 1e-6, "calibrate no longer recovers the skew"
assert plain > 5 and off > 5, "the other functions read the skew from K now"
PY
