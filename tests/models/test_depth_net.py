"""DepthNet: encoder and decoder together, sizes and limits, export, and coarse arithmetic."""

from __future__ import annotations

import pytest
import torch
from networks import assert_all_have_gradients
from torch import nn

from saunet.errors import ConfigError
from saunet.models.depth import DepthNet
from saunet.registry import decoders, encoders, poses
from saunet.types import DepthPyramid, FeatureSpec

HEIGHT, WIDTH = 64, 96


def _small(decoder: str = "aunet", **kwargs) -> DepthNet:
    return DepthNet(encoders.build("resnet18", blocks=(1, 1, 1, 1)), decoders.partial(decoder), **kwargs)


def test_depth_pyramid():
    net = _small(min_depth=0.5, max_depth=50.0)
    pyramid = net(torch.rand(2, 3, HEIGHT, WIDTH))
    assert isinstance(pyramid, DepthPyramid)
    assert net.features == net.encoder.features
    assert net.size_divisor == 32
    for scale in range(4):
        assert pyramid.depth[scale].shape == (2, 1, HEIGHT // 2**scale, WIDTH // 2**scale)
        torch.testing.assert_close(pyramid.disparity[scale], 0.02 + (2 - 0.02) * pyramid.sigmoid[scale])
        torch.testing.assert_close(
            pyramid.depth[scale] * pyramid.disparity[scale],
            torch.ones(()).expand(2, 1, *pyramid.depth[scale].shape[-2:]),
        )
    (pyramid.depth[0].mean() + sum(d.mean() for d in pyramid.disparity)).backward()
    assert_all_have_gradients(net)


def test_sau_net_is_no_larger_than_the_papers():
    with torch.device("meta"):
        depth = DepthNet(encoders.build("stratified_tiny"), decoders.partial("aunet"))
        pose = poses.build("resnet34")
    assert sum(p.numel() for part in (depth, pose) for p in part.parameters()) <= 58.8e6  # SAU-Net's Table 2


@pytest.mark.parametrize("name", ["unet", "aunet"])
def test_starts_at_mid_disparity(name):
    with torch.no_grad():
        for sigmoid in _small(name)(torch.rand(2, 3, HEIGHT, WIDTH)).sigmoid:
            assert 0.2 < sigmoid.mean() < 0.42
            assert sigmoid.min() > 0.05
            assert sigmoid.max() < 0.8


@pytest.mark.parametrize(
    ("size", "valid"),
    [((190, 640), "192x640"), ((192, 650), "192x640"), ((10, 10), "32x32")],
)
def test_size_error(size, valid):
    net = DepthNet(encoders.build("resnet18", blocks=(1, 1, 1, 1)), decoders.partial("unet"))
    with pytest.raises(
        ConfigError, match=rf"image {size[0]}x{size[1]} .* stride 32; the nearest valid size is {valid}"
    ):
        net(torch.zeros(1, 3, *size))


class _Announces(nn.Module):
    """Maps of 4 and 8 channels at 1/2 and 1/4, and whatever it says of them."""

    size_divisor = 4

    def __init__(self, features: object) -> None:
        super().__init__()
        self.features = features

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        batch, _, height, width = image.shape
        return [torch.rand(batch, 4, height // 2, width // 2), torch.rand(batch, 8, height // 4, width // 4)]


@pytest.mark.parametrize(
    ("features", "said"),
    [
        ([(4, 2), (9, 4)], r"maps of 4x16x24, 8x8x12 for an image of 32x48.*'features' announce 4x16x24, 9x8x12"),
        ([(4, 2), (8, 8)], r"announce 4x16x24, 8x4x6"),
        ([(4, 2)], r"announce 4x16x24;"),
        ([(4, 2), (8, 4), (8, 8)], r"announce 4x16x24, 8x8x12, 8x4x6"),
    ],
)
def test_maps_that_are_not_what_the_encoder_announces_are_one_sentence(features, said):
    net = DepthNet(_Announces([FeatureSpec(*each) for each in features]), decoders.partial("unet", scales=(0,)))
    with pytest.raises(ConfigError, match=f"_Announces returns {said}" if said.startswith("maps") else said):
        net(torch.rand(1, 3, 32, 48))


def test_features_that_are_no_features_are_one_sentence():
    with pytest.raises(ConfigError, match=r"'features' of the encoder _Announces is \[\(4, 2\)\].*FeatureSpec"):
        DepthNet(_Announces([(4, 2)]), decoders.partial("unet"))


def test_maps_as_announced_are_decoded():
    net = DepthNet(_Announces([FeatureSpec(4, 2), FeatureSpec(8, 4)]), decoders.partial("unet", scales=(0,)))
    assert net(torch.rand(1, 3, 32, 48)).depth[0].shape == (1, 1, 32, 48)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("image", "said"),
    [
        (torch.zeros(3, 32, 32), r"torch.float32 of shape \(3, 32, 32\)"),
        (torch.zeros(1, 3, 32, 32, dtype=torch.uint8), r"torch.uint8 of shape \(1, 3, 32, 32\)"),
        (torch.zeros(1, 32, 32, 3), r"shape \(1, 32, 32, 3\)"),
    ],
)
def test_what_is_no_batch_of_images_is_refused(image, said):
    with pytest.raises(ConfigError, match=said):
        _small()(image)


@pytest.mark.parametrize("decoder", ["unet", "aunet"])
def test_smallest_image(decoder):
    net = _small(decoder).eval()
    with torch.no_grad():
        assert net(torch.rand(1, 3, 32, 32)).depth[0].shape == (1, 1, 32, 32)


@pytest.mark.parametrize("limits", [(0.0, 80.0), (5.0, 5.0), (-1.0, 80.0)])
def test_depth_limits(limits):
    with pytest.raises(ConfigError, match="they must satisfy 0 < min_depth < max_depth"):
        _small(min_depth=limits[0], max_depth=limits[1])


def test_an_encoder_of_several_frames_is_refused():
    with pytest.raises(ConfigError, match="encoder has frames=2; depth comes from one image: set frames=1"):
        DepthNet(encoders.build("resnet18", blocks=(1, 1, 1, 1), frames=2), decoders.partial("unet"))


def test_half_precision_keeps_disparity_fine():
    net = _small().eval()
    image = torch.rand(1, 3, HEIGHT, WIDTH)
    with torch.no_grad():
        full = net(image)
        with torch.autocast("cpu", torch.bfloat16):
            half = net(image)
    assert half.depth[0].dtype == torch.float32
    assert (half.sigmoid[0] - full.sigmoid[0]).abs().max() < 0.02
