"""Lite-Mono: published sizes, its attention in NumPy, its dilations."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from saunet.errors import ConfigError
from saunet.models.depth import DepthNet
from saunet.models.encoders.lite_mono import CrossCovarianceAttention, DilatedBlock, FourierPosition
from saunet.registry import decoders, encoders
from saunet.types import FeatureSpec


# Lite-Mono's Table 2, encoder and decoder, in millions, as printed: to one decimal, so that 2.15 is 2.2
@pytest.mark.parametrize(
    ("name", "millions"),
    [("lite_mono", 3.1), ("lite_mono_small", 2.5), ("lite_mono_tiny", 2.2), ("lite_mono_8m", 8.7)],
)
def test_published_size(name, millions):
    with torch.device("meta"):
        net = DepthNet(encoders.build(name), decoders.partial("lite_mono"))
    assert sum(p.numel() for p in net.parameters()) / 1e6 == pytest.approx(millions, rel=0.02, abs=0.06)


def test_dilations():
    with torch.device("meta"):
        stages = encoders.build("lite_mono").stages
    rates = [[b.depthwise.dilation[0] for b in stage if isinstance(b, DilatedBlock)] for stage in stages]
    assert rates == [[1, 2, 3], [1, 2, 3], [1, 2, 3, 1, 2, 3, 2, 4, 6]]


def test_attention_among_channels():
    attention = CrossCovarianceAttention(8, heads=2)
    torch.nn.init.uniform_(attention.temperature, 0.5, 2)
    tokens = torch.randn(1, 12, 8)
    with torch.no_grad():
        got = attention(tokens)[0].numpy()
    w = {name: p.detach().numpy().astype(np.float64) for name, p in attention.named_parameters()}
    qkv = tokens[0].numpy() @ w["qkv.weight"].T + w["qkv.bias"]
    mixed = []
    for head in range(2):
        q, k, v = (qkv[:, i * 8 + head * 4 : i * 8 + head * 4 + 4] for i in range(3))  # 12 pixels x 4 channels
        q, k = q / np.linalg.norm(q, axis=0), k / np.linalg.norm(k, axis=0)
        scores = np.exp(w["temperature"][head, 0, 0] * q.T @ k)
        mixed.append(v @ (scores / scores.sum(1, keepdims=True)).T)
    expected = np.concatenate(mixed, 1) @ w["proj.weight"].T + w["proj.bias"]
    np.testing.assert_allclose(got, expected, atol=1e-5)


def test_heads_must_divide():
    with pytest.raises(ConfigError, match="heads is 3; it must divide the 8 channels"):
        CrossCovarianceAttention(8, heads=3)


def test_position_code_tells_rows_from_columns():
    position = FourierPosition(16)
    with torch.no_grad():
        position.project.weight.zero_()
        position.project.weight[0, 0] = 1  # the slowest sine of the row
        position.project.weight[1, 32] = 1  # and of the column
        position.project.bias.zero_()
        code = position(torch.zeros(2, 16, 4, 6))
    rows = torch.sin(2 * torch.pi * torch.arange(1, 5) / 4)
    columns = torch.sin(2 * torch.pi * torch.arange(1, 7) / 6)
    torch.testing.assert_close(code[0, 0], rows[:, None].expand(4, 6), atol=1e-6, rtol=0)
    torch.testing.assert_close(code[0, 1], columns.expand(4, 6), atol=1e-6, rtol=0)


def test_starts_as_strided_convolutions():
    """The layer scale silences every residual branch at the start."""
    encoder = encoders.build("lite_mono_tiny").eval()
    with torch.no_grad():
        image = torch.rand(1, 3, 32, 32)
        start = encoder(image)
        for name, parameter in encoder.named_parameters():
            if "scale" in name:
                parameter.zero_()
        silent = encoder(image)
        for name, parameter in encoder.named_parameters():
            if "scale" in name:
                parameter.fill_(1)
        loud = encoder(image)
    for a, b, c in zip(start, silent, loud, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-4)
        assert (c - b).abs().max() > 1e-2


@pytest.mark.parametrize("kwargs", [{"dims": (8, 8)}, {"depths": (4, 4, 1)}])
def test_wrong_stages(kwargs):
    with pytest.raises(ConfigError, match="Lite-Mono has three stages with at least two blocks"):
        encoders.build("lite_mono", **kwargs)


@pytest.mark.parametrize("kwargs", [{"rates": ()}, {"rates": (1, 0)}, {"last_rates": (-2,)}])
def test_wrong_rates(kwargs):
    with pytest.raises(ConfigError, match="dilation rates are 1 or more, and rates is not empty"):
        encoders.build("lite_mono", **kwargs)


def test_last_stage_may_go_through_the_rates_alone():
    with torch.device("meta"):
        stage = encoders.build("lite_mono", depths=(2, 2, 5), last_rates=()).stages[2]
    assert [b.depthwise.dilation[0] for b in stage if isinstance(b, DilatedBlock)] == [1, 2, 3, 1]


def test_wrong_drop_path():
    with pytest.raises(ConfigError, match=r"drop_path is 1\.5"):
        encoders.build("lite_mono", drop_path=1.5)


def test_decoder_needs_a_level():
    with pytest.raises(ConfigError, match=r"deepest stride is 2; .* needs at least 4"):
        decoders.build("lite_mono", features=(FeatureSpec(8, 2),))


def test_weights_start_as_published():
    """Encoder: He's normal distribution, fan out, for convolutions and linear layers; decoder: 0.02 and zero biases."""
    encoder = encoders.build("lite_mono")
    for layer in (encoder.reductions[1], encoder.stages[2][0].expand, encoder.stages[2][0].reduce, encoder.stem[3]):
        fan_out = layer.weight[:, 0].numel()
        assert layer.weight.std().item() == pytest.approx((2 / fan_out) ** 0.5, rel=0.05)
    decoder = decoders.build("lite_mono", features=encoder.features)
    for block in (*decoder.before, *decoder.after):
        assert block[0].weight.std().item() == pytest.approx(0.02, rel=0.05)
        assert not block[0].bias.any()


def test_the_input_is_normalized_as_published():
    """(x - 0.45) / 0.225: a picture of that gray gives what zeros give to the bare stem."""
    encoder = encoders.build("lite_mono_tiny").eval()
    seen = []
    encoder.stem[0].register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    with torch.no_grad():
        encoder(torch.full((1, 3, 32, 32), 0.45))
        encoder(torch.full((1, 3, 32, 32), 0.675))
    torch.testing.assert_close(seen[0], torch.zeros(1, 3, 32, 32), atol=1e-6, rtol=0)
    torch.testing.assert_close(seen[1], torch.ones(1, 3, 32, 32), atol=1e-5, rtol=0)
