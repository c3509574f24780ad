"""The photometric term: Monodepth2's and ManyDepth's numbers, validity, auto-mask, and the minimum at the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from saunet.errors import ConfigError
from saunet.geometry.pose import pose_matrix
from saunet.geometry.warp import synthesize
from saunet.losses import terms as module
from saunet.losses.terms import Monodepth2Photometric, Photometric
from saunet.types import DepthPyramid, View

Load = Callable[[str], Mapping[str, Any]]
Make = Callable[..., Any]
EMPTY = DepthPyramid(sigmoid=(), disparity=(), depth=())


def reference_inputs(data: Mapping[str, Tensor], prefix: str = "", scales: int = 1) -> tuple[Any, ...]:
    warped = torch.stack((data[f"{prefix}warped_a"], data[f"{prefix}warped_b"]), 1)
    target = data[f"{prefix}target"]
    if prefix == "static_":
        raw = target[:, None].expand_as(warped)
    elif prefix == "tie_":
        raw = warped
    else:
        raw = torch.stack((data["raw_a"], data["raw_b"]), 1)
    view = View(image=warped, valid=torch.ones_like(warped[:, :, :1], dtype=torch.bool))
    poses = torch.eye(4).expand(len(target), 2, 4, 4)
    return {"loss_target": target, "loss_sources": raw}, EMPTY, poses, (view,) * scales


@pytest.fixture
def data(reference: Load) -> dict[str, Tensor]:
    return {key: torch.as_tensor(value) for key, value in reference("objective").items()}


@pytest.mark.parametrize("prefix", ["", "static_", "tie_"])
@pytest.mark.parametrize("scales", [1, 4])
def test_monodepth2_mean(data: dict[str, Tensor], prefix: str, scales: int) -> None:
    result = Monodepth2Photometric(noise=0.0)(*reference_inputs(data, prefix, scales))
    torch.testing.assert_close(result.value.double(), data[f"{prefix}md2_photometric_mean"], rtol=0, atol=1e-6)


@pytest.mark.parametrize("prefix", ["", "static_"])
def test_masked_mean_is_manydepths(data: dict[str, Tensor], prefix: str) -> None:
    """ManyDepth pools the kept pixels of the whole batch; here each image counts as one, or the split would matter."""
    term, (batch, empty, poses, views) = Photometric(noise=0.0), reference_inputs(data, prefix)
    values, kept = [], []
    for each in range(len(poses)):
        one = slice(each, each + 1)
        view = View(image=views[0].image[one], valid=views[0].valid[one])
        result = term({key: value[one] for key, value in batch.items()}, empty, poses[one], (view,))
        values.append(result.value.double())
        kept.append(result.maps["automask"].sum().double())
    pooled = sum(v * k for v, k in zip(values, kept, strict=True)) / sum(kept).clamp(min=1)  # type: ignore[union-attr]
    torch.testing.assert_close(pooled, data[f"{prefix}manydepth_masked_mean"], rtol=0, atol=1e-6)
    whole = term(batch, empty, poses, views).value.double()
    torch.testing.assert_close(whole, torch.stack(values).mean(), rtol=0, atol=1e-6)


def test_automask_map_is_the_references(data: dict[str, Tensor]) -> None:
    maps = Photometric(noise=0.0)(*reference_inputs(data)).maps
    clear = data["automask_margin"] > 1e-4
    assert torch.equal(maps["automask"][:, 0][clear], data["automask"][clear].float())
    best = data["reprojection_losses"].min(1).values
    torch.testing.assert_close(maps["photometric_error"][:, 0], best, rtol=0, atol=2e-4)


def test_monodepth2s_noise_moves_the_mean_by_less_than_it_is_wide(data: dict[str, Tensor]) -> None:
    result = Monodepth2Photometric()(*reference_inputs(data))
    torch.testing.assert_close(result.value.double(), data["md2_photometric_mean"], rtol=0, atol=1e-6)


def test_noise_is_for_training_only(data: dict[str, Tensor]) -> None:
    term, inputs = Photometric(noise=0.1), reference_inputs(data)
    assert not torch.equal(term(*inputs).value, term(*inputs).value)
    assert torch.equal(term.eval()(*inputs).value, term(*inputs).value)


def test_unwarped_error_is_computed_once(make_inputs: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def counted(*args: Any) -> Tensor:
        calls.append(args)
        return original(*args)

    original = module.photometric_error
    monkeypatch.setattr(module, "photometric_error", counted)
    Photometric()(*make_inputs(scales=3))
    assert len(calls) == 3 + 1
    calls.clear()
    Photometric(automask=False)(*make_inputs(scales=3))
    assert len(calls) == 3


def test_a_source_out_of_view_changes_nothing(make_inputs: Make) -> None:
    inputs = make_inputs(sources=3, scales=1)
    poses = inputs.poses.detach().clone()
    poses[:, 1, 0, 3] = 1e3  # the second source looks elsewhere
    depth = inputs.pyramid.depth[0].detach()
    batch = inputs.batch

    def loss(keep: list[int], use_validity: bool) -> Tensor:
        sources = batch["loss_sources"][:, keep]
        view = synthesize(sources, depth, batch["K"], poses[:, keep])
        term = Photometric(use_validity=use_validity, automask=False)
        return term({**batch, "loss_sources": sources}, inputs.pyramid, poses[:, keep], (view,)).value

    torch.testing.assert_close(loss([0, 1, 2], True), loss([0, 2], True))
    assert not torch.isclose(loss([0, 1, 2], False), loss([0, 2], False), rtol=1e-4)


def test_pixels_without_a_source_are_left_out(make_inputs: Make) -> None:
    inputs = make_inputs(scales=1)
    valid = torch.ones_like(inputs.views[0].valid)
    valid[..., :12] = False
    image = inputs.views[0].image.detach().clone()
    for hidden in (0.0, 1.0):
        image[..., :10] = hidden  # two columns of margin: SSIM looks one pixel around
        view = View(image=image, valid=valid)
        result = Photometric(noise=0.0)(inputs.batch, inputs.pyramid, inputs.poses, (view,))
        if hidden == 0.0:
            expected = result.value
        torch.testing.assert_close(result.value, expected)
    assert (result.maps["automask"][..., :12] == 0).all()


def test_zero_motion_teaches_nothing(make_inputs: Make) -> None:
    inputs = make_inputs(scales=1)
    view = View(image=inputs.batch["loss_sources"].clone(), valid=torch.ones(2, 2, 1, 16, 24, dtype=torch.bool))
    result = Photometric(noise=0.0)(inputs.batch, inputs.pyramid, inputs.poses, (view,))
    assert result.value == 0
    assert (result.maps["automask"] == 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sources": "min"}, r"sources is 'min'.*allowed: minimum, mean"),
        ({"reduction": "mask"}, r"reduction is 'mask'; did you mean 'masked'\?"),
        ({"ssim_weight": 1.5}, r"ssim_weight is 1.5; it must lie between 0 and 1"),
        ({"noise": -1.0}, r"noise is -1.0; it must be at least 0"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_settings(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Photometric(**options)


# --- the loss is minimal at the truth --------------------------------------------------------------------------------

HEIGHT, WIDTH = 48, 96
K = torch.tensor([[60.0, 0.0, 47.0], [0.0, 60.0, 23.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
NORMAL, DISTANCE = torch.tensor([0.25, -0.35, 1.0], dtype=torch.float64), 5.0
AXISANGLE = torch.tensor([[[0.01, 0.02, -0.015], [-0.012, -0.01, 0.02]]], dtype=torch.float64)
TRANSLATION = torch.tensor([[[0.2, 0.1, 0.3], [-0.15, 0.12, -0.3]]], dtype=torch.float64)


def render(T_tgt_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Image and depth of a textured slanted plane (n . p = d in the target frame), seen by a camera."""
    v, u = torch.meshgrid(
        torch.arange(HEIGHT, dtype=torch.float64), torch.arange(WIDTH, dtype=torch.float64), indexing="ij"
    )
    rays = torch.stack(((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)), -1)
    rays = rays @ T_tgt_cam[:3, :3].T
    origin = T_tgt_cam[:3, 3]
    depth = (DISTANCE - NORMAL @ origin) / (rays @ NORMAL)
    x, y, _ = (origin + depth[..., None] * rays).unbind(-1)
    colors = [torch.sin(4 * x + k) * torch.sin(5 * y + 2 * k) + 0.5 * torch.sin(3 * x - 4 * y + k) for k in range(3)]
    return torch.stack(colors) / 3 + 0.5, depth


@pytest.fixture(scope="module")
def plane() -> tuple[dict[str, Tensor], Tensor]:
    poses = pose_matrix(AXISANGLE, TRANSLATION)[0]
    target, depth = render(torch.eye(4, dtype=torch.float64))
    sources = torch.stack([render(torch.linalg.inv(T))[0] for T in poses])
    return {"loss_target": target[None], "loss_sources": sources[None]}, depth[None, None]


def plane_loss(batch: dict[str, Tensor], depth: Tensor, axisangle: Tensor, translation: Tensor) -> float:
    poses = pose_matrix(axisangle, translation)
    view = synthesize(batch["loss_sources"], depth, K[None], poses)
    return float(Photometric(automask=False, noise=0.0)(batch, EMPTY, poses, (view,)).value)


def test_loss_is_minimal_at_true_depth_and_motion(plane: tuple[dict[str, Tensor], Tensor]) -> None:
    batch, depth = plane
    truth = plane_loss(batch, depth, AXISANGLE, TRANSLATION)
    assert truth < 2e-3  # what bilinear interpolation leaves
    tilt = torch.linspace(-1, 1, WIDTH, dtype=torch.float64)
    waves = torch.sin(torch.arange(HEIGHT, dtype=torch.float64) / 5)[:, None] * torch.cos(4 * tilt)
    for size in (0.02, 0.1):
        for direction in (torch.ones_like(depth), tilt.expand_as(depth), waves.expand_as(depth)):
            for sign in (-1, 1):
                wrong = plane_loss(batch, depth * (1 + sign * size * direction), AXISANGLE, TRANSLATION)
                assert wrong > truth
    for source in range(2):
        for axis in range(3):
            for sign in (-1, 1):
                nudge = torch.zeros_like(AXISANGLE)
                nudge[0, source, axis] = sign
                assert plane_loss(batch, depth, AXISANGLE + 0.005 * nudge, TRANSLATION) > truth
                assert plane_loss(batch, depth, AXISANGLE, TRANSLATION + 0.05 * nudge) > truth


def test_the_automask_keeps_a_moving_plane(plane: tuple[dict[str, Tensor], Tensor]) -> None:
    batch, depth = plane
    poses = pose_matrix(AXISANGLE, TRANSLATION)
    view = synthesize(batch["loss_sources"], depth, K[None], poses)
    kept = Photometric(noise=0.0)(batch, EMPTY, poses, (view,)).maps["automask"]
    assert kept.mean() > 0.9
