#!/usr/bin/env bash
# Guess: cv2.remap with INTER_NEAREST takes the pixel nearest to where the maps point, whether they are decimal numbers or the fixed-point pair that
#   initUndistortRectifyMap and convertMaps make by default (CV_16SC2 and CV_16UC1), as INTER_LINEAR does within 1/32 of a pixel.
# Seen: OpenCV 5.0.0 (opencv-python-headless 5.0.0.93, Python 3.11). With the fixed-point pair each fraction is rounded the wrong way: at (4.25, 5.25)
#   the pixel taken is (5, 6), and at (4.75, 5.75) it is (4, 5); decimal maps give (4, 5) and (5, 6). No warning. Labels and depth maps that are
#   undistorted so are up to a pixel off their image, which is remapped linearly with the same maps and is right.
#   Lesson: for INTER_NEAREST turn the pair into decimal maps first (convertMaps to CV_32FC1), or make it with nninterpolation=True.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q opencv-python-headless==5.0.0.93 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
import cv2
import numpy as np

picture = np.arange(100, dtype=np.float32).reshape(10, 10)  # a pixel's value is 10 y + x
wrong = 0
for fx in (0.25, 0.75):
    for fy in (0.25, 0.75):
        x, y = np.full((1, 1), 4 + fx, np.float32), np.full((1, 1), 5 + fy, np.float32)
        pair = cv2.convertMaps(x, y, cv2.CV_16SC2)
        fixed, decimal = (cv2.remap(picture, *maps, cv2.INTER_NEAREST)[0, 0] for maps in (pair, (x, y)))
        linear = cv2.remap(picture, *pair, cv2.INTER_LINEAR)[0, 0]
        nearest = 10 * round(5 + fy) + round(4 + fx)
        print(f"({4 + fx}, {5 + fy}): nearest is {nearest}; decimal maps give {decimal:g}, fixed-point maps {fixed:g}")
        assert decimal == nearest and abs(linear - (10 * (5 + fy) + 4 + fx)) < 0.4
        wrong += fixed != nearest
print(f"OpenCV {cv2.__version__}: {wrong} of 4 wrong with fixed-point maps")
assert wrong == 4, "INTER_NEAREST no longer rounds fixed-point maps the wrong way"
PY
