"""Decoders: what they refuse, and what makes U-Net and AU-Net the published ones."""

from __future__ import annotations

from functools import cache

import pytest
import torch

import saunet
from saunet.errors import ConfigError
from saunet.registry import decoders, encoders
from saunet.types import FeatureSpec


@cache
def _resnet18() -> tuple[FeatureSpec, ...]:
    with torch.device("meta"):  # specs only: no memory, no initialization
        return encoders.build("resnet18").features


def _maps(features):
    return [torch.randn(1, f.channels, 32 // f.stride, 32 // f.stride) for f in features]


@pytest.mark.parametrize("name", saunet.available("decoder"))
def test_decoder_refuses_scales(name):
    features = (FeatureSpec(8, 2), FeatureSpec(8, 4), FeatureSpec(8, 8), FeatureSpec(8, 16))
    assert len(decoders.build(name, features=features, scales=[0])(_maps(features))) == 1
    for scales in ([0, 2], [1, 0], [], list(range(9))):
        with pytest.raises(ConfigError, match=r"scales is \[.*allowed: \[0, 1"):
            decoders.build(name, features=features, scales=scales)


def test_an_encoder_with_few_maps_is_named_as_the_cause_with_the_setting_that_helps():
    features = (FeatureSpec(8, 2), FeatureSpec(8, 4), FeatureSpec(8, 8))
    with pytest.raises(ConfigError, match=r"encoder's 3 maps end at stride 8: set model\.decoder\.scales=\[0,1,2\]$"):
        decoders.build("unet", features=features)
    assert len(decoders.build("unet", features=features, scales=[0, 1, 2])(_maps(features))) == 3


@pytest.mark.parametrize("name", saunet.available("decoder"))
def test_decoder_refuses_strides(name):
    with pytest.raises(ConfigError, match=r"strides \[2, 6\]; a decoder needs ascending powers of two"):
        decoders.build(name, features=(FeatureSpec(8, 2), FeatureSpec(8, 6)))


def test_too_few_channels():
    with pytest.raises(ConfigError, match="stride of 32 needs 5 numbers"):
        decoders.build("unet", features=_resnet18(), channels=(16, 32))


def test_unknown_attention():
    with pytest.raises(ConfigError, match="unknown attention 'eac'; did you mean 'eca'"):
        decoders.build("aunet", features=_resnet18(), attention="eac")


def test_unet_is_monodepth2s():
    # Monodepth2's ResNet-18 depth decoder has 3 152 724 parameters.
    decoder = decoders.build("unet", features=_resnet18())
    assert sum(p.numel() for p in decoder.parameters()) == 3_152_724


def test_aunet_sums_features():
    """With the mappings silenced, the pre-head map is eq. (5): the sum of the upsampled projections."""
    features = (FeatureSpec(6, 2), FeatureSpec(8, 4), FeatureSpec(10, 8))
    decoder = decoders.build("aunet", features=features, width=12, attention="none", scales=(0, 1))
    for mapping in decoder.mappings:
        torch.nn.init.zeros_(mapping.mix.weight)
        torch.nn.init.zeros_(mapping.mix.bias)
    torch.nn.init.zeros_(decoder.bottleneck.reduce.weight)
    torch.nn.init.zeros_(decoder.bottleneck.reduce.bias)
    seen = []
    decoder.heads[1].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    maps = [torch.randn(1, f.channels, 64 // f.stride, 64 // f.stride) for f in features]
    with torch.no_grad():
        decoder(maps)
        expected = 0
        for project, feature in zip(reversed(decoder.projections), reversed(maps), strict=True):
            if torch.is_tensor(expected):
                expected = torch.nn.functional.interpolate(
                    expected, scale_factor=2, mode="bilinear", align_corners=False
                )
            expected = expected + project(feature)
    torch.testing.assert_close(seen[0], expected)


def test_aunet_sums_in_place_only_where_no_gradient_is_wanted():
    decoder, seen = decoders.build("aunet", features=_resnet18()).eval(), []
    maps = _maps(_resnet18())
    before = [each.clone() for each in maps]
    with torch.no_grad():
        quick = decoder(maps)
    for mapping in decoder.mappings:  # what looks at a layer's output in training finds it as the layer made it
        mapping.mix.register_forward_hook(lambda module, given, made: seen.append((made, made.clone())))
        mapping.mix.register_full_backward_hook(lambda module, given, made: None)
    slow = decoder(maps)
    sum(each.sum() for each in slow).backward()
    assert all(torch.equal(made, then) for made, then in seen)
    assert len(seen) == len(decoder.mappings)
    for one, other in zip(quick, slow, strict=True):
        torch.testing.assert_close(one, other)
    assert all(map(torch.equal, maps, before))
