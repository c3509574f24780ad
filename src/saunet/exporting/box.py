"""A trained model in half precision as a small folder; this makes the models that come with saunet.

```
python -m saunet.exporting.box outputs/street/checkpoints/best.ckpt src/saunet/weights/street \
    --images 'pictures/*.png' --evaluation outputs/evaluate --command 'saunet train experiment=street'
```
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from saunet.errors import CheckpointError, SaunetError
from saunet.exporting.card import filled, quality_table
from saunet.exporting.parity import random_images
from saunet.exporting.tool import (
    check_target,
    named_state,
    public_record,
    read_metrics,
    real_images,
    remove,
)
from saunet.io.atomic import replacing, write_bytes, write_json
from saunet.models.depth import DepthNet
from saunet.runs.record import ModelRecord
from saunet.weights.files import read_model, write_safetensors
from saunet.weights.locate import CARD, CONFIG, POSE, WEIGHTS

DEPTH_TOLERANCE = 0.01
"""Largest mean relative change of depth that rounding may cause."""


@dataclass(frozen=True, slots=True)
class Rounding:
    """The changes from half precision, over all measured images."""

    images: int
    """Number of images, random and real."""
    depth_max: float
    """Largest relative change of depth at any pixel."""
    depth_mean: float
    """Mean relative change of depth, of the image that changes most."""
    motion: float | None
    """Largest change of a predicted motion, the length of its translation and the angle of its rotation (radians)
    together, as a fraction of that motion; None without a pose network."""
    megabytes: tuple[float, ...]
    """Size of the file of the depth network, and of the pose network, in 10⁶ bytes."""

    def __str__(self) -> str:
        moved = "" if self.motion is None else f", motion by at most {100 * self.motion:.2g} %"
        return (
            f"half precision changes depth by at most {100 * self.depth_max:.2g} % and on average by "
            f"{100 * self.depth_mean:.2g} % ({self.images} images){moved}; "
            f"{' + '.join(f'{size:.2f}' for size in self.megabytes)} MB"
        )


def pack(
    source: str | Path,
    folder: str | Path,
    *,
    images: str | Path | Sequence[str | Path] = (),
    evaluations: Sequence[str | Path] = (),
    command: str = "",
    overwrite: bool = False,
) -> Rounding:
    """Write a trained model's networks in half precision, its record and its card into a folder.

    Convolution and projection weights become float16; the few biases and normalization statistics stay unchanged. The
    depth network is ``model.safetensors``, the pose network ``pose.safetensors``, and `saunet.load`, ``checkpoint=``
    and ``init_from=`` accept the folder like an exported one. The folder's name becomes the model's name. The rounding
    error is measured on random and real images, and at most `DEPTH_TOLERANCE`; the command that made the model and the
    results of evaluations go into the card.
    """
    folder, read = Path(folder), read_model(source)
    earlier = check_target(folder, read.path, (CONFIG, WEIGHTS, POSE, CARD), overwrite)
    metrics = [read_metrics(path) for path in evaluations]
    record = public_record(read.record)
    whole, halved = read.networks(), read.networks()
    states = dict[str, dict[str, Tensor]]()
    for file, part, before, after in zip((WEIGHTS, POSE), ("depth", "pose"), whole, halved, strict=True):
        if before is not None and after is not None:
            states[file] = {key: _half(key, value) for key, value in named_state({part: before}).items()}
            after.load_state_dict({key.removeprefix(f"{part}."): value for key, value in states[file].items()})
    inputs = [
        torch.from_numpy(image) for image in (*random_images(record.height, record.width), *real_images(record, images))
    ]
    largest, mean = _depth_change(whole[0], halved[0], inputs)
    if not mean <= DEPTH_TOLERANCE:  # NaN too
        raise CheckpointError(
            f"half precision changes the depth of {source} by {100 * mean:.2g} % on average, more than "
            f"{100 * DEPTH_TOLERANCE:g} %, so nothing is written; use saunet export with formats=[safetensors] "
            "instead"
        )
    motion = None if whole[1] is None or halved[1] is None else _motion_change(whole[1], halved[1], record, inputs)
    remove(earlier)
    for name, tensors in states.items():
        with replacing(folder / name) as temporary:
            write_safetensors(tensors, temporary)
    sizes = tuple(round((folder / name).stat().st_size / 1e6, 2) for name in states)
    rounding = Rounding(len(inputs), largest, mean, motion, sizes)
    quality = "\n\n".join(quality_table(each).markdown() for each in metrics)
    card = filled(
        "box.md",
        record,
        name=folder.resolve().name,
        rounding=str(rounding),
        command=f"```\n{command}\n```" if command else "The command was not recorded.",
        quality=quality or "Not evaluated when this was packed.",
    )
    write_bytes(folder / CARD, card.encode())
    write_json(folder / CONFIG, record.to_plain())  # last: it makes the folder a model
    return rounding


def _half(name: str, value: Tensor) -> Tensor:
    if value.ndim < 2 or not value.is_floating_point():
        return value
    half = value.half()
    if value.isfinite().all() and not half.isfinite().all():
        raise CheckpointError(f"'{name}' reaches {value.abs().max():.2g}, beyond half precision; nothing is written")
    return half


@torch.inference_mode()
def _depth_change(whole: DepthNet, halved: DepthNet, images: Sequence[Tensor]) -> tuple[float, float]:
    """Return the largest relative change of depth at a pixel, and the largest mean over an image."""
    changes = []
    for image in images:
        before, after = (network.eval()(image).depth[0] for network in (whole, halved))
        changes.append((after - before).abs() / before)
    largest, mean = torch.stack([change.max() for change in changes]), torch.stack([c.mean() for c in changes])
    return largest.max().item(), mean.max().item()


@torch.inference_mode()
def _motion_change(whole: nn.Module, halved: nn.Module, record: ModelRecord, images: Sequence[Tensor]) -> float:
    """Return the largest change of a motion between neighboring images of the list, as a fraction of the motion."""
    largest = 0.0
    for index, target in enumerate(images):
        sources = [images[(index + shift) % len(images)] for shift in range(1, len(record.offsets) + 1)]
        motions = [network.eval()(target, torch.stack(sources, 1)) for network in (whole, halved)]
        apart = _size(torch.linalg.inv(motions[0]) @ motions[1]) / _size(motions[0]).clamp(min=1e-6)
        largest = max(largest, apart.max().item())
    return largest


def _size(motion: Tensor) -> Tensor:
    """Return the length of the translation plus the angle of the rotation of b s 4 4 motions."""
    turned = (motion[..., :3, :3] - torch.eye(3)).flatten(-2).norm(dim=-1)  # the square root of 8 times sin(angle / 2)
    size: Tensor = motion[..., :3, 3].norm(dim=-1) + 2 * torch.asin((turned / 8**0.5).clamp(max=1))
    return size


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m saunet.exporting.box``; what a user can fix is one sentence."""
    parser = argparse.ArgumentParser(prog="python -m saunet.exporting.box", description=pack.__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("source", help="a checkpoint, or an exported folder")
    parser.add_argument("folder", help="folder for the files; its name becomes the model's")
    parser.add_argument("--images", nargs="*", default=[], help="real images to measure the rounding error on")
    parser.add_argument(
        "--evaluation", nargs="*", default=[], dest="evaluations", help="folders of saunet evaluate, for the card"
    )
    parser.add_argument("--command", default="", help="how the model was made, for the card")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier model in the folder")
    given = parser.parse_args(arguments)
    try:
        rounding = pack(**vars(given))
    except SaunetError as error:
        sys.exit(f"saunet.exporting.box: {error}")
    print(f"{given.folder}: {rounding}")


if __name__ == "__main__":
    main()
