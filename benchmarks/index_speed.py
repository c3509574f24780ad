"""Time from the start of the data module to its first window: own clips as folders of small JPEGs, cold and cached.

Frames of 640x192 show a landscape that slides by, with stops, doubled frames and cuts. Each figure is a fresh process
with the files in the page cache: processor time, time on the wall, and memory that the set-up adds. ``--peer`` takes
turns with another checkout of saunet, whose frames used must be the same::

    python benchmarks/index_speed.py --frames 5000 20000
    python benchmarks/index_speed.py --frames 5000 --peer OTHER/src --repeats 3
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

CLIP = 1000  # frames a clip
SETUP = """
import json, resource, sys, time
import saunet
name = "video" if "video" in saunet.available("data") else "campus"
data = saunet.build("data", name, root=sys.argv[1], frames_cache=sys.argv[2], workers=0)
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before, processor, wall = peak(), time.process_time(), time.perf_counter()
data.setup("fit")
figures = [time.process_time() - processor, time.perf_counter() - wall, peak() - before]
print(json.dumps([figures, data.fingerprints()]))
"""


def landscape(seed: int) -> np.ndarray:
    """Return a long picture with detail of every size, as streets have it."""
    rng = np.random.default_rng(seed)
    world = np.zeros((200, 9000, 3), np.float32)
    for size in (4, 8, 16, 32, 64, 100):
        noise = rng.normal(0, size**0.5, (200 // size, 9000 // size, 3)).astype(np.float32)
        world += cv2.resize(noise, (9000, 200), interpolation=cv2.INTER_CUBIC)
    return np.asarray(cv2.normalize(world, None, 0, 250, cv2.NORM_MINMAX, cv2.CV_8U))


def make(root: Path, frames: int) -> None:
    """Write clips of ``CLIP`` frames."""
    root.mkdir(parents=True)
    (root / "camera.yaml").write_text("image_size: [640, 192]\nK: [500, 500, 320, 96]\nfps: 10\n")
    world, rng, place, step = landscape(0), np.random.default_rng(0), 0.0, 9.0
    for number in range(frames):
        folder, index = root / f"clip_{number // CLIP:03d}", number % CLIP
        folder.mkdir(exist_ok=True)
        step = 0.0 if index % 97 < 6 else float(rng.uniform(4, 14)) if index % 97 == 6 else step
        if index % 211 == 100:
            place = rng.uniform(0, 8000)  # a cut
        if index % 53 != 7 or not number:  # else the frame before, once more
            place = (place + step) % 8300
            picture = cv2.add(world[:192, int(place) :][:, :640], rng.integers(0, 3, (192, 640, 3), dtype=np.uint8))
        cv2.imwrite(str(folder / f"frame_{index:06d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 90])


def measured(source: str | None, root: Path, cache: Path) -> tuple[list[float], dict[str, str]]:
    environment = {**os.environ, **({"PYTHONPATH": source} if source else {})}
    command = [sys.executable, "-c", SETUP, str(root), str(cache)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    figures, frames = json.loads(done.stdout.splitlines()[-1])
    return figures, frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[5000])
    parser.add_argument("--peer", help="src folder of another checkout")
    parser.add_argument("--repeats", type=int, default=1)
    options = parser.parse_args()
    sources = {"this": None, **({"peer": options.peer} if options.peer else {})}
    for count in options.frames:
        with tempfile.TemporaryDirectory() as folder:
            make(Path(folder) / "clips", count)
            seen: list[dict[str, str]] = []
            for _ in range(options.repeats):
                for name, source in sources.items():
                    cache = Path(folder) / "cache"
                    for state in ("cold", "cached"):
                        (processor, wall, memory), frames = measured(source, Path(folder) / "clips", cache)
                        seen.append(frames)
                        each = f"{1000 * processor / count:.4f} ms processor, {1000 * wall / count:.4f} ms wall a frame"
                        print(f"{count} frames, {name}, {state}: {each}, +{memory:.0f} MB", flush=True)
                    shutil.rmtree(cache)
            if any(frames != seen[0] for frames in seen):
                sys.exit("the frames used differ")


if __name__ == "__main__":
    main()
