"""Models of other systems: from tables of what their files hold, the depth that their published formulas give.

The forward passes here are written from those formulas over the files' own names; they share no code with saunet.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

import saunet
from saunet.errors import CheckpointError
from saunet.exporting.tool import ExportOptions, export
from saunet.io.plain import read_torch
from saunet.runs.record import Scale
from saunet.scale.storing import scale_file
from saunet.weights.files import read_model

State = dict[str, Tensor]
HEIGHT, WIDTH = 64, 96


# What files hold: names and shapes.


def conv(
    state: State, name: str, outputs: int, inputs: int, *kernel: int, bias: bool = True, gain: float = 1.4
) -> None:
    fan_in = inputs * math.prod(kernel)
    state[f"{name}.weight"] = torch.randn(outputs, inputs, *kernel) * gain / fan_in**0.5
    if bias:
        state[f"{name}.bias"] = 0.1 * torch.randn(outputs)


def affine(state: State, name: str, channels: int) -> None:
    state[f"{name}.weight"], state[f"{name}.bias"] = 1 + 0.1 * torch.randn(channels), 0.1 * torch.randn(channels)


def batch_norm(state: State, name: str, channels: int) -> None:
    affine(state, name, channels)
    state[f"{name}.running_mean"], state[f"{name}.running_var"] = torch.randn(channels), 0.5 + torch.rand(channels)
    state[f"{name}.num_batches_tracked"] = torch.tensor(7)


def resnet(front: str, frames: int = 1, classifier: bool = True) -> State:
    """One basic block a stage."""
    state: State = {}
    conv(state, f"{front}conv1", 64, 3 * frames, 7, 7, bias=False)
    batch_norm(state, f"{front}bn1", 64)
    for stage, (inputs, width) in enumerate(((64, 64), (64, 128), (128, 256), (256, 512)), 1):
        block = f"{front}layer{stage}.0"
        for number, channels in ((1, inputs), (2, width)):
            conv(state, f"{block}.conv{number}", width, channels, 3, 3, bias=False)
            batch_norm(state, f"{block}.bn{number}", width)
        if inputs != width:
            conv(state, f"{block}.downsample.0", width, inputs, 1, 1, bias=False)
            batch_norm(state, f"{block}.downsample.1", width)
    if classifier:
        conv(state, f"{front}fc", 1000, 512)
    return state


class Places(NamedTuple):
    """Where a decoder's convolutions stand in a file: by step from coarse to fine, and by scale."""

    first: str
    second: str
    head: str
    step: int = 1
    """How much the number grows from step to step."""
    heads_from: int = 0

    def names(self, index: int) -> tuple[str, str]:
        second = self.step * index + (self.step - 1)
        return self.first.format(self.step * index), self.second.format(second)


MONODEPTH2 = Places("decoder.{}.conv.conv", "decoder.{}.conv.conv", "decoder.{}.conv", 2, 10)
LITE_MONO = MONODEPTH2._replace(heads_from=6)
SC_DEPTH = Places(
    "depth_net.decoder.upconvs0.{}.conv.conv",
    "depth_net.decoder.upconvs1.{}.conv.conv",
    "depth_net.decoder.dispconvs.{}.conv",
)
SLOWTV = Places(*[f"nets.depth.decoders.disp.decoder.{{}}{end}" for end in (".conv", ".conv", "")], 2, 10)
RESNET_SKIPS = (64, 64, 128, 256, 512)


def decoder(
    at: Places, skips: tuple[int, ...], widths: tuple[int, ...], scales: int, outputs: int = 1, gain: float = 3
) -> State:
    state: State = {}
    inputs = skips[-1]
    for index, level in enumerate(reversed(range(len(widths)))):
        first, second = at.names(index)
        conv(state, first, widths[level], inputs, 3, 3)
        conv(state, second, widths[level], widths[level] + (skips[level - 1] if level else 0), 3, 3)
        inputs = widths[level]
    for scale in range(scales):
        conv(state, at.head.format(at.heads_from + scale), outputs, widths[scale], 3, 3, gain=gain)
    return state


def lite_mono(dims: tuple[int, int, int], depths: tuple[int, int, int]) -> State:
    state: State = {}
    for index in range(3):
        conv(state, f"downsample_layers.0.{index}.conv", dims[0], dims[0] if index else 3, 3, 3, bias=False)
        batch_norm(state, f"downsample_layers.0.{index}.bn_gelu.bn", dims[0])
    for name, inputs, outputs in (
        ("stem2", dims[0] + 3, dims[0]),
        ("downsample_layers.1", 2 * dims[0] + 3, dims[1]),
        ("downsample_layers.2", 2 * dims[1] + 3, dims[2]),
    ):
        conv(state, f"{name}.0.conv", outputs, inputs, 3, 3, bias=False)
    for stage, (dim, depth) in enumerate(zip(dims, depths, strict=True)):
        for index in range(depth):
            block, last = f"stages.{stage}.{index}", index == depth - 1
            if last and stage == 0:
                conv(state, f"{block}.pos_embd.token_projection", dim, 64, 1, 1)
            if last:
                affine(state, f"{block}.norm_xca", dim)
                state[f"{block}.gamma_xca"] = 0.3 * torch.randn(dim)
                state[f"{block}.xca.temperature"] = 1 + torch.rand(8, 1, 1)
                conv(state, f"{block}.xca.qkv", 3 * dim, dim)
                conv(state, f"{block}.xca.proj", dim, dim)
            else:
                conv(state, f"{block}.ddwconv.conv", dim, 1, 3, 3, bias=False)
                batch_norm(state, f"{block}.bn1", dim)
            affine(state, f"{block}.norm", dim)  # a dilated block declares it too, and never uses it
            conv(state, f"{block}.pwconv1", 6 * dim, dim)
            conv(state, f"{block}.pwconv2", dim, 6 * dim)
            state[f"{block}.gamma"] = 0.3 * torch.randn(dim)
    return {**state, "total_ops": torch.zeros(1), "total_params": torch.zeros(1)}


def packnet(front: str, c: int, dropout: bool) -> State:
    state: State = {}

    def conv2d(name: str, outputs: int, inputs: int, kernel: int) -> None:
        conv(state, f"{front}{name}.conv_base", outputs, inputs, kernel, kernel)
        affine(state, f"{front}{name}.normalize", outputs)

    conv2d("pre_calc", c, 3, 5)
    conv2d("conv1", c, c, 7)
    for stage, blocks in ((2, 2), (3, 2), (4, 3), (5, 3)):
        for block in range(blocks):
            name = f"conv{stage}.{block}"
            conv2d(f"{name}.conv1", c, c, 3)
            conv2d(f"{name}.conv2", c, c, 3)
            conv(state, f"{front}{name}.conv3{'.0' if dropout else ''}", c, c, 1, 1)
            affine(state, f"{front}{name}.normalize", c)
    for level in range(1, 6):
        conv(state, f"{front}pack{level}.conv3d", 8, 1, 3, 3, 3)
        conv2d(f"pack{level}.conv", c, 4 * c * 8, 5 if level == 1 else 3)
        conv(state, f"{front}unpack{level}.conv3d", 8, 1, 3, 3, 3)
        conv2d(f"unpack{level}.conv", 4 * c // 8, c, 3)
        conv2d(f"iconv{level}", c, 2 * c + (1 if level < 4 else 0), 3)
    for level in range(1, 5):
        conv(state, f"{front}disp{level}_layer.conv1", 1, c, 3, 3, gain=3)
    return state


# What their networks compute.


def run(state: State, name: str, x: Tensor, **options: Any) -> Tensor:
    kind = F.conv3d if x.ndim == 5 else F.conv2d
    return kind(x, state[f"{name}.weight"], state.get(f"{name}.bias"), **options)


def normalized(state: State, name: str, x: Tensor) -> Tensor:
    entries = [state[f"{name}.{end}"] for end in ("running_mean", "running_var", "weight", "bias")]
    return F.batch_norm(x, *entries)


def run_resnet(state: State, front: str, x: Tensor) -> list[Tensor]:
    def bn(number: str, y: Tensor) -> Tensor:
        return normalized(state, f"{front}{number}", y)

    x = bn("bn1", run(state, f"{front}conv1", x, stride=2, padding=3)).relu()
    features = [x]
    x = F.max_pool2d(x, 3, 2, 1)
    for stage in range(1, 5):
        block, stride = f"layer{stage}.0", 2 if stage > 1 else 1
        y = bn(f"{block}.bn1", run(state, f"{front}{block}.conv1", x, stride=stride, padding=1)).relu()
        y = bn(f"{block}.bn2", run(state, f"{front}{block}.conv2", y, padding=1))
        if stage > 1:
            x = bn(f"{block}.downsample.1", run(state, f"{front}{block}.downsample.0", x, stride=2))
        x = (x + y).relu()
        features.append(x)
    return features


def run_decoder(state: State, at: Places, features: list[Tensor], levels: int, mode: str = "nearest") -> Tensor:
    """Return the finest sigmoid."""

    def reflected(name: str, y: Tensor) -> Tensor:
        return run(state, name, F.pad(y, (1, 1, 1, 1), mode="reflect"))

    x = features[-1]
    for index in range(levels):
        first, second = at.names(index)
        x = F.interpolate(F.elu(reflected(first, x)), scale_factor=2, mode=mode)
        if index < levels - 1:
            x = torch.cat([x, features[levels - 2 - index]], 1)
        x = F.elu(reflected(second, x))
    logits = reflected(at.head.format(at.heads_from), x)
    if at.heads_from == 6:  # Lite-Mono's finest map has half the size
        logits = F.interpolate(logits, scale_factor=2, mode="bilinear")
    return logits[:, :1].sigmoid()


def run_lite_mono(state: State, x: Tensor, depths: tuple[int, int, int], rates: list[list[int]]) -> list[Tensor]:
    x = (x - 0.45) / 0.225
    pooled = [F.avg_pool2d(x, 3, 2, 1)]
    for _ in range(2):
        pooled.append(F.avg_pool2d(pooled[-1], 3, 2, 1))
    for index in range(3):
        y = run(state, f"downsample_layers.0.{index}.conv", x, stride=1 if index else 2, padding=1)
        x = F.gelu(normalized(state, f"downsample_layers.0.{index}.bn_gelu.bn", y))
    parts, features = [x], []
    for stage, name in enumerate(("stem2", "downsample_layers.1", "downsample_layers.2")):
        x = run(state, f"{name}.0.conv", torch.cat([*parts, pooled[stage]], 1), stride=2, padding=1)
        parts = [x]
        for index in range(depths[stage]):
            block = f"stages.{stage}.{index}"
            if index < depths[stage] - 1:
                rate = rates[stage][index]
                y = run(state, f"{block}.ddwconv.conv", x, padding=rate, dilation=rate, groups=x.shape[1])
                tokens = normalized(state, f"{block}.bn1", y).permute(0, 2, 3, 1)
            else:
                tokens = attended(state, block, x)
            y = F.gelu(linear(state, f"{block}.pwconv1", tokens))
            y = state[f"{block}.gamma"] * linear(state, f"{block}.pwconv2", y)
            x = x + y.permute(0, 3, 1, 2)
        parts.append(x)
        features.append(x)
    return features


def linear(state: State, name: str, x: Tensor) -> Tensor:
    return F.linear(x, state[f"{name}.weight"], state[f"{name}.bias"])


def attended(state: State, block: str, x: Tensor) -> Tensor:
    """Positions, attention among channels, and a normalization, over b h w c."""
    batch, channels, height, width = x.shape
    if f"{block}.pos_embd.token_projection.weight" in state:
        code = torch.zeros(1, 64, height, width, dtype=x.dtype)
        for half, (side, axis) in enumerate(((height, 0), (width, 1))):
            phase = torch.arange(1, side + 1) / side * 2 * math.pi
            for wave in range(16):
                for odd, wavy in enumerate((torch.sin, torch.cos)):
                    line = wavy(phase / 10000 ** (2 * wave / 32))
                    plane = line[:, None] if axis == 0 else line[None, :]
                    code[0, 32 * half + 2 * wave + odd] = plane.expand(height, width)
        x = x + run(state, f"{block}.pos_embd.token_projection", code)
    tokens = x.flatten(2).transpose(1, 2)

    def layer_norm(name: str, y: Tensor) -> Tensor:
        return F.layer_norm(y, (channels,), state[f"{name}.weight"], state[f"{name}.bias"], 1e-6)

    qkv = linear(state, f"{block}.xca.qkv", layer_norm(f"{block}.norm_xca", tokens))
    q, k, v = (each.transpose(1, 2).reshape(batch, 8, channels // 8, -1) for each in qkv.chunk(3, -1))
    q, k = q / q.norm(dim=-1, keepdim=True), k / k.norm(dim=-1, keepdim=True)
    mixed = (q @ k.transpose(-1, -2) * state[f"{block}.xca.temperature"]).softmax(-1) @ v
    mixed = linear(state, f"{block}.xca.proj", mixed.reshape(batch, channels, -1).transpose(1, 2))
    tokens = tokens + state[f"{block}.gamma_xca"] * mixed
    return layer_norm(f"{block}.norm", tokens).reshape(batch, height, width, channels)


def run_packnet(state: State, front: str, x: Tensor, dropout: bool) -> Tensor:
    """Return inverse depth."""

    def norm(name: str, y: Tensor) -> Tensor:
        return F.elu(F.group_norm(y, 16, state[f"{front}{name}.weight"], state[f"{front}{name}.bias"]))

    def conv2d(name: str, y: Tensor) -> Tensor:
        side = state[f"{front}{name}.conv_base.weight"].shape[-1] // 2
        return norm(f"{name}.normalize", run(state, f"{front}{name}.conv_base", y, padding=side))

    def folded(name: str, y: Tensor) -> Tensor:
        return run(state, f"{front}{name}.conv3d", y[:, None], padding=1).flatten(1, 2)

    x = conv2d("pre_calc", x)
    skips = [x]
    for level in range(1, 6):
        if level == 1:
            x = conv2d("conv1", x)
        else:
            for block in range(2 if level < 4 else 3):
                name = f"conv{level}.{block}"
                y = conv2d(f"{name}.conv2", conv2d(f"{name}.conv1", x))
                x = norm(f"{name}.normalize", y + run(state, f"{front}{name}.conv3{'.0' if dropout else ''}", x))
        batch, channels, height, width = x.shape
        split = x.reshape(batch, channels, height // 2, 2, width // 2, 2).permute(0, 1, 3, 5, 2, 4)
        x = conv2d(f"pack{level}.conv", folded(f"pack{level}", split.reshape(batch, -1, height // 2, width // 2)))
        skips.append(x)
    inverse = None
    for level in range(5, 0, -1):
        x = F.pixel_shuffle(folded(f"unpack{level}", conv2d(f"unpack{level}.conv", x)), 2)
        parts = [x, skips[level - 1]]
        if inverse is not None:
            parts.append(F.interpolate(inverse, scale_factor=2, mode="nearest"))
        x = conv2d(f"iconv{level}", torch.cat(parts, 1))
        if level < 5:
            inverse = run(state, f"{front}disp{level}_layer.conv1", x, padding=1).sigmoid() / 0.5
    assert inverse is not None
    return inverse


def exact(*states: State) -> list[State]:
    """In double precision, where rounding does not grow through random networks."""
    return [{name: value.double() for name, value in state.items()} for state in states]


def to_depth(sigmoid: Tensor, near: float = 0.1, far: float = 100.0) -> Tensor:
    return 1 / (1 / far + (1 / near - 1 / far) * sigmoid)


# The families: a writer each, which returns what their code says of images.

Depth = Callable[[Tensor], Tensor]


def write_monodepth2(folder: Path, prefix: str = "", poses: bool = True, stereo: bool = False) -> Depth:
    encoder, depth = resnet("encoder."), decoder(MONODEPTH2, RESNET_SKIPS, (16, 32, 64, 128, 256), 4)
    facts = {"height": HEIGHT, "width": WIDTH, "use_stereo": stereo}
    save(folder / f"{prefix}encoder.pth", {**encoder, **({} if prefix else facts)})
    save(folder / f"{prefix}depth.pth", depth)
    if prefix:
        save(folder / "encoder.pth", {"layer0.0.weight": torch.zeros(1), "min_depth_bin": 0.1, **facts})
    if poses:
        save(folder / "pose_encoder.pth", resnet("encoder.", frames=2))
        head: State = {}
        for name, outputs, inputs, kernel in ((0, 256, 512, 1), (1, 256, 256, 3), (2, 256, 256, 3), (3, 12, 256, 1)):
            conv(head, f"net.{name}", outputs, inputs, kernel, kernel)
        save(folder / "pose.pth", head)
    encoder, depth = exact(encoder, depth)

    def forward(image: Tensor) -> Tensor:
        features = run_resnet(encoder, "encoder.", (image - 0.45) / 0.225)
        return to_depth(run_decoder(depth, MONODEPTH2, features, 5))

    return forward


def write_manydepth(folder: Path) -> Depth:
    return write_monodepth2(folder, prefix="mono_")


def write_lite_mono(folder: Path, width: int = 640) -> Depth:
    dims, depths = (8, 16, 24), (2, 3, 5)
    encoder, depth = lite_mono(dims, depths), decoder(LITE_MONO, dims, (4, 8, 12), 3, gain=0.1)
    height = {640: 192, 1024: 320}[width]
    save(folder / "encoder.pth", {**encoder, "height": height, "width": width, "use_stereo": False})
    save(folder / "depth.pth", depth)
    encoder, depth = exact(encoder, depth)
    rates = [[1], [1, 2], [1, 2, 4, 6]] if width == 640 else [[1], [1, 2], [1, 2, 4, 10]]

    def forward(image: Tensor) -> Tensor:
        return to_depth(run_decoder(depth, LITE_MONO, run_lite_mono(encoder, image, depths, rates), 3, "bilinear"))

    return forward


def write_wide_lite_mono(folder: Path) -> Depth:
    return write_lite_mono(folder, 1024)


def write_sc_depth(folder: Path) -> Depth:
    state = resnet("depth_net.encoder.encoder.")
    state |= decoder(SC_DEPTH, RESNET_SKIPS, (16, 32, 64, 128, 256), 4)
    others = resnet("pose_net.encoder.encoder.", frames=2)
    options = argparse.Namespace(dataset_name="kitti", resnet_layers=18)
    save(folder / "x.ckpt", {"state_dict": {**state, **others}, "hyper_parameters": {"hparams": options}, "epoch": 2})
    (state,) = exact(state)

    def forward(image: Tensor) -> Tensor:
        features = run_resnet(state, "depth_net.encoder.encoder.", (image - 0.45) / 0.225)
        return 1 / (10 * run_decoder(state, SC_DEPTH, features, 5, "bilinear") + 0.01)

    return forward


def write_slowtv(folder: Path, **trainer: float) -> Depth:
    front = "nets.depth.encoder."
    state = resnet(front, classifier=False)
    state |= decoder(SLOWTV, RESNET_SKIPS, (16, 32, 64, 128, 256), 4, outputs=3, gain=0.3)
    pose = resnet("nets.pose.encoder.", frames=2, classifier=False)
    for name, outputs, inputs, kernel in (
        ("squeeze.0", 256, 512, 1),
        ("decoders.pose.0.0", 256, 256, 3),
        ("decoders.pose.1.0", 256, 256, 3),
        ("decoders.pose.2", 12, 256, 1),
        ("decoders.focal.0.0", 256, 256, 3),
    ):
        conv(pose, f"nets.pose.{name}", outputs, inputs, kernel, kernel)
    config = {
        "net": {"depth": {"enc_name": "resnet18", "dec_name": "monodepth"}},
        "trainer": trainer,
        "dataset": {"kitti": {"val": {"shape": [192, 640]}}},
    }
    save(folder / "x.ckpt", {"state_dict": {**state, **pose}, "hyper_parameters": {"cfg": config}})
    (state,) = exact(state)

    def forward(image: Tensor) -> Tensor:
        mean, std = (
            torch.tensor(each, dtype=image.dtype)[:, None, None]
            for each in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
        )
        sigmoid = run_decoder(state, SLOWTV, run_resnet(state, front, (image - mean) / std), 5)
        return to_depth(sigmoid, trainer["min_depth"], trainer["max_depth"]) if trainer else 1 / sigmoid

    return forward


def write_limited_slowtv(folder: Path) -> Depth:
    return write_slowtv(folder, min_depth=0.1, max_depth=100)


class CfgNode(dict):  # type: ignore[type-arg]
    """Pickled as yacs' class of that name is."""


CfgNode.__module__, CfgNode.__qualname__ = "yacs.config", "CfgNode"


def write_packnet(folder: Path, dropout: bool = False) -> Depth:
    front = "model.depth_net."
    state = packnet(front, 32, dropout)
    pose: State = {}
    conv(pose, "model.pose_net.conv1.0", 16, 9, 7, 7)
    shape = CfgNode(datasets=CfgNode(augmentation=CfgNode(image_shape=(192, 640))))
    content = {"config": shape, "epoch": 1, "state_dict": {**state, **pose}, "optimizer": {}}
    save_with_yacs(content, folder / "x.ckpt")
    (state,) = exact(state)

    def forward(image: Tensor) -> Tensor:
        return 1 / run_packnet(state, front, image, dropout).clamp(min=1e-6)

    return forward


def save_with_yacs(content: object, path: Path) -> None:
    """Save as torch did until 1.5, with a class of a module that is then gone."""
    import sys
    import types

    module = types.ModuleType("yacs.config")
    module.CfgNode = CfgNode  # type: ignore[attr-defined]
    sys.modules["yacs"], sys.modules["yacs.config"] = types.ModuleType("yacs"), module
    try:
        torch.save(content, path, _use_new_zipfile_serialization=False)
    finally:
        del sys.modules["yacs"], sys.modules["yacs.config"]


def write_packnet_with_dropout(folder: Path) -> Depth:
    return write_packnet(folder, dropout=True)


def write_depth_resnet(folder: Path) -> Depth:
    front = "model.depth_net."
    encoder, depth = resnet("encoder."), decoder(MONODEPTH2, RESNET_SKIPS, (16, 32, 64, 128, 256), 4)
    named = {f"{front}encoder.{key}": value for key, value in encoder.items()}
    named |= {f"{front}decoder.{key}": value for key, value in depth.items()}
    save(folder / "x.ckpt", {"state_dict": named, "config": {}})
    encoder, depth = exact(encoder, depth)

    def forward(image: Tensor) -> Tensor:
        features = run_resnet(encoder, "encoder.", (image - 0.45) / 0.225)
        return to_depth(run_decoder(depth, MONODEPTH2, features, 5))

    return forward


def save(path: Path, content: Mapping[str, Any]) -> None:
    torch.save(dict(content), path)


FAMILIES: dict[Callable[[Path], Depth], tuple[tuple[int, int], str]] = {
    write_monodepth2: ((HEIGHT, WIDTH), ""),
    write_manydepth: ((HEIGHT, WIDTH), "several frames"),
    write_lite_mono: ((192, 640), ""),
    write_wide_lite_mono: ((320, 1024), ""),
    write_sc_depth: ((256, 832), "pose_net.*Euler"),
    write_slowtv: ((192, 640), r"nets\.pose\.decoders\.focal|virtual stereo"),
    write_limited_slowtv: ((192, 640), r"nets\.pose\.decoders"),
    write_packnet: ((192, 640), r"model\.pose_net.*Euler"),
    write_packnet_with_dropout: ((192, 640), "Euler"),
    write_depth_resnet: ((192, 640), "input size.*640x192"),
}
"""Each with the input size that is read from its files, and what is said to be left."""


def source(folder: Path) -> Path:
    return folder / "x.ckpt" if (folder / "x.ckpt").is_file() else folder


@pytest.mark.parametrize("write", FAMILIES, ids=lambda write: write.__name__.removeprefix("write_"))
def test_depth_is_that_of_their_code(
    write: Callable[[Path], Depth], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    torch.manual_seed(0)
    forward = write(tmp_path)
    size, left = FAMILIES[write]
    with caplog.at_level(logging.WARNING, "saunet"):
        checkpoint = read_model(source(tmp_path))
    assert (checkpoint.record.height, checkpoint.record.width) == size
    said = "; ".join(record.getMessage() for record in caplog.records)
    assert re.search(left, said) if left else not said
    depth = checkpoint.networks()[0].eval().double()
    width = 2 * WIDTH if "lite_mono" in write.__name__ else WIDTH  # its rates differ in what lies 6 or 10 pixels away
    image = torch.rand(1, 3, HEIGHT, width, dtype=torch.float64)
    with torch.no_grad():
        expected, found = forward(image), depth(image).depth[0]
    assert expected.amax() / expected.amin() > 1.1  # it depends on the image
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(1)
    folder = tmp_path_factory.mktemp("mono_64x96")
    write_monodepth2(folder)
    return folder


class TestMonodepth2:
    @pytest.fixture
    def copy(self, folder: Path, tmp_path: Path) -> Path:
        for each in folder.iterdir():
            os.link(each, tmp_path / each.name)
        return tmp_path

    def test_pose_network(self, folder: Path) -> None:
        pose = read_model(folder).networks()[1]
        assert pose is not None
        target, sources = torch.rand(1, 3, HEIGHT, WIDTH), torch.rand(1, 2, 3, HEIGHT, WIDTH)
        encoder, head = (torch.load(folder / name) for name in ("pose_encoder.pth", "pose.pth"))
        with torch.no_grad():
            found = pose.eval()(target, sources)[0]
            for index, pair in enumerate(([sources[:, 0], target], [target, sources[:, 1]])):
                x = run_resnet(encoder, "encoder.", (torch.cat(pair, 1) - 0.45) / 0.225)[-1]
                x = run(head, "net.0", x).relu()
                x = run(head, "net.2", run(head, "net.1", x, padding=1).relu(), padding=1).relu()
                motion = 0.01 * run(head, "net.3", x).mean((2, 3))[0, :6]
                cross = torch.zeros(3, 3)
                for (row, column), value in zip(((2, 1), (0, 2), (1, 0)), motion[:3], strict=True):
                    cross[row, column], cross[column, row] = value, -value
                expected = torch.eye(4)
                expected[:3, :3], expected[:3, 3] = torch.linalg.matrix_exp(cross), motion[3:]
                torch.testing.assert_close(found[index], expected if index else expected.inverse(), rtol=0, atol=1e-5)
                assert (expected - torch.eye(4)).abs().max() > 1e-3

    def test_it_predicts_and_exports_as_ours(self, folder: Path, tmp_path: Path) -> None:
        model = saunet.load(folder)
        image = np.random.default_rng(0).integers(0, 256, (50, 70, 3), dtype=np.uint8)
        prediction = model.predict(image)
        assert prediction.depth.shape == (50, 70)
        assert not prediction.metric
        export(ExportOptions(checkpoint=str(folder), output=str(tmp_path / "ours"), formats=["safetensors"]))
        again = saunet.load(tmp_path / "ours")
        assert again.fingerprint == model.fingerprint
        np.testing.assert_array_equal(again.predict(image).depth, prediction.depth)
        assert read_model(tmp_path / "ours").networks()[1] is not None

    def test_stereo_training_knows_meters(self, tmp_path: Path) -> None:
        write_monodepth2(tmp_path, stereo=True, poses=False)
        record = read_model(tmp_path).record
        assert record.scale == Scale(5.4, record.scale.source if record.scale else "")
        assert record.pose is None

    def test_a_scale_is_not_stored_into_their_files(self, folder: Path) -> None:
        with pytest.raises(CheckpointError, match=r"leave scale\.store out"):
            scale_file(folder)

    def test_a_part_alone_is_asked_for_with_its_folder(self, copy: Path) -> None:
        with pytest.raises(CheckpointError, match=r"one part of a model.*give its folder"):
            saunet.load(copy / "depth.pth")
        (copy / "depth.pth").unlink()
        with pytest.raises(CheckpointError, match=r"encoder\.pth but no depth\.pth"):
            saunet.load(copy)

    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("depth", {"decoder.13.conv.bias": None}, r"lacks 'depth\.pth:decoder\.13\.conv\.bias'"),
            ("depth", {"decoder.14.x": torch.zeros(1)}, r"'depth\.pth:decoder\.14\.x' belongs to no part"),
            ("depth", {"decoder.3.conv.conv.bias": torch.zeros(9)}, r"decoder\.3\.conv\.conv\.bias' is \(9,\)"),
            ("encoder", {"encoder.layer3.0.bn1.weight": None}, r"lacks 'encoder\.pth:encoder\.layer3\.0\.bn1\.weight'"),
            ("encoder", {"height": -1}, r"size is -1x96"),
            ("encoder", {"height": 1 << 30}, "pixels are allowed"),
            ("pose", {"net.2.bias": None}, r"lacks 'pose\.pth:net\.2\.bias'"),
        ],
    )
    def test_a_partial_file_is_one_sentence(self, name: str, change: dict[str, Any], message: str, copy: Path) -> None:
        content = torch.load(copy / f"{name}.pth") | change
        (copy / f"{name}.pth").unlink()
        save(copy / f"{name}.pth", {key: value for key, value in content.items() if value is not None})
        with pytest.raises(CheckpointError, match=message) as error:
            saunet.load(copy)
        assert str(copy) in str(error.value)
        assert "\n" not in str(error.value)

    @pytest.mark.parametrize(
        ("name", "content", "message"),
        [
            ("encoder", {"mhca_stages.0.x": torch.zeros(1)}, "not an encoder.*MPViT of MonoViT"),
            ("encoder", {"reduce_conv.0.weight": torch.zeros(1)}, "ManyDepth's network for several frames"),
            ("encoder", {"x": torch.zeros(1)}, "its first entry is 'x'"),
            ("encoder", {}, "has no weights"),
            ("depth", {"convs.f4.conv_se.weight": torch.zeros(1)}, "not a decoder.*nested decoder"),
        ],
    )
    def test_another_network_is_named(self, name: str, content: dict[str, Any], message: str, copy: Path) -> None:
        (copy / f"{name}.pth").unlink()
        save(copy / f"{name}.pth", content)
        with pytest.raises(CheckpointError, match=message):
            saunet.load(copy)

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ({"pose_conv.weight": torch.zeros(6, 256, 1, 1)}, "PoseCNN expects unnormalized images"),
            ({"net.1.weight": torch.zeros(256, 512, 3, 3)}, "does not get pairs"),
        ],
    )
    def test_a_pose_network_of_another_kind_is_left(
        self, content: State, message: str, copy: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        (copy / "pose.pth").unlink()
        save(copy / "pose.pth", content)
        with caplog.at_level(logging.WARNING, "saunet"):
            assert read_model(copy).networks()[1] is None
        assert re.search(f"not taken .*{message}", caplog.text)

    @pytest.mark.parametrize("name", ["encoder", "depth", "pose"])
    def test_a_damaged_file_is_one_sentence(self, name: str, copy: Path) -> None:
        data = (copy / f"{name}.pth").read_bytes()
        (copy / f"{name}.pth").unlink()
        (copy / f"{name}.pth").write_bytes(data[: len(data) // 2])
        with pytest.raises(CheckpointError, match=rf"{name}\.pth is damaged"):
            saunet.load(copy)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"depth_net.decoder.upconvs0.0.conv.conv.weight": torch.zeros(256, 512, 3, 3)}, "SC-Depth but is incomplete"),
        ({"nets.depth.encoder.conv1.weight": torch.zeros(1)}, "slowtv's decoder 'unknown'"),
        ({f"{SLOWTV.first.format(0)}.weight": torch.zeros(256, 9, 3, 3)}, "does not name the timm network"),
        ({"model.depth_net.x": torch.zeros(1)}, "'model.depth_net.x'.*PackNet01 and DepthResNet"),
        ({"model.depth_net.pack1.conv3d.weight": torch.zeros(8, 1, 3, 3, 3)}, "looks like a model of PackNet, but"),
        ({"layer1.0.conv1.weight": torch.zeros(1)}, r"image encoder.*model\.encoder\.weights="),
        ({"x": torch.zeros(1)}, "not a saunet checkpoint"),
    ],
)
def test_what_cannot_be_taken_is_named(state: State, message: str, tmp_path: Path) -> None:
    save(tmp_path / "x.ckpt", {"state_dict": state})
    with pytest.raises(CheckpointError, match=message) as error:
        saunet.load(tmp_path / "x.ckpt")
    assert "\n" not in str(error.value)


def test_packnet_with_added_skips_is_named(tmp_path: Path) -> None:
    write_packnet(tmp_path)
    state = read_torch(tmp_path / "x.ckpt", "it", stand_ins=True)["state_dict"]
    state["model.depth_net.iconv5.conv_base.weight"] = torch.zeros(32, 16, 3, 3)
    save(tmp_path / "x.ckpt", {"state_dict": state})
    with pytest.raises(CheckpointError, match="version B"):
        saunet.load(tmp_path / "x.ckpt")


class Runs:
    """Would copy a file if a reader ran it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return shutil.copyfile, (__file__, str(self.path))


@pytest.mark.parametrize("inside", ["state_dict", "hyper_parameters"])
def test_nothing_in_a_file_is_run(inside: str, tmp_path: Path) -> None:
    write_sc_depth(tmp_path)
    content = read_torch(tmp_path / "x.ckpt", "it", stand_ins=True)
    content[inside]["it"] = Runs(tmp_path / "ran")
    content["hyper_parameters"].pop("hparams")
    torch.save(content, tmp_path / "x.ckpt")
    assert read_model(tmp_path / "x.ckpt").networks()[0] is not None
    assert not (tmp_path / "ran").exists()
    torch.load(tmp_path / "x.ckpt", weights_only=False)  # which does run it
    assert (tmp_path / "ran").exists()
