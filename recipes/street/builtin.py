"""Add streets of saunet's own world, which needs no assets, to a folder of scenes: other seeds than any data module's.

Run ``python builtin.py OUT --drives 150``: a drive whose file exists is skipped, so a stopped run resumes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from frames import HEIGHT, WIDTH, save

from saunet.synthetic import SyntheticDrive

FIRST_FILE, FIRST_SEED = 900_000, 1_000_000_000
"""Names of the files, apart from those of render.py; seeds of the drives, apart from those of `data=synthetic`."""
LENGTH, VIEWS = 40, 4


def scene(number: int, height: int = HEIGHT, width: int = WIDTH) -> dict[str, object]:
    """Return one drive as a scene that `frames.save` takes, from a camera of its own, without pairs."""
    rng = np.random.default_rng(number)
    drive = SyntheticDrive(
        seed=FIRST_SEED + number,
        frames=LENGTH,
        height=height,
        width=width,
        moving_cars=int(rng.integers(4)),
        camera_height=float(rng.uniform(1.3, 2.0)),
        focal=float(rng.uniform(0.45, 0.8)) if rng.uniform() < 0.5 else 0.58,
    )
    places = np.linspace(0, LENGTH - 1, VIEWS).astype(int).tolist()
    quality = [cv2.IMWRITE_JPEG_QUALITY, 94]
    return {
        "images": [cv2.imencode(".jpg", drive.image(i)[..., ::-1], quality)[1].tobytes() for i in places],
        "depth": np.stack([drive.depth(i) for i in places]).astype(np.float16),
        "K": np.stack([drive.intrinsics(i) for i in places]).astype(np.float32),
        "T_world_cam": np.stack([drive.pose(i) for i in places]),
        "second": np.zeros(VIEWS, bool),
        "kind": "builtin",
    }


def main() -> None:
    """Render drives into a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--drives", type=int, default=150)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(options.drives):
        path = options.out / f"{FIRST_FILE + number}.npz"
        if not path.exists():
            save(path, scene(number))
            print(path.name, flush=True)


if __name__ == "__main__":
    main()
