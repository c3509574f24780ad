"""Pose networks: order of time, identity, and what they refuse."""

from __future__ import annotations

import jaxtyping
import pytest
import torch

from saunet.errors import ConfigError
from saunet.geometry.pose import invert_pose
from saunet.models.encoders.resnet import ResNet
from saunet.models.poses import MOTION_SCALE, motions_to_sources
from saunet.registry import poses

BLOCKS = (1, 1, 1, 1)
VARIANTS = [("posecnn", {}), ("resnet18", {"blocks": BLOCKS}), ("resnet18", {"blocks": BLOCKS, "input": "triplet"})]


def _images(count: int) -> torch.Tensor:
    return torch.rand(2, count, 3, 64, 64)


def _louden(pose: torch.nn.Module) -> torch.nn.Module:
    """Make an untrained network's motions large enough to compare."""
    head = pose.project if hasattr(pose, "project") else pose.head.project
    torch.nn.init.normal_(head.bias, std=20)
    with torch.no_grad():
        head.weight.mul_(50)
    return pose.eval()


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS[:2])  # a triplet sees three frames at once, no pair to swap
@pytest.mark.parametrize("batch", [1, 2])
def test_swapping_time_reverses_motion(name, kwargs, batch):
    """The motion from the target to a later frame is the inverse of that from the later frame back."""
    pose = _louden(poses.build(name, offsets=(-1, 1), **kwargs))
    a, b = _images(2)[:batch].unbind(1)
    with torch.no_grad():
        forward = pose(a, torch.stack([b, b], 1))[:, 1]  # target a, source b later: T_b_a
        backward = pose(b, torch.stack([a, a], 1))[:, 0]  # target b, source a earlier: T_a_b
    torch.testing.assert_close(forward, invert_pose(backward), atol=1e-5, rtol=1e-4)
    assert (forward - torch.eye(4)).abs().max() > 1e-3


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_order_of_sources_does_not_matter(name, kwargs):
    target, sources = _images(1)[:, 0], _images(2)
    pose = _louden(poses.build(name, offsets=(-1, 1), **kwargs))
    swapped = poses.build(name, offsets=(1, -1), **kwargs).eval()
    swapped.load_state_dict(pose.state_dict())
    with torch.no_grad():
        a, b = pose(target, sources), swapped(target, sources.flip(1))
    torch.testing.assert_close(a, b.flip(1), atol=1e-5, rtol=1e-4)
    assert (a[:, 0] - a[:, 1]).abs().max() > 1e-3


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_silent_head_means_no_motion(name, kwargs):
    pose = poses.build(name, **kwargs)
    head = pose.project if hasattr(pose, "project") else pose.head.project
    torch.nn.init.zeros_(head.weight)
    torch.nn.init.zeros_(head.bias)
    T_src_tgt = pose(_images(1)[:, 0], _images(2))
    torch.testing.assert_close(T_src_tgt, torch.eye(4).expand(2, 2, 4, 4))


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_starts_nearly_still(name, kwargs):
    with torch.no_grad():
        T_src_tgt = poses.build(name, **kwargs)(_images(1)[:, 0], _images(2))
    assert (T_src_tgt - torch.eye(4)).abs().max() < 0.02


@pytest.mark.parametrize(("name", "kwargs"), VARIANTS)
def test_an_untrained_network_tells_pairs_apart_and_all_of_it_learns(name, kwargs):
    """Seven layers without normalization lose the signal on the way unless their weights start large enough."""
    pose = poses.build(name, **kwargs)
    T_src_tgt = pose(torch.rand(6, 3, 64, 64), torch.rand(6, 2, 3, 64, 64))
    forward = T_src_tgt[:, 1, :3, 3] / MOTION_SCALE
    assert forward.std(0).mean() > 1e-3
    T_src_tgt[:, :, 2, 3].square().sum().sqrt().backward()
    sizes = {key: p.grad.norm().item() for key, p in pose.named_parameters() if p.ndim == 4}
    assert min(sizes.values()) > 1e-3 * max(sizes.values()), sizes


def test_motion_is_forward_in_time():
    motion = torch.zeros(2, 1, 6)
    motion[..., 5] = 1 / MOTION_SCALE  # T_later_earlier moves points by +1 along z
    T_src_tgt = motions_to_sources(motion, (-1, 1))
    assert T_src_tgt[0, :, 2, 3].tolist() == [-1.0, 1.0]
    assert T_src_tgt[0, :, 0, 3].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("offsets", [(-1,), (-2, -1, 1, 2)])
def test_any_number_of_pairs(offsets):
    pose = poses.build("resnet18", blocks=BLOCKS, offsets=offsets)
    assert pose(_images(1)[:, 0], _images(len(offsets))).shape == (2, len(offsets), 4, 4)


def test_pairs_are_independent_of_each_other():
    pose = _louden(poses.build("resnet18", blocks=BLOCKS))
    target, sources = _images(1)[:, 0], _images(2)
    other = torch.stack([sources[:, 0], torch.rand(2, 3, 64, 64)], 1)
    with torch.no_grad():
        a, b = pose(target, sources), pose(target, other)
    torch.testing.assert_close(a[:, 0], b[:, 0], atol=1e-5, rtol=1e-4)
    assert (a[:, 1] - b[:, 1]).abs().max() > 1e-4


def test_published_sizes():
    counts = {}
    for name in ("resnet34", "posecnn"):
        with torch.device("meta"):
            counts[name] = sum(p.numel() for p in poses.build(name).parameters())
    # ResNet-34 without classifier, three more input channels, and the head; PoseCNN as Monodepth2 has it for two frames
    head = (512 + 1) * 256 + 2 * (256 * 9 + 1) * 256 + 257 * 6
    assert counts["resnet34"] == 21_797_672 - 513_000 + 3 * 64 * 49 + head
    assert counts["posecnn"] == 1_586_774


@pytest.mark.parametrize(("offsets", "frames"), [((-1,), 2), ((-1, 1, 2), 4)])
def test_triplet_needs_three_frames(offsets, frames):
    with pytest.raises(ConfigError, match=rf"input is 'triplet' but there are {frames} frames .* it needs 3"):
        poses.build("resnet18", blocks=BLOCKS, input="triplet", offsets=offsets)


@pytest.mark.parametrize("name", ["resnet18", "posecnn"])
@pytest.mark.parametrize("offsets", [(), (0, 1), (1, 1)])
def test_wrong_offsets(name, offsets):
    with pytest.raises(ConfigError, match=r"offsets is \[.*distinct frames before or after"):
        poses.build(name, offsets=offsets)


@pytest.mark.parametrize("name", ["resnet18", "posecnn"])
def test_wrong_number_of_sources(name):
    with pytest.raises(ConfigError, match=r"3 source frames but the pose network was built for offsets \[-1, 1\]"):
        poses.build(name)(_images(1)[:, 0], _images(3))


def test_wrong_size():
    with pytest.raises(ConfigError, match=r"image 190x640 .* the nearest valid size is 192x640"):
        poses.build("resnet18", blocks=BLOCKS)(torch.rand(1, 3, 190, 640), torch.rand(1, 2, 3, 190, 640))


def test_wrong_input(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # else the type checker speaks first
    with pytest.raises(ConfigError, match="input is 'pair'; did you mean 'pairs'"):
        poses.build("resnet18", input="pair")


@pytest.mark.parametrize(("input_", "frames"), [("pairs", 2), ("triplet", 3)])
def test_weights_are_shared_among_frames(tmp_path, input_, frames):
    one = ResNet(BLOCKS)
    torch.save(one.state_dict(), tmp_path / "resnet10.pth")
    pose = poses.build("resnet18", blocks=BLOCKS, input=input_, weights=str(tmp_path / "resnet10.pth"))
    torch.testing.assert_close(pose.encoder.conv1.weight[:, -3:], one.conv1.weight / frames)
    torch.testing.assert_close(pose.encoder.layer4[0].conv2.weight, one.layer4[0].conv2.weight)
