"""A trained model in half precision as a small folder: how the models that come with saunet are made.

```
python -m saunet.exporting.box outputs/street/checkpoints/best.ckpt src/saunet/weights/street \
    --images 'pictures/*.png' --evaluation outputs/evaluate --command 'saunet train experiment=street'
```
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from saunet.errors import CheckpointError, ConfigError, SaunetError
from saunet.exporting.card import describe_node, quality_lines
from saunet.exporting.tool import named_state, public_record, random_images, read_metrics, real_images
from saunet.io.atomic import replacing, write_bytes, write_json
from saunet.models.depth import DepthNet
from saunet.prediction.prediction import unit_of
from saunet.runs.record import ModelRecord
from saunet.weights.files import read_model, write_safetensors
from saunet.weights.locate import CARD, CONFIG, POSE, WEIGHTS

DEPTH_TOLERANCE = 0.01
"""Largest mean relative change of depth that rounding may cause."""


@dataclass(frozen=True, slots=True)
class Rounding:
    """What half precision changes, over all images it was measured on."""

    images: int
    """Images, random and real."""
    depth_max: float
    """Largest relative change of depth at any pixel."""
    depth_mean: float
    """Mean relative change of depth of the image that changes most."""
    motion: float | None
    """Largest change of a predicted motion, the length of its translation and the angle of its rotation (radians)
    together, as a fraction of that motion; None without a pose network."""
    megabytes: tuple[float, ...]
    """Size of the file of the depth network, and of the pose network, in 10⁶ bytes."""

    def __str__(self) -> str:
        text = (
            f"half precision changes depth by at most {100 * self.depth_max:.2g} % and on average by "
            f"{100 * self.depth_mean:.2g} % ({self.images} images)"
        )
        if self.motion is not None:
            text += f", motion by at most {100 * self.motion:.2g} %"
        return f"{text}; {' + '.join(f'{size:.2f}' for size in self.megabytes)} MB"


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

    Convolution and projection weights become float16; biases and the statistics of normalization, which are few, stay
    as they are. The depth network is ``model.safetensors``, the pose network ``pose.safetensors``, and
    `saunet.load`, ``checkpoint=`` and ``init_from=`` take the folder as they take an exported one. The folder's name
    becomes the model's name.

    Args:
        source: A checkpoint or any other model that `saunet.load` takes, but ONNX.
        folder: Where the files go; made if need be.
        images: Real images to measure the rounding on, besides random ones; at most eight are taken, evenly.
        evaluations: Folders of ``saunet evaluate``; their results go into the card.
        command: How the model was made; goes into the card.
        overwrite: Replace an earlier model in the folder.

    Returns:
        What the rounding changes.

    Raises:
        ConfigError: if the folder holds a model, and ``overwrite`` is not set, or is the source itself.
        CheckpointError: if the source cannot be read, or rounding changes depth by more than `DEPTH_TOLERANCE`.
        DataError: if an image or evaluation cannot be read, or the system refuses to write.
    """
    folder, read = Path(folder), read_model(source)
    if read.path.resolve().parent == folder.resolve():
        raise ConfigError(f"the output folder {folder} holds the model itself; choose another")
    present = [name for name in (CONFIG, WEIGHTS, POSE, CARD) if (folder / name).exists()]
    if present and not overwrite:
        raise ConfigError(f"{folder} holds {present[0]} already; choose another folder, or set overwrite")
    metrics = [read_metrics(path) for path in evaluations]
    record = public_record(read.record)
    whole, halved = read.networks(), read.networks()
    files = [(WEIGHTS, {"depth": whole[0]})] + ([(POSE, {"pose": whole[1]})] if whole[1] is not None else [])
    states = {name: {key: _half(key, value) for key, value in named_state(parts).items()} for name, parts in files}
    for part, network in (("depth", halved[0]), ("pose", halved[1])):
        if network is not None:
            state = states[WEIGHTS if part == "depth" else POSE]
            network.load_state_dict({key.removeprefix(f"{part}."): value for key, value in state.items()})
    inputs = [torch.from_numpy(image) for image in (*random_images(record), *real_images(record, images))]
    largest, mean = _depth_change(whole[0], halved[0], inputs)
    if not mean <= DEPTH_TOLERANCE:  # NaN too
        raise CheckpointError(
            f"half precision changes the depth of {source} by {100 * mean:.2g} % on average, more than "
            f"{100 * DEPTH_TOLERANCE:g} %, so nothing is written; export it with formats=[safetensors] instead"
        )
    motion = None if whole[1] is None or halved[1] is None else _motion_change(whole[1], halved[1], record, inputs)
    for name in present:  # the record first: what is left must not be taken for the new model
        (folder / name).unlink()
    for name, tensors in states.items():
        with replacing(folder / name) as temporary:
            write_safetensors(tensors, temporary)
    sizes = tuple(round((folder / name).stat().st_size / 1e6, 2) for name in states)
    rounding = Rounding(len(inputs), largest, mean, motion, sizes)
    write_bytes(folder / CARD, _card(folder.resolve().name, record, rounding, metrics, command).encode())
    write_json(folder / CONFIG, record.to_plain())  # last: with it, the folder is a model
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
    skew = motion[..., :3, :3] - motion[..., :3, :3].transpose(-1, -2)
    sine = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1).norm(dim=-1) / 2
    cosine = (motion[..., 0, 0] + motion[..., 1, 1] + motion[..., 2, 2] - 1) / 2
    size: Tensor = motion[..., :3, 3].norm(dim=-1) + torch.atan2(sine, cosine)
    return size


def _card(
    name: str, record: ModelRecord, rounding: Rounding, metrics: Sequence[Mapping[str, Any]], command: str
) -> str:
    parts = {"encoder": record.encoder, "decoder": record.decoder, "pose": record.pose}
    quality = [line for each in metrics for line in ["", *quality_lines(each)]]
    lines = [
        f"# {name}",
        "",
        f"Depth of driving scenes from one RGB image; comes with saunet: `saunet.load({json.dumps(name)})`.",
        "",
        "| | |",
        "|---|---|",
        f"| input | RGB, {record.width} x {record.height} (width x height); other sizes are resized |",
        f"| depth | {record.min_depth:g} to {record.max_depth:g}, {unit_of(record.scale)} |",
        *(f"| {slot} | {describe_node(node)} |" for slot, node in parts.items() if node is not None),
        f"| precision | float16 weights; {rounding} |",
        "",
        "## How it was made",
        "",
        *(["```", command, "```"] if command else ["The command was not recorded."]),
        "",
        "## Data",
        "",
        "```json",
        json.dumps(record.to_plain()["data"], indent=2),
        "```",
        "",
        "## Quality",
        *(quality or ["", "Not evaluated when this was packed."]),
        "",
        "## Limits",
        "",
        "Quality drops with scenes, cameras, mounting heights and weather unlike those above. Mirrors, glass, the sky, "
        "and whatever moves along with the camera can come out too far or too near. Not for safety.",
        "",
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m saunet.exporting.box``.

    Raises:
        SystemExit: with one sentence, for what a user can fix.
    """
    parser = argparse.ArgumentParser(prog="python -m saunet.exporting.box", description=pack.__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("source", help="a checkpoint, or an exported folder")
    parser.add_argument("folder", help="where the files go; its name becomes the model's")
    parser.add_argument("--images", nargs="*", default=[], help="real images to measure the rounding on")
    parser.add_argument("--evaluation", nargs="*", default=[], help="folders of saunet evaluate, for the card")
    parser.add_argument("--command", default="", help="how the model was made, for the card")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier model in the folder")
    given = parser.parse_args(arguments)
    try:
        rounding = pack(
            given.source,
            given.folder,
            images=given.images,
            evaluations=given.evaluation,
            command=given.command,
            overwrite=given.overwrite,
        )
    except SaunetError as error:
        sys.exit(f"saunet.exporting.box: {error}")
    print(f"{given.folder}: {rounding}")


if __name__ == "__main__":
    main()
