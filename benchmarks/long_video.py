"""Memory over an hours-long video: 20 000 frames through the doctor, a few steps of training, and prediction.

The video shows a landscape that slides by, small pictures at 10 frames a second; what may grow is kept per frame, not
per pixel. Each tool is a process of its own, whose resident memory is read twice a second. A stage can be run alone on
what an earlier one left in ``--folder``::

    python benchmarks/long_video.py --folder /tmp/long
    python benchmarks/long_video.py --folder /tmp/long --stages predict
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from index_speed import landscape

PAGE = 4096 / 1e6  # MB


def write_video(path: Path, frames: int, height: int, width: int) -> None:
    """Write a video of a landscape that slides by, and its camera file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    world = landscape(0)[:height]
    with av.open(str(path), "w") as out:
        stream: Any = out.add_stream("libx264", rate=10, options={"preset": "ultrafast", "g": "50"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for number in range(frames):
            left = 3 * number % (world.shape[1] - width)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(world[:, left : left + width]), "rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 10)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    focal = round(0.8 * width)
    camera = f"image_size: [{width}, {height}]\nK: [{focal}, {focal}, {width / 2}, {height / 2}]\n"
    (path.parent / "camera.yaml").write_text(camera)


def watched(command: list[str]) -> tuple[list[float], float]:
    """Run a command and return its memory in MB twice a second, and its seconds."""
    start, seen = time.perf_counter(), list[float]()
    log = Path(command[-1].partition("=")[2] + ".log")
    with log.open("wb") as file, subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT) as process:
        while process.poll() is None:
            fields = Path(f"/proc/{process.pid}/statm").read_text().split()
            seen.append(int(fields[1]) * PAGE)
            time.sleep(0.5)
    if process.returncode:
        sys.exit(f"{' '.join(command)} failed: {log.read_text()[-2000:]}")
    return seen, time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 160), help="height and width of the video")
    parser.add_argument("--stages", nargs="+", choices=("doctor", "train", "predict"), default=())
    options = parser.parse_args()
    folder: Path = options.folder
    video = folder / "clips" / f"drive_{options.frames}.mp4"
    if not video.exists():
        write_video(video, options.frames, *options.size)
    data = ["data=video", f"data.root={video}", f"data.frames_cache={folder / 'cache'}", "data.height=64"]
    data += ["data.width=96", "data.workers=0", "data.static=keep", "data.fps=null"]
    commands = {
        "doctor": ["doctor", *data, f"output_dir={folder / 'doctor'}"],
        "train": ["train", "experiment=smoke", *data, f"output_dir={folder / 'run'}"],
        "predict": ["predict", f"input={video}", f"checkpoint={folder / 'run'}", "outputs=[mp4,trajectory]",
                    f"output={folder / 'out'}"],
    }  # fmt: skip
    for stage in options.stages or commands:
        seen, seconds = watched([sys.executable, "-m", "saunet", *commands[stage]])
        at = [float(np.median(seen[max(0, round(share * len(seen)) - 3) :][:5])) for share in (0.25, 0.5, 0.75, 0.98)]
        told = ", ".join(f"{value:.0f}" for value in at)
        print(
            f"{stage}: {options.frames} frames, {seconds:.0f} s, memory at 25, 50, 75 and 98 % of it {told} MB, most "
            f"{max(seen):.0f} MB",
            flush=True,
        )


if __name__ == "__main__":
    main()
