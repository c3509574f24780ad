"""From a video to depth as 16-bit PNG files with `street`, beside Monodepth2's own script on the same frames, in turn.

Both see 640x192, decoding and writing included; loading the models is not counted for ours, and takes their script a
fraction of a second. Their script (``test_simple.py``, ResNet-18) runs as published with random weights; it cannot read
videos and gets the frames as JPEGs. It writes disparity as ``.npy`` and in colors, ours depth as 16-bit PNG. Without
writing is our run with no result kept::

    git clone https://github.com/nianticlabs/monodepth2
    OMP_NUM_THREADS=2 python benchmarks/video_speed.py monodepth2 --runtimes torch openvino openvino-bf16
    OMP_NUM_THREADS=1 python benchmarks/video_speed.py monodepth2 --size 128 416
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import statistics
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import torch
from index_speed import landscape
from peer_step import put_on_path

import saunet
from saunet.io.images import resize, write_image
from saunet.io.video import VideoWriter
from saunet.prediction.predictor import Predictor
from saunet.prediction.runtimes import choose_runtime
from saunet.prediction.sinks import fill
from saunet.prediction.sources import Recording
from saunet.prediction.tool import RUNTIMES

MODEL = "mono_640x192"
"""A name that their script knows; the weights are random."""


def make(folder: Path, frames: int, height: int, width: int) -> Path:
    """Write a clip as a video and as JPEGs, and return the video."""
    world, video = landscape(0), folder / "clip.mp4"
    with VideoWriter(video, 10) as writer:
        for number in range(frames):
            picture = resize(world[:192, 9 * number :][:, :640], height, width)
            writer.write(picture)
            write_image(folder / "frames" / f"{number:06d}.jpg", picture)
    return video


def theirs(clone: Path, folder: Path) -> Callable[[], object]:
    """Return a run of their script over the JPEGs; results lie beside these, as it wants it."""
    put_on_path(clone)
    import networks
    from test_simple import test_simple

    encoder = networks.ResnetEncoder(18, False)
    decoder = networks.DepthDecoder(encoder.num_ch_enc, range(4))
    weights = folder / "models" / MODEL
    weights.mkdir(parents=True)
    torch.save({**encoder.state_dict(), "height": 192, "width": 640}, weights / "encoder.pth")
    torch.save(decoder.state_dict(), weights / "depth.pth")
    for name in ("pose_encoder.pth", "pose.pth"):
        (weights / name).touch()
    given = Namespace(
        image_path=str(folder / "frames"), model_name=MODEL, ext="jpg", no_cuda=True, pred_metric_depth=False
    )

    def run() -> None:
        before = Path.cwd()
        os.chdir(folder)
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                test_simple(given)
        finally:
            os.chdir(before)

    return run


def ours(runtime: str, size: tuple[int, int], video: Path, folder: Path) -> dict[str, Callable[[], object]]:
    """Return runs of `saunet.predict` in a runtime, and of all but the writing."""
    network = Predictor.from_checkpoint("street").network
    predictor = choose_runtime(Predictor(network, *size), "street", runtime)
    options = saunet.PredictOptions(input=video, output=folder / runtime, outputs=["png16"], overwrite=True)

    def without_writing() -> None:
        with contextlib.closing(Recording(video, folder)) as recording:
            fill(predictor, recording, [], 0.95, 1, None)

    def predict() -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            saunet.predict(options, predictor)

    return {f"street, {runtime}": predict, f"street, {runtime}, without writing": without_writing}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a clone of Monodepth2's repository")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frame-size", type=int, nargs=2, default=(192, 640), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--size", type=int, nargs=2, default=(192, 640), help="what street sees; as shipped 128 416")
    parser.add_argument("--runtimes", nargs="+", default=["torch"], choices=RUNTIMES[1:])
    given = parser.parse_args()
    sizes = f"{given.frame_size[1]}x{given.frame_size[0]}, street at {given.size[1]}x{given.size[0]}"
    print(f"{given.frames} frames of {sizes}, {torch.get_num_threads()} threads")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        video = make(folder, given.frames, *given.frame_size)
        runs: dict[str, Callable[[], object]] = {"Monodepth2": theirs(given.folder.resolve(), folder)}
        for runtime in given.runtimes:
            runs |= ours(runtime, tuple(given.size), video, folder)
        wall: dict[str, list[float]] = {who: [] for who in runs}
        processor: dict[str, list[float]] = {who: [] for who in runs}
        for turn in range(given.rounds + 1):
            for who, run in runs.items():
                times = time.process_time(), time.perf_counter()
                run()
                if turn:  # the first warms up
                    processor[who].append(time.process_time() - times[0])
                    wall[who].append(time.perf_counter() - times[1])
    for who in runs:
        frame = f"{1000 * statistics.median(processor[who]) / given.frames:.1f} ms of processor time a frame"
        rate = f"{given.frames / statistics.median(wall[who]):.1f} frames/s"
        spread = " to ".join(f"{given.frames / each:.1f}" for each in (max(wall[who]), min(wall[who])))
        print(f"{who:40} {rate} ({spread}), {frame}, {_times(wall, who)} on the wall, {_times(processor, who)}")


def _times(times: dict[str, list[float]], who: str) -> str:
    """Return how many times as fast as Monodepth2 a run is, with the spread over the rounds."""
    ratios = [their / own for their, own in zip(times["Monodepth2"], times[who], strict=True)]
    return f"{statistics.median(ratios):.2f} times as fast ({min(ratios):.2f} to {max(ratios):.2f})"


if __name__ == "__main__":
    main()
