"""What every registered encoder, decoder, attention and pose network owes the others; registering a name tests it."""

from __future__ import annotations

from functools import cache

import pytest
import torch
from networks import assert_all_have_gradients, assert_pickles, buildable_encoders

import saunet
from saunet.registry import attentions, decoders, encoders, poses
from saunet.types import FeatureSpec

HEIGHT, WIDTH = 32, 64


@cache
def _distinct_features() -> list[tuple[FeatureSpec, ...]]:
    with torch.device("meta"):  # specs only: no memory, no initialization
        return list(dict.fromkeys(encoders.build(name).features for name in buildable_encoders()))


@pytest.mark.parametrize("name", buildable_encoders())
def test_encoder(name):
    encoder = encoders.build(name)
    # PackNet's 3D convolutions take seconds an image.
    batch, height, width = (1, 32, 32) if name == "packnet" else (2, 64, 96)
    features = encoder(torch.rand(batch, 3, height, width))
    assert height % encoder.size_divisor == 0
    assert [f.stride for f in encoder.features] == sorted(f.stride for f in encoder.features)
    assert len(features) == len(encoder.features)
    for feature, spec in zip(features, encoder.features, strict=True):
        assert feature.shape == (batch, spec.channels, height // spec.stride, width // spec.stride)
        assert feature.isfinite().all()
    sum(feature.square().mean() for feature in features).backward()
    assert_all_have_gradients(encoder)
    if sum(p.numel() for p in encoder.parameters()) < 3e7:
        assert_pickles(encoder)


@pytest.mark.parametrize("name", saunet.available("decoder"))
def test_decoder_follows_every_encoder(name):
    for features in _distinct_features():
        _check_decoder(name, features)


def _check_decoder(name, features):
    decoder = decoders.build(name, features=features)
    maps = [torch.randn(1, f.channels, HEIGHT // f.stride, WIDTH // f.stride, requires_grad=True) for f in features]
    sigmoids = decoder(maps)
    assert len(sigmoids) == len(decoder.scales)
    for scale, sigmoid in zip(decoder.scales, sigmoids, strict=True):
        assert sigmoid.shape == (1, 1, HEIGHT // 2**scale, WIDTH // 2**scale)
        assert sigmoid.min() > 0
        assert sigmoid.max() < 1
    sum(s.mean() for s in sigmoids).backward()
    assert_all_have_gradients(decoder)
    assert all(m.grad is not None for m, f in zip(maps, features, strict=True) if f.stride > 1)
    assert_pickles(decoder)


@pytest.mark.parametrize("attention", saunet.available("attention"))
def test_attention_in_aunet(attention):
    decoder = decoders.build(
        "aunet", features=(FeatureSpec(8, 2), FeatureSpec(12, 4)), width=32, attention=attention, scales=(0, 1)
    )
    maps = decoder([torch.randn(1, 8, 16, 24), torch.randn(1, 12, 8, 12)])
    sum(m.mean() for m in maps).backward()
    assert_all_have_gradients(decoder)
    assert_pickles(decoder)


@pytest.mark.parametrize("name", saunet.available("attention"))
def test_attention_keeps_shape(name):
    module = attentions.build(name, channels=32)
    x = torch.randn(2, 32, 3, 5, requires_grad=True)
    y = module(x)
    assert y.shape == x.shape
    y.sum().backward()
    assert x.grad.isfinite().all()


@pytest.mark.parametrize("name", saunet.available("pose"))
def test_pose(name):
    pose = poses.build(name)
    T_src_tgt = pose(torch.rand(2, 3, 64, 64), torch.rand(2, 2, 3, 64, 64))
    assert T_src_tgt.shape == (2, 2, 4, 4)
    T_src_tgt.square().sum().backward()
    assert_all_have_gradients(pose)
    if sum(p.numel() for p in pose.parameters()) < 3e7:
        assert_pickles(pose)
