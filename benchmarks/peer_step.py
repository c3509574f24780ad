"""A training step beside that of Monodepth2's own code, in turn in one process: ResNet-18 twice, 640x192, four scales.

Their ``trainer.py``, ``layers.py`` and ``networks`` run as published, from images to updated weights; only packages
that the step does not need are replaced by empty ones, and torchvision's ResNet-18 by the same network written out.
Printed are the ratio of processor times, ours over theirs, with its spread over the rounds, and each one's peak of
memory above its weights; `depth` compares the depth networks alone, without gradients::

    git clone https://github.com/nianticlabs/monodepth2
    OMP_NUM_THREADS=1 python benchmarks/peer_step.py monodepth2
    OMP_NUM_THREADS=1 python benchmarks/peer_step.py monodepth2 --batch 4 --checkpoint-activations
"""

from __future__ import annotations

import argparse
import copy
import functools
import statistics
import sys
import time
import types
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
import train_step
from torch import Tensor, nn

from saunet.models.layers.conv import lay_out
from saunet.tools.benchmark.measure import peak_memory
from saunet.training.speed import Speed
from saunet.weights.files import read_model

HEIGHT, WIDTH = train_step.SIZE


class Block(nn.Module):
    expansion = 1

    def __init__(self, inplanes: int, planes: int, stride: int = 1, downsample: nn.Module | None = None) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inplanes, planes, 3, stride, 1, bias=False), nn.BatchNorm2d(planes)
        self.relu = nn.ReLU(inplace=True)
        self.conv2, self.bn2 = nn.Conv2d(planes, planes, 3, 1, 1, bias=False), nn.BatchNorm2d(planes)
        self.downsample = downsample

    def forward(self, x: Tensor) -> Tensor:
        out = self.bn2(self.conv2(self.relu(self.bn1(self.conv1(x)))))
        out += x if self.downsample is None else self.downsample(x)
        return self.relu(out)  # type: ignore[no-any-return]


class ResNet(nn.Module):
    """The part of torchvision's class that Monodepth2 uses."""

    def __init__(self, block: Any, layers: list[int], num_classes: int = 1000) -> None:
        super().__init__()
        self.inplanes = 64
        self.conv1, self.bn1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False), nn.BatchNorm2d(64)
        self.relu, self.maxpool = nn.ReLU(inplace=True), nn.MaxPool2d(3, 2, 1)
        for index, (planes, count) in enumerate(zip((64, 128, 256, 512), layers, strict=True)):
            setattr(self, f"layer{index + 1}", self._make_layer(block, planes, count, 1 + (index > 0)))
        self.fc = nn.Linear(512, num_classes)

    def _make_layer(self, block: Any, planes: int, count: int, stride: int = 1) -> nn.Sequential:
        shorter = None
        if stride != 1 or self.inplanes != planes:
            shorter = nn.Sequential(nn.Conv2d(self.inplanes, planes, 1, stride, bias=False), nn.BatchNorm2d(planes))
        first = block(self.inplanes, planes, stride, shorter)
        self.inplanes = planes
        return nn.Sequential(first, *(block(planes, planes) for _ in range(1, count)))


def put_on_path(folder: Path) -> None:
    """Make Monodepth2's modules importable, with empty ones for the packages that are not needed."""
    resnet = types.ModuleType("resnet")
    vars(resnet).update(BasicBlock=Block, Bottleneck=None, ResNet=ResNet)
    small = functools.partial(ResNet, Block, [2, 2, 2, 2])

    def resnet18(pretrained: bool) -> ResNet:
        return small()

    models = types.ModuleType("torchvision.models")
    names = {f"resnet{depth}": resnet18 for depth in (18, 34, 50, 101, 152)}
    vars(models).update(ResNet=ResNet, resnet=resnet, **names)
    transforms = types.ModuleType("torchvision.transforms")
    vars(transforms).update(ToTensor=lambda: to_tensor)
    inside = {"models": models, "transforms": transforms, "datasets": None}
    empty = {"torchvision": inside, "torchvision.models": vars(models), "datasets": {}}
    empty |= {
        "tensorboardX": {"SummaryWriter": None},
        "IPython": {"embed": None},
        "six": {"moves": None},
        "six.moves": {"urllib": None},
    }
    for name, content in empty.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(content)
    sys.path.insert(0, str(folder))


def to_tensor(picture: Any) -> Tensor:
    """Return a PIL image as torchvision's `ToTensor` does."""
    return torch.from_numpy(np.array(picture, np.uint8)).permute(2, 0, 1).contiguous().float().div(255)


def trainer(folder: Path, batch: int) -> Any:
    """Return Monodepth2's trainer with its default networks, ready for `process_batch`."""
    put_on_path(folder)
    import layers
    import networks
    from trainer import Trainer

    made: Any = object.__new__(Trainer)
    made.opt = Namespace(
        scales=[0, 1, 2, 3], frame_ids=[0, -1, 1], height=HEIGHT, width=WIDTH, min_depth=0.1, max_depth=100.0,
        pose_model_type="separate_resnet", predictive_mask=False, v1_multiscale=False, disable_automasking=False,
        no_ssim=False, avg_reprojection=False, disparity_smoothness=1e-3, batch_size=batch,
    )  # fmt: skip
    made.device, made.num_scales, made.num_pose_frames, made.use_pose_net = torch.device("cpu"), 4, 2, True
    encoder, pose = networks.ResnetEncoder(18, False), networks.ResnetEncoder(18, False, num_input_images=2)
    made.models = {"encoder": encoder, "depth": networks.DepthDecoder(encoder.num_ch_enc, made.opt.scales)}
    made.models |= {"pose_encoder": pose, "pose": networks.PoseDecoder(pose.num_ch_enc, 1, 2)}
    made.ssim = layers.SSIM()
    made.backproject_depth = {0: layers.BackprojectDepth(batch, HEIGHT, WIDTH)}
    made.project_3d = {0: layers.Project3D(batch, HEIGHT, WIDTH)}
    return made


def frames(batch: int) -> Tensor:
    """Return b 3 3 h w pictures with structure that shift from frame to frame."""
    torch.manual_seed(0)
    wide = F.interpolate(torch.rand(batch, 3, HEIGHT // 8, WIDTH // 8 + 4), (HEIGHT, WIDTH + 32), mode="bicubic")
    return torch.stack([wide.clamp(0, 1)[..., shift : shift + WIDTH] for shift in (8, 4, 12)], 1).contiguous()


def theirs(folder: Path, images: Tensor) -> tuple[Callable[[], object], Callable[[], object]]:
    made, batch = trainer(folder, len(images)), len(images)
    K = torch.eye(4).repeat(batch, 1, 1)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = 0.58 * WIDTH, 1.92 * HEIGHT, 0.5 * WIDTH, 0.5 * HEIGHT
    inputs: dict[Any, Tensor] = {("K", 0): K, ("inv_K", 0): torch.linalg.inv(K)}
    for index, frame in enumerate((0, -1, 1)):
        for scale in range(4):
            inputs["color", frame, scale] = F.avg_pool2d(images[:, index], 2**scale)
        inputs["color_aug", frame, 0] = images[:, index].contiguous()
    parameters = [each for part in made.models.values() for each in part.parameters()]
    optimizer = torch.optim.Adam(parameters, 1e-4)

    def step() -> None:
        _, losses = made.process_batch(dict(inputs))
        optimizer.zero_grad()
        losses["loss"].backward()
        optimizer.step()

    def depth() -> object:
        return made.models["depth"](made.models["encoder"](inputs["color_aug", 0, 0][:1]))

    def part(training: bool, call: Callable[[], object]) -> object:
        for each in made.models.values():
            each.train(training)
        with torch.set_grad_enabled(training):
            return call()

    return functools.partial(part, True, step), functools.partial(part, False, depth)


def ours(images: Tensor, precision: str, speed: Speed) -> tuple[Callable[[], object], Callable[[], object]]:
    model = train_step.build([], len(images))[0]
    model.speed = speed
    speed.apply(model, torch.device("cpu"))
    pictures = {"target": images[:, 0].contiguous(), "sources": images[:, 1:].contiguous()}
    K = torch.tensor([[0.58 * WIDTH, 0, 0.5 * WIDTH], [0, 1.92 * HEIGHT, 0.5 * HEIGHT], [0, 0, 1]])
    batch: Any = {**pictures, **{f"loss_{key}": value for key, value in pictures.items()}}
    batch |= {"K": K.repeat(len(images), 1, 1), "name": [str(index) for index in range(len(images))]}
    network = copy.deepcopy(model.depth).eval()
    lay_out(network)  # as a checkpoint is loaded for prediction
    optimizer = model.recipe.configure(model.recipe.groups(model), 1000)["optimizer"]

    def step() -> None:
        model.train()
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            total = model.step(batch)[3].total
        optimizer.zero_grad()
        total.backward()
        optimizer.step()

    def depth() -> object:
        with torch.no_grad():
            return network(batch["target"][:1])

    return step, depth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a clone of Monodepth2's repository")
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--precision", choices=("fp32", "bf16"), default="fp32", help="ours; theirs is float32")
    parser.add_argument("--checkpoint-activations", action="store_true")
    given = parser.parse_args()
    images, speed = frames(given.batch), Speed(checkpoint_activations=given.checkpoint_activations)
    pairs = zip(ours(images, given.precision, speed), theirs(given.folder, images), strict=True)
    street = read_model("street").networks()[0].eval()
    for name, (own, other) in zip(("step", "depth"), pairs, strict=True):
        runs = {"ours": own, "Monodepth2": other}
        if name == "depth":
            runs["street"] = functools.partial(torch.no_grad()(street), images[:1, 0])
        for call in runs.values():
            call()
        peaks = {who: (peak_memory(call, torch.device("cpu")) or 0) / 2**20 for who, call in runs.items()}
        times: dict[str, list[float]] = {who: [] for who in runs}
        for _ in range(given.rounds):
            for who, call in runs.items():
                began = time.process_time()
                call()
                times[who].append(time.process_time() - began)
        for who in runs.keys() - {"Monodepth2"}:
            ratios = [mine / their for mine, their in zip(times[who], times["Monodepth2"], strict=True)]
            memory = peaks[who] / peaks["Monodepth2"] if peaks["Monodepth2"] else float("nan")
            print(
                f"{name}, {who} / Monodepth2: {statistics.median(ratios):.3f} ({min(ratios):.3f} to "
                f"{max(ratios):.3f}), {statistics.median(times[who]):.3f} s; peak memory {memory:.3f} "
                f"({peaks[who]:.0f} and {peaks['Monodepth2']:.0f} MB)",
                flush=True,
            )


if __name__ == "__main__":
    main()
