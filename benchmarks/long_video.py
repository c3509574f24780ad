"""Memory over an hours-long recording: 20 000 frames through import, doctor, a few steps of training, and prediction.

The camera sees a landscape that slides by, small pictures at 10 frames a second; what may grow is kept per frame, not
per pixel. By default the recording is an MCAP bag (JPEG, CameraInfo and twist), and the doctor and what follows read
the clip that its import made; with ``--source video`` they read an H.264 video. Each tool is a process of its own,
whose resident memory is read twice a second. A stage can be run alone on what an earlier one left in ``--folder``::

    python benchmarks/long_video.py --folder /tmp/long
    python benchmarks/long_video.py --folder /tmp/long --stages predict
    python benchmarks/long_video.py --folder /tmp/long_video --source video
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from index_speed import landscape
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

PAGE = 4096 / 1e6  # MB
START = 1_403_636_579 * 10**9  # ns


def pictures(frames: int, height: int, width: int) -> Iterator[np.ndarray]:
    """Yield RGB pictures of a landscape that slides by."""
    world = landscape(0)[:height]
    for number in range(frames):
        left = 3 * number % (world.shape[1] - width)
        yield np.ascontiguousarray(world[:, left : left + width])


def write_bag(path: Path, frames: int, height: int, width: int) -> None:
    """Write an MCAP bag of ROS 2 with compressed images, the camera's intrinsics and its speed."""
    store, focal = get_typestore(Stores.ROS2_HUMBLE), round(0.8 * width)
    K = np.array([focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1.0])
    P = np.insert(K, (3, 6, 9), 0.0)

    def make(name: str, **values: Any) -> Any:
        return store.types[name](**values)

    roi = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    lens = {"distortion_model": "plumb_bob", "d": np.zeros(5), "k": K, "r": np.eye(3).ravel(), "p": P}
    size = {"height": height, "width": width, "binning_x": 0, "binning_y": 0, "roi": roi}
    forward, still = (make("geometry_msgs/msg/Vector3", x=x, y=0.0, z=0.0) for x in (8.0, 0.0))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {
            "/cam0/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
            "/cam0/camera_info": "sensor_msgs/msg/CameraInfo",
            "/twist": "geometry_msgs/msg/TwistStamped",
        }
        open_ = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
        for number, picture in enumerate(pictures(frames, height, width)):
            stamp = START + number * 10**8
            time_ = make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
            header = make("std_msgs/msg/Header", stamp=time_, frame_id="cam0")
            jpeg = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
            contents: list[dict[str, Any]] = [
                {"format": "jpeg", "data": jpeg},
                {**size, **lens},
                {"twist": make("geometry_msgs/msg/Twist", linear=forward, angular=still)},
            ]
            for (topic, kind), content in zip(topics.items(), contents, strict=True):
                bag.write(open_[topic], stamp, store.serialize_cdr(make(kind, header=header, **content), kind))


def write_video(path: Path, frames: int, height: int, width: int) -> None:
    """Write a video, and its camera file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as out:
        stream: Any = out.add_stream("libx264", rate=10, options={"preset": "ultrafast", "g": "50"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for number, picture in enumerate(pictures(frames, height, width)):
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
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
    parser.add_argument("--size", type=int, nargs=2, default=(96, 160), help="height and width of the pictures")
    parser.add_argument("--source", choices=("bag", "video"), default="bag")
    parser.add_argument("--stages", nargs="+", choices=("import", "doctor", "train", "predict"), default=())
    options = parser.parse_args()
    folder: Path = options.folder
    bag, clips = folder / f"drive_{options.frames}", folder / "clips"
    clip = clips / bag.name / "cam0_image_raw_compressed"
    if options.source == "video":
        clip = clips / f"{bag.name}.mp4"
    recording, write = (bag, write_bag) if options.source == "bag" else (clip, write_video)
    if not recording.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write(recording, options.frames, *options.size)
    data = ["data=video", f"data.root={clip}", f"data.frames_cache={folder / 'cache'}", "data.height=64"]
    data += ["data.width=96", "data.workers=0", "data.static=keep", "data.fps=null"]
    commands = {
        "import": ["prepare", "import", f"input={bag}", f"folder={clips}"],
        "doctor": ["doctor", *data, f"output_dir={folder / 'doctor'}"],
        "train": ["train", "experiment=smoke", *data, f"output_dir={folder / 'run'}"],
        "predict": ["predict", f"input={clip}", f"checkpoint={folder / 'run'}", "outputs=[mp4,trajectory]",
                    f"output={folder / 'out'}"],
    }  # fmt: skip
    if options.source == "video":
        del commands["import"]
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
