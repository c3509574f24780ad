"""Decoding a 1080p H.264 clip into the cache of ``data=video``: frames a second and memory, against another checkout.

The clip shows a landscape that slides by, at 30 frames a second, with ``--gop`` frames between key frames. ``--fps`` of
them a second are kept as JPEGs of 1280 pixels. Each figure is a fresh process with the file in the page cache; with
``--peer`` the checkouts take turns, and the median of the pairs' ratios is printed::

    python benchmarks/decode_speed.py --seconds 20
    python benchmarks/decode_speed.py --seconds 20 --peer OTHER/src --repeats 5
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from fractions import Fraction
from pathlib import Path
from statistics import median
from typing import Any

import av
import numpy as np
from index_speed import landscape

READ = """
import json, resource, sys, time
from pathlib import Path
try:
    from saunet.data.video.clips import find_clips, read_clip
except ImportError:
    from saunet.data.clips import find_clips, read_clip
clip = find_clips(sys.argv[1])[0]
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
middle = []
def advance(done, total):
    if not middle and done >= 100:
        middle.append(peak())
processor, wall = time.process_time(), time.perf_counter()
found = read_clip(clip, float(sys.argv[3]) or None, Path(sys.argv[2]), 1280, advance)
print(json.dumps([time.perf_counter() - wall, time.process_time() - processor, len(found.paths), middle[0], peak()]))
"""


def write_clip(path: Path, seconds: int, gop: int) -> int:
    """Write the clip and its camera file; return its frames."""
    tile = np.repeat(np.repeat(landscape(0)[:180], 6, 0), 2, 1)  # 1080 rows
    with av.open(str(path), "w") as out:
        options = {"preset": "veryfast", "crf": "20", "g": str(gop)}
        stream: Any = out.add_stream("libx264", rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = 1920, 1080, "yuv420p"
        for number in range(seconds * 30):
            left = 8 * number % (tile.shape[1] - 1920)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(tile[:, left : left + 1920]), "rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    (path.parent / "camera.yaml").write_text("image_size: [1920, 1080]\nK: [1400, 1400, 959.5, 539.5]\n")
    return seconds * 30


def measure(source: str, root: Path, fps: float) -> list[float]:
    """Return wall and processor seconds, frames kept, memory after 100 frames and at the end in MB."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, "-c", READ, str(root), cache, str(fps)]
        done = subprocess.run(command, env={**os.environ, "PYTHONPATH": source}, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr[-2000:])
    return [float(each) for each in json.loads(done.stdout.splitlines()[-1])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--gop", type=int, default=30)
    parser.add_argument("--fps", type=float, default=10.0, help="frames a second to keep; 0 keeps all")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--peer", help="src folder of another checkout")
    options = parser.parse_args()
    here = str(Path(__file__).parents[1] / "src")
    sources = [here, *([str(Path(options.peer).absolute())] if options.peer else [])]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "clips"
        root.mkdir()
        count = write_clip(root / "drive.mp4", options.seconds, options.gop)
        found: list[list[list[float]]] = []
        for repeat in range(options.repeats):
            order = sources if repeat % 2 == 0 else sources[::-1]
            pair = {source: measure(source, root, options.fps) for source in order}
            found.append([pair[source] for source in sources])
            told = ", ".join(
                f"{count / wall:.0f}/s wall, {count / own:.0f}/s of processor" for wall, own, *_ in found[-1]
            )
            print(f"repeat {repeat}: {told}", flush=True)
    for place, source in enumerate(sources):
        wall, own, kept, middle, end = (median(pair[place][each] for pair in found) for each in range(5))
        print(
            f"{source}: {count} frames, {kept:.0f} kept, {count / wall:.0f} frames/s, {count / own:.0f} per second of "
            f"processor time; {middle:.0f} MB after 100 frames, {end:.0f} MB at the end"
        )
    if options.peer:
        for name, each in (("wall", 0), ("processor", 1)):
            print(f"ratio of {name} time, peer over this: {median(b[each] / a[each] for a, b in found):.2f}")


if __name__ == "__main__":
    main()
