"""PackNet: published size, and what packing and unpacking do."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from saunet.errors import ConfigError
from saunet.models.depth import DepthNet
from saunet.models.layers.packing import FOLDS, Packing, Unpacking
from saunet.registry import decoders, encoders
from saunet.types import FeatureSpec


def test_published_size():
    with torch.device("meta"):
        net = DepthNet(encoders.build("packnet"), decoders.partial("packnet"))
    assert sum(p.numel() for p in net.parameters()) == pytest.approx(128e6, rel=0.02)


def test_packing_sees_every_pixel():
    packing = Packing(16)
    x = torch.rand(1, 16, 8, 12, requires_grad=True)
    y = packing(x)
    assert y.shape == (1, 16, 4, 6)
    y[:, :, 2, 3].sum().backward()
    assert (x.grad.abs().sum(1) > 0)[0, 2:8, 4:10].all()  # nothing between the strides is lost


def test_unpacking_doubles():
    assert Unpacking(16, 32)(torch.rand(2, 16, 3, 5)).shape == (2, 32, 6, 10)


def test_packing_folds_space_into_channels():
    """With the 3-D convolution the identity, packing is a plain 2-D convolution of the folded pixels."""
    packing = Packing(16)
    with torch.no_grad():
        packing.expand.weight.zero_()
        packing.expand.bias.zero_()
        packing.expand.weight[0, 0, 1, 1, 1] = 1
        x = torch.rand(1, 16, 4, 6)
        folded = x.reshape(1, 16, 2, 2, 3, 2).permute(0, 1, 3, 5, 2, 4).reshape(1, 64, 2, 3)
        conv = packing.reduce.conv
        expected = F.elu(packing.reduce.norm(F.conv2d(folded, conv.weight[:, :64], conv.bias, padding=1)))
        torch.testing.assert_close(packing(x), expected)
    assert conv.in_channels == 64 * FOLDS


def test_coarser_disparity_is_used():
    features = tuple(FeatureSpec(32, 2**i) for i in range(4))
    decoder = decoders.build("packnet", features=features, channels=(32, 32, 32), scales=(0, 1))
    maps = [torch.rand(1, 32, 32 // f.stride, 32 // f.stride) for f in features]
    fine, _ = decoder(maps)
    with torch.no_grad():
        decoder.heads[1].conv.bias.add_(2)
        moved, _ = decoder(maps)
    assert (fine - moved).abs().max() > 1e-4


def test_the_decoder_computes_what_the_published_code_does():
    """Its forward pass once more, from the published definition: zero padding, sigmoid / 0.5 handed on."""
    torch.manual_seed(1)
    features = tuple(FeatureSpec(32, 2**i) for i in range(3))
    decoder = decoders.build("packnet", features=features, channels=(32, 32), scales=(0, 1))
    fine, middle, deep = (torch.randn(1, 32, 16 // f.stride, 24 // f.stride) for f in features)

    def block(conv, norm, x):
        padded = F.conv2d(F.pad(x, [1, 1, 1, 1]), conv.weight, conv.bias)
        return F.elu(F.group_norm(padded, 16, norm.weight, norm.bias))

    def unpack(layer, x):
        x = block(layer.reduce.conv, layer.reduce.norm, x)
        return F.pixel_shuffle(F.conv3d(x[:, None], layer.expand.weight, layer.expand.bias, padding=1).flatten(1, 2), 2)

    def inverse_depth(head, x):
        return torch.sigmoid(F.conv2d(F.pad(x, [1, 1, 1, 1]), head.conv.weight, head.conv.bias)) / 0.5

    with torch.no_grad():
        x = torch.cat([unpack(decoder.unpackings[0], deep), middle], 1)
        x = block(decoder.joins[0].conv, decoder.joins[0].norm, x)
        coarse = inverse_depth(decoder.heads[1], x)
        x = torch.cat([unpack(decoder.unpackings[1], x), fine, F.interpolate(coarse, scale_factor=2)], 1)
        expected = inverse_depth(decoder.heads[0], block(decoder.joins[1].conv, decoder.joins[1].norm, x))
        got = decoder([fine, middle, deep])
    torch.testing.assert_close(got[0], expected * 0.5, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(got[1], coarse * 0.5, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"channels": (16, 16)}, "PackNet has five stages"),
        ({"blocks": (1, 1, 1, 0)}, "PackNet has five stages"),
        ({"channels": (16, 16, 20, 16, 16)}, "give multiples of 16"),
    ],
)
def test_wrong_encoder(kwargs, message):
    with pytest.raises(ConfigError, match=message):
        encoders.build("packnet", **kwargs)


@pytest.mark.parametrize("channels", [(32, 32), (32, 16, 32)])
def test_wrong_decoder(channels):
    with pytest.raises(ConfigError, match="it must be 3 multiples of 32"):
        decoders.build("packnet", features=(FeatureSpec(16, 4), FeatureSpec(16, 8)), channels=channels, scales=(0,))
