"""Train the pose network of ``street`` on pairs of rendered frames with their exact motions."""

from __future__ import annotations

import argparse
import copy
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from frames import Frames
from torch import Tensor, nn
from train_depth import rate_factor

import saunet


def build() -> nn.Module:
    """Return the pose network; its last layer starts near meters and half a meter ahead."""
    network = saunet.build("pose", "posecnn")
    with torch.no_grad():
        network.project.weight[3:].mul_(30)
        network.project.bias[5] = -50.0  # T_later_earlier moves points backward
    return network


def motion(network: nn.Module, earlier: Tensor, later: Tensor) -> Tensor:
    """Return T_later_earlier, b 4 4, for images b 3 h w in the order of time."""
    offsets, network.offsets = network.offsets, (1,)
    try:
        return network(earlier, later[:, None])[:, 0]
    finally:
        network.offsets = offsets


def axis_angle(R: Tensor) -> Tensor:
    """Return the axis-angle vectors, b 3, of small rotations, b 3 3."""
    skew = torch.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1) / 2
    return (
        skew
        / (skew.norm(dim=1, keepdim=True).clamp(min=1e-6))
        * skew.norm(dim=1, keepdim=True).clamp(1e-6, 0.99).asin()
    )


def loss(predicted: Tensor, true: Tensor) -> Tensor:
    """Return degrees of rotation error plus translation error relative to 0.2 m and the distance driven."""
    turn = (axis_angle(predicted[:, :3, :3]) - axis_angle(true[:, :3, :3])).abs().sum(1)
    t, goal = predicted[:, :3, 3], true[:, :3, 3]
    step = (t - goal).norm(dim=1) / (0.2 + goal.norm(dim=1))
    return (turn * 57.3 + step).mean()


@torch.inference_mode()
def score(network: nn.Module, root: Path, size: tuple[int, int]) -> str:
    """Return errors on the real sequence 06: yaw and pitch per frame, direction, and the scale of translation."""
    network.eval()
    text = (root / "odometry/poses/06.txt").read_text().splitlines()
    poses = np.array([[float(x) for x in line.split()] for line in text if line]).reshape(-1, 3, 4)
    T = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3] = poses
    paths = sorted((root / "odometry/sequences/06/image_0").iterdir())[: len(T)]
    frames = [
        cv2.resize(cv2.imread(str(p)), size[::-1], interpolation=cv2.INTER_AREA)[..., ::-1].astype(np.float32) / 255
        for p in paths
    ]
    batch = torch.from_numpy(np.stack(frames)).permute(0, 3, 1, 2)
    got = motion(network, batch[:-1], batch[1:]).double().numpy()
    want = np.linalg.inv(T[1:]) @ T[:-1]
    turn = np.rad2deg(
        (axis_angle(torch.from_numpy(got[:, :3, :3])) - axis_angle(torch.from_numpy(want[:, :3, :3]))).numpy()
    )
    a, b = got[:, :3, 3], want[:, :3, 3]
    cosine = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) + 1e-9)
    ratio = np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    yaw, pitch = np.abs(turn[:, 1]).mean(), np.abs(turn[:, 0]).mean()
    direction = np.rad2deg(np.arccos(cosine.clip(-1, 1))).mean()
    spread = ratio.std() / ratio.mean()
    return (
        f"yaw {yaw:.3f} pitch {pitch:.3f} deg/frame, direction {direction:.2f} deg, "
        f"scale {np.median(ratio):.3f} spread {spread:.3f}"
    )


@torch.inference_mode()
def held_out(network: nn.Module, frames: Frames, size: tuple[int, int]) -> str:
    """Return errors on rendered pairs that are not trained on, each also with a turn of 2 degrees added."""
    network.eval()
    rng = np.random.default_rng(0)
    samples = [frames.pair_sample(rng, i, size, augment=False) for i in range(len(frames.pairs))]
    if not samples:
        return "none"
    a, b = (torch.from_numpy(np.stack([s[k] for s in samples])).permute(0, 3, 1, 2) for k in (0, 1))
    got, want = motion(network, a, b).double(), torch.from_numpy(np.stack([s[2] for s in samples]))
    turn = torch.rad2deg(axis_angle(got[:, :3, :3]) - axis_angle(want[:, :3, :3])).abs()
    yaw = torch.rad2deg(axis_angle(want[:, :3, :3]))[:, 1].abs()
    step = (got[:, :3, 3] - want[:, :3, 3]).norm(dim=1) / want[:, :3, 3].norm(dim=1).clamp(min=0.1)
    return f"yaw error {turn[:, 1].mean():.3f} of {yaw.mean():.3f} deg, translation error {step.median():.3f}"


def main() -> None:
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument(
        "--minutes", type=float, default=1e9, help="end after so many minutes, if the steps take longer"
    )
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 320))
    parser.add_argument("--rate", type=float, default=3e-4)
    parser.add_argument("--hold", type=float, default=0.6, help="fraction of the steps before the rate falls to 0")
    parser.add_argument("--start", type=Path, help="weights to start from (a .pt of this script)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--real", type=Path, help="kitti_mini, to print errors on real frames; never trained on")
    parser.add_argument("--every", type=int, default=100)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    cv2.setNumThreads(1)
    rng = np.random.default_rng(options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    frames, held = Frames(options.scenes), Frames(options.scenes, range(0, 1))
    network = build()
    if options.start:
        network.load_state_dict(torch.load(options.start, weights_only=True))
    average = copy.deepcopy(network)
    optimizer = torch.optim.AdamW(network.parameters(), lr=options.rate, weight_decay=1e-2)
    begin, running = time.time(), 0.0

    def factor(step: int) -> float:
        return rate_factor(step, options.steps, (time.time() - begin) / 60, options.minutes, options.hold)

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    size = tuple(options.size)
    for step in range(1, options.steps + 1):
        network.train()
        samples = [frames.pair_sample(rng, int(i), size) for i in rng.integers(len(frames.pairs), size=options.batch)]
        a, b = (torch.from_numpy(np.stack([s[k] for s in samples])).permute(0, 3, 1, 2) for k in (0, 1))
        true = torch.from_numpy(np.stack([s[2] for s in samples])).float()
        value = loss(motion(network, a, b), true)
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        decay = min(0.99, (1 + step) / (20 + step))
        with torch.no_grad():
            for p, q in zip(average.parameters(), network.parameters(), strict=True):
                p.lerp_(q, 1 - decay)
        running = value.item() if step == 1 else 0.97 * running + 0.03 * value.item()
        if step % 20 == 0:
            print(
                f"{step} loss {running:.4f} {step / (time.time() - begin):.3f} steps/s {len(frames.pairs)} pairs",
                flush=True,
            )
        over = time.time() - begin > 60 * options.minutes
        if step % options.every == 0 or step == options.steps or over:
            torch.save(average.state_dict(), options.out / "pose.part")
            (options.out / "pose.part").replace(options.out / "pose.pt")
            real = score(average, options.real, size) if options.real else ""
            print(f"step {step} real: {real}; held out: {held_out(average, held, size)}", flush=True)
            frames.refresh()
            held.refresh()
        if over:
            break


if __name__ == "__main__":
    main()
