"""How many frame triplets a core loads from KITTI's originals: saunet's loader beside a straightforward one.

The baselines are what most training code for this task does, written down plainly: decode with PIL, resize every frame
to four scales with an antialiasing filter, change the colors of every second sample on the CPU, convert everything to
float tensors; once with the full-size frames jittered too, as Monodepth2's code does. saunet decodes
and resizes with OpenCV, once a frame, and hands bytes over; crop, flip, color and scales are the device's work, whose
cost on the CPU is printed too for those who train there. One thread, processor time, files in the page cache::

    python benchmarks/loading.py --root DATA/kitti/raw
    python benchmarks/loading.py --root DATA/kitti/raw --cache DATA/cache    # also from copies made by saunet prepare
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image, ImageEnhance

import saunet
from saunet.data.loading.windows import Item, WindowDataset, collate

SIZE = (192, 640)
SCALES = 4
OFFSETS = (-1, 1)


class StraightforwardLoader:
    """Triplets as float tensors at four scales, with and without color jitter, by PIL.

    Args:
        triplets: Files of each triplet.
        native: Jitter and convert the full-size frames too, as Monodepth2's code does before it drops them.
    """

    def __init__(self, triplets: list[list[Path]], native: bool) -> None:
        self.triplets, self.native = triplets, native

    def __getitem__(self, index: int) -> dict[tuple[str, int, int], torch.Tensor]:
        random = np.random.default_rng(index)
        flip, jitter = random.random() < 0.5, random.random() < 0.5
        strength = (*random.uniform(0.8, 1.2, 3), random.uniform(-0.1, 0.1))
        sample: dict[tuple[str, int, int], torch.Tensor] = {}
        for number, path in enumerate(self.triplets[index]):
            with open(path, "rb") as file:
                image = Image.open(file).convert("RGB")
            if flip:
                image = image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
            if self.native:
                sample["color", number, -1] = to_tensor(image)
                sample["jittered", number, -1] = to_tensor(change_colors(image, *strength) if jitter else image)
            for scale in range(SCALES):
                image = image.resize((SIZE[1] >> scale, SIZE[0] >> scale), Image.Resampling.LANCZOS)
                sample["color", number, scale] = to_tensor(image)
                sample["jittered", number, scale] = to_tensor(change_colors(image, *strength) if jitter else image)
        return {key: value for key, value in sample.items() if key[-1] >= 0}


def change_colors(image: Any, brightness: float, contrast: float, saturation: float, hue: float) -> Any:
    """Change brightness, contrast, saturation and hue of a PIL image, one after the other."""
    image = ImageEnhance.Brightness(image).enhance(brightness)
    image = ImageEnhance.Contrast(image).enhance(contrast)
    image = ImageEnhance.Color(image).enhance(saturation)
    h, s, v = image.convert("HSV").split()
    turned = Image.fromarray((np.asarray(h).astype(np.int16) + round(hue * 255)).astype(np.uint8))
    return Image.merge("HSV", (turned, s, v)).convert("RGB")


def to_tensor(image: Any) -> torch.Tensor:
    """Convert a PIL image to a float tensor, 3 x h x w, in [0, 1]."""
    return torch.from_numpy(np.array(image)).permute(2, 0, 1).contiguous().float().div(255)


def milliseconds(load: Callable[[int], Any], count: int, repeats: int) -> float:
    """Return the processor time of one call, the best of several rounds over all items."""
    load(0)
    rounds = []
    for _ in range(repeats):
        began = time.process_time()
        for index in range(count):
            load(index)
        rounds.append((time.process_time() - began) / count)
    return 1000 * min(rounds)


def dataset(root: Path, **options: Any) -> Any:
    """Return the data module over all triplets of a KITTI folder."""
    data = saunet.build(
        "data", "kitti", root=str(root), split="all", cameras=["left"], height=SIZE[0], width=SIZE[1], workers=0,
        batch_size=1, offsets=OFFSETS, **options,
    )  # fmt: skip
    data.setup("fit")
    return data


def files(windows: WindowDataset) -> list[list[Path]]:
    """Return the image files of each triplet."""
    found = []
    for position, frame in windows.windows:
        drive: Any = windows.drives[position]
        found.append([Path(drive.path(frame + offset)) for offset in (0, *OFFSETS)])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="folder in KITTI's raw layout, with the original PNGs")
    parser.add_argument("--cache", type=Path, help="folder of prepared copies")
    parser.add_argument("--triplets", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--output", type=Path, help="also write the figures to this JSON file")
    options = parser.parse_args()
    cv2.setNumThreads(0)
    torch.set_num_threads(1)

    data = dataset(options.root)
    ours: WindowDataset = data.datasets["train"]
    count = min(options.triplets, len(ours))
    baseline = StraightforwardLoader(files(ours), native=False)
    monodepth2 = StraightforwardLoader(baseline.triplets, native=True)
    height, width = cv2.imread(str(baseline.triplets[0][0])).shape[:2]
    batch: Any = collate([ours[Item(0, 0)]])
    figures = {
        "PIL, as Monodepth2's code does it": milliseconds(monodepth2.__getitem__, count, options.repeats),
        "PIL, straightforward": milliseconds(baseline.__getitem__, count, options.repeats),
        "floor: decode and resize with OpenCV": milliseconds(
            lambda i: [
                cv2.resize(cv2.imread(str(path)), SIZE[::-1], interpolation=cv2.INTER_AREA)
                for path in baseline.triplets[i]
            ],
            count,
            options.repeats,
        ),
        "saunet": milliseconds(lambda i: collate([ours[Item(i, i)]]), count, options.repeats),
    }
    if options.cache:
        prepared = dataset(options.root, cache=str(options.cache)).datasets["train"]
        figures["saunet, prepared copies"] = milliseconds(
            lambda i: collate([prepared[Item(i, i)]]), count, options.repeats
        )
    augment = milliseconds(lambda i: data.on_after_batch_transfer(batch, 0), count, options.repeats)

    print(f"{count} triplets of {width}x{height} -> {SIZE[1]}x{SIZE[0]}, one core")
    for name, each in figures.items():
        faster = "  ".join(f"{other / each:5.1f} x" for other in list(figures.values())[:2])
        print(f"{name:55s} {each:7.1f} ms a triplet  {3000 / each:6.0f} images/s  {faster}")
    print(f"{'device transforms of saunet, where the device is a CPU':55s} {augment:7.1f} ms a triplet")
    if options.output:
        options.output.write_text(json.dumps({"milliseconds": figures, "device_transforms": augment}, indent=2))


if __name__ == "__main__":
    main()
