"""The losses where they are easily wrong: nothing to see, nothing to learn, and at the truth of a rendered street."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import saunet
from saunet.data.loading.windows import WindowDataset, collate, measured_distance
from saunet.errors import ConfigError
from saunet.geometry.pose import pose_matrix
from saunet.geometry.warp import synthesize
from saunet.losses.functional import photometric_error
from saunet.losses.terms import Photometric, Velocity
from saunet.synthetic import SyntheticDrive
from saunet.types import DepthPyramid

Make = Callable[..., Any]
TERMS = saunet.available("term")
EMPTY = DepthPyramid(sigmoid=(), disparity=(), depth=())
ELSEWHERE = torch.zeros(4, 4)
ELSEWHERE[0, 3] = 1e5  # meters to the side: nothing of the target is in view


def moved(inputs: Any, sources: list[int]) -> Any:
    """The same inputs, with some of the source cameras far away."""
    poses = inputs.poses.clone()
    for source in sources:
        poses[:, source] = poses[:, source] + ELSEWHERE
    views = tuple(
        synthesize(inputs.batch["loss_sources"], inputs.pyramid.depth[0], inputs.batch["K"], poses)
        for _ in inputs.views
    )
    return dataclasses.replace(inputs, poses=poses, views=views)


def assert_finite(value: Tensor, leaves: tuple[Tensor, ...]) -> None:
    assert value.isfinite()
    assert value.requires_grad
    value.backward()
    assert all(leaf.grad is None or leaf.grad.isfinite().all() for leaf in leaves)


@pytest.mark.parametrize("gone", [[0], [0, 1]], ids=["one source", "all sources"])
@pytest.mark.parametrize("name", TERMS)
def test_sources_fully_out_of_view(name: str, gone: list[int], make_inputs: Make) -> None:
    inputs = moved(make_inputs(), gone)
    term = saunet.build("term", name).eval()
    value = term(*inputs).value
    if gone == [0, 1] and name in ("photometric", "consistency"):
        assert value == 0
    assert_finite(value, inputs.leaves)


@pytest.mark.parametrize("reduction", ["masked", "all"])
@pytest.mark.parametrize("automask", [True, False])
def test_constant_images_and_zero_motion_together_teach_nothing(
    automask: bool, reduction: str, make_inputs: Make
) -> None:
    inputs = make_inputs()
    for key in ("loss_target", "loss_sources"):
        inputs.batch[key] = torch.full_like(inputs.batch[key], 0.4)
    with torch.no_grad():
        inputs.axisangle.zero_()
        inputs.translation.zero_()
    inputs = inputs.rebuilt(*inputs.leaves)
    value = Photometric(automask=automask, reduction=reduction)(*inputs).value
    assert value < 1e-6
    assert_finite(value, inputs.leaves)


@pytest.mark.parametrize("key", ["distance", "T_src_tgt"])
def test_velocity_leaves_a_stereo_view_out(key: str, make_inputs: Make) -> None:
    inputs, distance = make_inputs(sources=3), torch.rand(2, 3)
    way = torch.stack([torch.zeros_like(distance), torch.zeros_like(distance), distance], -1)
    given = {"distance": distance, "T_src_tgt": pose_matrix(torch.zeros(2, 3, 3), way)}[key]
    batch: Any = {"T_stereo_tgt": torch.eye(4).expand(2, 4, 4), key: given}
    without: Any = {key: given[:, :2]}
    expected = Velocity()(without, EMPTY, inputs.poses[:, :2], ()).value
    torch.testing.assert_close(Velocity()(batch, EMPTY, inputs.poses, ()).value, expected)


def test_velocity_of_stereo_alone_is_one_sentence(make_inputs: Make) -> None:
    inputs = make_inputs(sources=1)
    batch: Any = {"T_stereo_tgt": torch.eye(4).expand(2, 4, 4), "distance": torch.full((2, 1), torch.nan)}
    with pytest.raises(ConfigError, match="the stereo view is the only source; drop the term"):
        Velocity()(batch, EMPTY, inputs.poses, ())


# --- at the truth of a rendered street -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def street() -> Any:
    """A street with its true depth and motion: the neighbors in time and the stereo view as sources."""
    drive = SyntheticDrive(seed=21, frames=3, height=64, width=192)
    data = WindowDataset(
        [drive],
        [(0, 1)],
        offsets=(-1, 1),
        height=64,
        width=192,
        with_target_depth=True,
        with_pose=True,
        stereo=True,
        odometer=measured_distance,
    )
    batch: Any = collate([data[0]])
    images = batch["frames"].float() / 255
    return {**batch, "loss_target": images[:, 0], "loss_sources": images[:, 1:], "depth": batch["target_depth"]}


def loss(street: Any, depth: Tensor, poses: Tensor, sources: slice = slice(None)) -> float:
    images, known = street["loss_sources"][:, sources], street["depth"] > 0
    view = synthesize(images, torch.where(known, depth, torch.inf), street["K"], poses[:, sources])
    batch = {"loss_target": street["loss_target"], "loss_sources": images}
    return float(Photometric(automask=False).eval()(batch, EMPTY, poses[:, sources], (view,)).value)  # type: ignore[arg-type]


def test_loss_is_minimal_at_true_depth(street: Any) -> None:
    depth, poses = street["depth"], street["T_src_tgt"]
    truth = loss(street, depth, poses)
    across = torch.linspace(-1, 1, 192).expand_as(depth)
    down = torch.linspace(-1, 1, 64)[:, None].expand_as(depth)
    waves = torch.sin(6 * across) * torch.cos(5 * down)
    near = (depth < 12).float()
    for name, direction in {
        "scale": torch.ones_like(depth), "left": across, "tilt": down, "waves": waves, "near": near, "far": 1 - near,
    }.items():  # fmt: skip
        for size in (-0.2, -0.05, 0.05, 0.2):
            assert loss(street, depth * (1 + size * direction), poses) > truth, (name, size)


@pytest.mark.parametrize("source", [0, 1, 2])
def test_loss_is_minimal_at_true_motion(street: Any, source: int) -> None:
    """Each source alone: the minimum over several could hide a wrong motion of one."""
    depth, poses, chosen = street["depth"], street["T_src_tgt"], slice(source, source + 1)
    truth = loss(street, depth, poses, chosen)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            step = torch.zeros(1, 1, 3)
            step[..., axis] = sign
            still = torch.zeros_like(step)
            for nudge in (pose_matrix(0.01 * step, still), pose_matrix(still, 0.2 * step)):
                assert loss(street, depth, nudge @ poses, chosen) > truth, (axis, sign, nudge)


def test_only_the_stereo_view_knows_meters(street: Any) -> None:
    depth, poses = street["depth"], street["T_src_tgt"]
    for factor in (0.8, 1.25):
        scaled = poses.clone()
        scaled[:, :2, :3, 3] *= factor  # the networks may agree on any unit; the rig's baseline is what it is
        video, both = slice(0, 2), slice(None)
        assert loss(street, factor * depth, scaled, video) == pytest.approx(loss(street, depth, poses, video), rel=1e-3)
        assert loss(street, factor * depth, scaled, slice(2, 3)) > 1.2 * loss(street, depth, poses, slice(2, 3))
        assert loss(street, factor * depth, scaled, both) > loss(street, depth, poses, both)


def test_static_pixels_are_dropped_which_eq_11_as_printed_would_keep(street: Any) -> None:
    """The left half stands still relative to the camera, like a car that keeps its distance."""
    target = street["loss_target"]
    sources = street["loss_sources"][:, :2].clone()
    sources[..., :96] = target[:, None, :, :, :96]
    poses = street["T_src_tgt"][:, :2]
    depth = torch.where(street["depth"] > 0, street["depth"], torch.inf)
    view = synthesize(sources, depth, street["K"], poses)
    batch: Any = {"loss_target": target, "loss_sources": sources}
    ours = Photometric().eval()(batch, EMPTY, poses, (view,)).maps["automask"] > 0
    warped = photometric_error(view.image, target[:, None]).amin(1)
    unwarped = photometric_error(sources, target[:, None]).amin(1)
    printed = unwarped < warped  # eq. (11) to the letter
    still, moving = slice(0, 90), slice(102, 192)
    assert not ours[..., still].any()
    assert printed[..., still].float().mean() > 0.9
    road = slice(40, 64)
    assert ours[..., road, moving].float().mean() > 0.6
    assert printed[..., road, moving].float().mean() < 0.4
