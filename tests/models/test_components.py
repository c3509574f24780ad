"""What every registered encoder, decoder, attention and pose network owes the others; registering a name tests it."""

from __future__ import annotations

import io
import pickle
import subprocess
import sys
from functools import cache

import pytest
import torch

import saunet
from saunet.checks import ConfigError
from saunet.models.depth import DepthNet
from saunet.models.encoders.resnet import BasicBlock, Bottleneck
from saunet.registry import attentions, decoders, encoders, poses
from saunet.types import DepthPyramid, FeatureSpec

HEIGHT, WIDTH = 64, 96


@cache
def _features(name: str) -> tuple[FeatureSpec, ...]:
    with torch.device("meta"):  # specs only: no memory, no initialisation
        return encoders.build(name).features


def _distinct_features() -> list[tuple[FeatureSpec, ...]]:
    return list(dict.fromkeys(_features(name) for name in saunet.available("encoder")))


def _assert_all_have_gradients(module: torch.nn.Module) -> None:
    without = [name for name, p in module.named_parameters() if p.requires_grad and p.grad is None]
    assert not without, f"no gradient reaches {without}"
    broken = [name for name, p in module.named_parameters() if p.grad is not None and not p.grad.isfinite().all()]
    assert not broken, f"gradient is not finite in {broken}"


def _assert_pickles(module: torch.nn.Module) -> None:
    pickle.dump(module, io.BytesIO())


@pytest.mark.parametrize("name", saunet.available("encoder"))
def test_encoder(name):
    encoder = encoders.build(name)
    image = torch.rand(2, 3, HEIGHT, WIDTH)
    features = encoder(image)
    assert HEIGHT % encoder.size_divisor == 0
    assert [f.stride for f in encoder.features] == sorted(f.stride for f in encoder.features)
    assert len(features) == len(encoder.features)
    for feature, spec in zip(features, encoder.features, strict=True):
        assert feature.shape == (2, spec.channels, HEIGHT // spec.stride, WIDTH // spec.stride)
        assert feature.isfinite().all()
    sum(feature.square().mean() for feature in features).backward()
    _assert_all_have_gradients(encoder)
    if sum(p.numel() for p in encoder.parameters()) < 3e7:
        _assert_pickles(encoder)


@pytest.mark.parametrize(
    "features", _distinct_features(), ids=lambda f: "_".join(f"{s.channels}@{s.stride}" for s in f)
)
@pytest.mark.parametrize("name", saunet.available("decoder"))
def test_decoder_follows_encoder(name, features):
    decoder = decoders.build(name, features=features)
    maps = [torch.randn(1, f.channels, HEIGHT // f.stride, WIDTH // f.stride, requires_grad=True) for f in features]
    sigmoids = decoder(maps)
    assert len(sigmoids) == len(decoder.scales)
    for scale, sigmoid in zip(decoder.scales, sigmoids, strict=True):
        assert sigmoid.shape == (1, 1, HEIGHT // 2**scale, WIDTH // 2**scale)
        assert sigmoid.min() > 0
        assert sigmoid.max() < 1
    sum(s.mean() for s in sigmoids).backward()
    _assert_all_have_gradients(decoder)
    assert all(m.grad is not None for m, f in zip(maps, features, strict=True) if f.stride > 1)
    _assert_pickles(decoder)


@pytest.mark.parametrize("attention", saunet.available("attention"))
def test_attention_in_aunet(attention):
    decoder = decoders.build(
        "aunet", features=(FeatureSpec(8, 2), FeatureSpec(12, 4)), width=32, attention=attention, scales=(0, 1)
    )
    maps = decoder([torch.randn(1, 8, 16, 24), torch.randn(1, 12, 8, 12)])
    sum(m.mean() for m in maps).backward()
    _assert_all_have_gradients(decoder)
    _assert_pickles(decoder)


@pytest.mark.parametrize("name", saunet.available("decoder"))
def test_decoder_refuses_scales(name):
    features = (FeatureSpec(8, 2), FeatureSpec(8, 4), FeatureSpec(8, 8), FeatureSpec(8, 16))
    assert len(decoders.build(name, features=features, scales=[0])(_maps(features))) == 1
    for scales in ([0, 2], [1, 0], [], list(range(9))):
        with pytest.raises(ConfigError, match=r"scales is \[.*allowed: \[0, 1"):
            decoders.build(name, features=features, scales=scales)


@pytest.mark.parametrize("name", saunet.available("decoder"))
def test_decoder_refuses_strides(name):
    with pytest.raises(ConfigError, match=r"strides \[2, 6\]; a decoder needs ascending powers of two"):
        decoders.build(name, features=(FeatureSpec(8, 2), FeatureSpec(8, 6)))


@pytest.mark.parametrize("name", saunet.available("pose"))
def test_pose(name):
    pose = poses.build(name)
    T_src_tgt = pose(torch.rand(2, 3, 64, 64), torch.rand(2, 2, 3, 64, 64))
    assert T_src_tgt.shape == (2, 2, 4, 4)
    T_src_tgt.square().sum().backward()
    _assert_all_have_gradients(pose)
    if sum(p.numel() for p in pose.parameters()) < 3e7:
        _assert_pickles(pose)


def _maps(features):
    return [torch.randn(1, f.channels, 32 // f.stride, 32 // f.stride) for f in features]


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
    _assert_all_have_gradients(net)


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


@pytest.mark.parametrize("decoder", ["unet", "aunet"])
def test_smallest_image(decoder):
    net = _small(decoder).eval()
    with torch.no_grad():
        assert net(torch.rand(1, 3, 32, 32)).depth[0].shape == (1, 1, 32, 32)


@pytest.mark.parametrize("limits", [(0.0, 80.0), (5.0, 5.0), (-1.0, 80.0)])
def test_depth_limits(limits):
    with pytest.raises(ConfigError, match="needed: 0 < min_depth < max_depth"):
        _small(min_depth=limits[0], max_depth=limits[1])


def test_half_precision_keeps_disparity_fine():
    net = _small().eval()
    image = torch.rand(1, 3, HEIGHT, WIDTH)
    with torch.no_grad():
        full = net(image)
        with torch.autocast("cpu", torch.bfloat16):
            half = net(image)
    assert half.depth[0].dtype == torch.float32
    assert (half.sigmoid[0] - full.sigmoid[0]).abs().max() < 0.02


@pytest.mark.parametrize("name", saunet.available("decoder"))
def test_exports(name):
    net = _small(name).eval()
    image = torch.rand(1, 3, HEIGHT, WIDTH)
    with torch.no_grad():
        program = torch.export.export(net, (image,))
        torch.testing.assert_close(program.module()(image).depth, net(image).depth)


def _settle(encoder: torch.nn.Module, image: torch.Tensor) -> torch.nn.Module:
    """Make an untrained encoder as tame as a trained one, where rounding does not grow from block to block.

    Batch normalisation gets the statistics of one batch, and a ResNet's residual branches become small.
    """
    for module in encoder.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.momentum = 1.0
        if isinstance(module, BasicBlock | Bottleneck):
            torch.nn.init.constant_((module.bn2 if isinstance(module, BasicBlock) else module.bn3).weight, 0.2)
    with torch.no_grad():
        encoder.train()(image)
    return encoder.eval()


@pytest.mark.slow
@pytest.mark.parametrize("name", saunet.available("encoder"))
def test_every_network_exports_and_runs_in_half(name):
    image = torch.rand(2, 3, HEIGHT, WIDTH)
    encoder = _settle(encoders.build(name), image)
    for decoder in saunet.available("decoder"):
        net = DepthNet(encoder, decoders.partial(decoder)).eval()
        with torch.no_grad():
            full = net(image)
            with torch.autocast("cpu", torch.bfloat16):
                half = net(image)
            if decoder == "aunet":  # every decoder is exported above
                program = torch.export.export(net, (image,))
                torch.testing.assert_close(program.module()(image).depth, full.depth)
        assert half.depth[0].dtype == torch.float32
        assert (half.sigmoid[0] - full.sigmoid[0]).abs().max() < 0.03, decoder


_COMPILE = """
import sys, torch, saunet
from saunet.models.depth import DepthNet
from saunet.registry import decoders, encoders

for encoder, decoder in [pair.split("+") for pair in sys.argv[2:]]:
    net = DepthNet(encoders.build(encoder), decoders.partial(decoder)).eval()
    image = torch.rand(1, 3, 64, 96)
    torch.compiler.reset()
    with torch.no_grad():
        compiled = torch.compile(net, fullgraph=True, backend=sys.argv[1])(image)
        torch.testing.assert_close(compiled.disparity, net(image).disparity, rtol=1e-3, atol=1e-4)
"""


def _compile(backend: str, *pairs: str) -> None:
    """Compile networks in a process of its own: the compiler cannot look into the tests' type checker."""
    done = subprocess.run(
        [sys.executable, "-c", _COMPILE, backend, *pairs], capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("decoder", saunet.available("decoder"))
def test_decoder_compiles(decoder):
    _compile("inductor", f"resnet18+{decoder}")


@pytest.mark.slow
def test_every_encoder_compiles_to_one_graph():
    _compile("eager", *(f"{encoder}+aunet" for encoder in saunet.available("encoder")))


def test_too_few_channels():
    with pytest.raises(ConfigError, match="stride of 32 needs 5 levels"):
        decoders.build("unet", features=_features("resnet18"), channels=(16, 32))


def test_unknown_attention():
    with pytest.raises(ConfigError, match="unknown attention 'eac'; did you mean 'eca'"):
        decoders.build("aunet", features=_features("resnet18"), attention="eac")


def test_unet_is_monodepth2s():
    # Monodepth2's ResNet-18 depth decoder has 3 152 724 parameters.
    decoder = decoders.build("unet", features=_features("resnet18"))
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


@pytest.mark.parametrize("name", saunet.available("attention"))
def test_attention_keeps_shape(name):
    module = attentions.build(name, channels=32)
    x = torch.randn(2, 32, 3, 5, requires_grad=True)
    y = module(x)
    assert y.shape == x.shape
    y.sum().backward()
    assert x.grad.isfinite().all()
