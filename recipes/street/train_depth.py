"""Train the depth network of ``street`` on rendered frames; saves a saunet checkpoint every few minutes."""

from __future__ import annotations

import argparse
import copy
import math
import time
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from frames import Frames
from real import real_frames, score
from torch import Tensor, nn

import saunet
from saunet.geometry.depth import sigmoid_to_disparity
from saunet.models.depth import DepthNet

DECODER = (16, 24, 40, 80, 128)
MAX_DEPTH = 100.0


def build(weights: str | None = "imagenet") -> nn.Module:
    """Return the depth network: EfficientNet-Lite0 and a U-Net decoder that starts near 10 m."""
    from functools import partial

    encoder = saunet.build("encoder", "efficientnet_lite0", weights=weights)
    decoder = partial(saunet.build, "decoder", "unet", channels=DECODER)
    network = DepthNet(encoder, decoder, 0.1, MAX_DEPTH)
    for head in network.decoder.heads:
        bias = [p for n, p in head.named_parameters() if n.endswith("bias")][-1]
        nn.init.constant_(bias, math.log(0.009 / 0.991))
    return network


def freeze(network: nn.Module, blocks: int) -> None:
    """Keep the stem and the first blocks of the encoder as ImageNet left them, and all its batch statistics."""
    encoder = network.encoder
    encoder.eval()
    if blocks >= 0:
        for part in (encoder.conv_stem, encoder.bn_stem, *encoder.blocks[:blocks]):
            part.requires_grad_(False)


def loss(prediction: tuple[Tensor, ...], target: Tensor) -> Tensor:
    """Log-depth errors at every scale: absolute, with each image's scale removed, and of multi-scale gradients.

    Args:
        prediction: Depth at each scale, b 1 h w, finest first.
        target: Canonical depth, b 1 h w, 0 in the sky.
    """
    total = target.new_zeros(())
    for number, depth in enumerate(prediction):
        step = target.shape[-1] // depth.shape[-1]
        there = target[..., step // 2 :: step, step // 2 :: step]
        valid = (there > 0.3) & (there < MAX_DEPTH * 0.95)
        sky = (there <= 0) | (there >= MAX_DEPTH * 0.95)
        log = depth.log()
        error = (log - there.clamp(min=0.3, max=MAX_DEPTH).log()) * valid
        count = valid.sum((1, 2, 3)).clamp(min=1)
        shift = (error.sum((1, 2, 3)) / count).detach()
        relative = ((error - shift[:, None, None, None]) * valid).abs().sum((1, 2, 3)) / count
        absolute = error.abs().sum((1, 2, 3)) / count
        far = (F.relu(math.log(MAX_DEPTH * 0.9) - log) * sky).mean((1, 2, 3))
        part = relative + 0.3 * absolute + 0.1 * far
        if number == 0:
            part = part + 0.5 * gradients(error, valid)
        total = total + part.mean() * (1.0 if number == 0 else 0.25)
    return total


def forward(network: nn.Module, image: Tensor, finest: int) -> tuple[Tensor, ...]:
    """Return depth at the decoder's scales from ``finest`` on, without the cost of the finer ones."""
    decoder = network.decoder
    features = network.encoder(image.contiguous(memory_format=torch.channels_last))
    skips = dict(zip(decoder.skips, features, strict=True))
    level = decoder.deepest
    x, depths = skips[level], []
    for place in range(level - finest):
        level -= 1
        x = decoder.level(place, x, skips.get(level))
        if level < len(decoder.heads):
            sigmoid = decoder.heads[level](x)
            depths.append(sigmoid_to_disparity(sigmoid, network.min_depth, network.max_depth).reciprocal())
    return tuple(reversed(depths))


def rate_factor(step: int, steps: int, elapsed: float, minutes: float, hold: float) -> float:
    """Return the factor on the rate: a short rise, then 1, and after the fraction ``hold`` a straight fall to 0.

    Args:
        step: Steps done.
        steps: Steps in all.
        elapsed: Minutes since the start.
        minutes: Minutes in all; whichever of steps and minutes is further along counts.
        hold: Fraction of the training before the fall.
    """
    progress = max(step / steps, elapsed / minutes)
    return max(0.0, min(1.0, (step + 1) / 30, (1 - progress) / max(1e-6, 1 - hold)))


def gradients(error: Tensor, valid: Tensor) -> Tensor:
    """Return the mean absolute gradient of the log-depth error at four scales (MegaDepth's matching term)."""
    total = error.new_zeros(error.shape[0])
    for step in (1, 2, 4, 8):
        e, v = error[..., ::step, ::step], valid[..., ::step, ::step]
        for a, b, p, q in (
            (e[..., 1:], e[..., :-1], v[..., 1:], v[..., :-1]),
            (e[..., 1:, :], e[..., :-1, :], v[..., 1:, :], v[..., :-1, :]),
        ):
            both = p & q
            total = total + ((a - b).abs() * both).sum((1, 2, 3)) / both.sum((1, 2, 3)).clamp(min=1)
    return total / 4


def main() -> None:
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, help="folder written by render.py")
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument(
        "--minutes", type=float, default=1e9, help="end after so many minutes, if the steps take longer"
    )
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument(
        "--size",
        type=int,
        nargs=2,
        action="append",
        help="height and width; given several times, each step draws one, and scores are of the first",
    )
    parser.add_argument("--rate", type=float, default=8e-4)
    parser.add_argument("--hold", type=float, default=0.6, help="fraction of the steps before the rate falls to 0")
    parser.add_argument("--encoder-rate", type=float, default=0.25, help="fraction of the rate for the encoder")
    parser.add_argument("--frozen", type=int, default=3, help="first blocks of the encoder that stay as they are")
    parser.add_argument(
        "--finest", type=int, default=0, help="finest scale to train; 1 skips the costly full size at first"
    )
    parser.add_argument("--start", type=Path, help="depth weights to start from (a .pt of this script)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--real", type=Path, help="kitti_mini, to print scores on real frames; never trained on")
    parser.add_argument("--every", type=int, default=100, help="steps between scores and saves")
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    cv2.setNumThreads(1)
    rng = np.random.default_rng(options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    frames, held = Frames(options.scenes), Frames(options.scenes, range(0, 1))
    clips = real_frames(options.real) if options.real else {}
    network = build()
    if options.start:
        network.load_state_dict(torch.load(options.start, weights_only=True))
    average = copy.deepcopy(network)
    freeze(network, options.frozen)
    encoder = [p for p in network.encoder.parameters() if p.requires_grad]
    slow = {"params": encoder, "lr": options.rate * options.encoder_rate}
    optimizer = torch.optim.AdamW(
        [slow, {"params": network.decoder.parameters(), "lr": options.rate}],
        weight_decay=1e-2,
    )
    begin, running = time.time(), 0.0

    def factor(step: int) -> float:
        return rate_factor(step, options.steps, (time.time() - begin) / 60, options.minutes, options.hold)

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    sizes = [tuple(each) for each in options.size or [(96, 320)]]
    for step in range(1, options.steps + 1):
        network.train()
        network.encoder.eval()
        size = sizes[rng.integers(len(sizes))]
        samples = [frames.depth_sample(rng, int(i), size) for i in rng.integers(len(frames.images), size=options.batch)]
        image = torch.from_numpy(np.stack([s[0] for s in samples])).permute(0, 3, 1, 2)
        target = torch.from_numpy(np.stack([s[1] for s in samples]))[:, None]
        value = loss(forward(network, image, options.finest), target)
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        optimizer.step()
        schedule.step()
        decay = min(0.99, (1 + step) / (20 + step))
        with torch.no_grad():
            for a, b in zip(average.parameters(), network.parameters(), strict=True):
                a.lerp_(b, 1 - decay)
        running = value.item() if step == 1 else 0.97 * running + 0.03 * value.item()
        if step % 20 == 0:
            print(
                f"{step} loss {running:.4f} {step / (time.time() - begin):.3f} steps/s {len(frames.images)} frames",
                flush=True,
            )
        over = time.time() - begin > 60 * options.minutes
        if step % options.every == 0 or step == options.steps or over:
            torch.save(average.state_dict(), options.out / "depth.part")
            (options.out / "depth.part").replace(options.out / "depth.pt")
            report = {
                k: " ".join(f"{x:.3f}" for x in v)
                for k, v in score(average, clips, sizes[0], finest=options.finest).items()
            }
            print(
                f"step {step} real {report} held out {held_out(average, held, sizes[0], finest=options.finest):.4f}",
                flush=True,
            )
            frames.refresh()
            held.refresh()
        if over:
            break


@torch.inference_mode()
def held_out(network: nn.Module, frames: Frames, size: tuple[int, int], count: int = 64, finest: int = 0) -> float:
    """Return the mean Abs Rel after median scaling on rendered scenes that are not trained on."""
    network.eval()
    rng, out = np.random.default_rng(0), []
    for index in np.linspace(0, len(frames.images) - 1, count).astype(int) if frames.images else ():
        x, z = frames.depth_sample(rng, int(index), size, augment=False)
        depth = network(torch.from_numpy(x).permute(2, 0, 1)[None]).depth[finest]
        depth = F.interpolate(depth, size, mode="bilinear")[0, 0].numpy()
        mask = (z > 0.3) & (z < 80)
        if mask.sum() > 100:
            d = depth[mask] * np.median(z[mask]) / np.median(depth[mask])
            out.append(np.mean(np.abs(d - z[mask]) / z[mask]))
    return float(np.mean(out)) if out else float("nan")


if __name__ == "__main__":
    main()
