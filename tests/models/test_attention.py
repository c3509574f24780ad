"""Each attention against its paper's equations in plain NumPy, and its parameter count."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from saunet.errors import ConfigError
from saunet.registry import attentions


def _count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def _sigmoid(x):
    return 1 / (1 + np.exp(-x))


def _run(module, x):
    with torch.no_grad():
        return module(torch.from_numpy(x)).numpy()


def _weights(module):
    return {name: p.detach().numpy().astype(np.float64) for name, p in module.named_parameters()}


@pytest.fixture
def x():
    return np.random.default_rng(0).standard_normal((2, 32, 4, 6)).astype(np.float32)


# k = |log2(C)/2 + 1/2| to the next odd number; ECA-Net's own examples are 5 for 256 and 512 channels.
@pytest.mark.parametrize(("channels", "k"), [(16, 3), (32, 3), (64, 3), (128, 5), (256, 5), (512, 5)])
def test_eca_count(channels, k):
    assert _count(attentions.build("eca", channels=channels)) == k


def test_eca(x):
    module = attentions.build("eca", channels=32)
    kernel = _weights(module)["conv.weight"].ravel()
    padded = np.pad(x.mean((2, 3)), ((0, 0), (1, 1)))
    mixed = np.stack([padded[:, i : i + 3] @ kernel for i in range(32)], 1)
    np.testing.assert_allclose(_run(module, x), x * _sigmoid(mixed)[:, :, None, None], atol=1e-6)


@pytest.mark.parametrize(("channels", "hidden"), [(64, 4), (32, 2), (8, 1)])
def test_se_count(channels, hidden):
    assert _count(attentions.build("se", channels=channels)) == 2 * channels * hidden


def test_se(x):
    module = attentions.build("se", channels=32)
    w = _weights(module)
    hidden = np.maximum(x.mean((2, 3)) @ w["squeeze.weight"].T, 0)
    weight = _sigmoid(hidden @ w["excite.weight"].T)
    np.testing.assert_allclose(_run(module, x), x * weight[:, :, None, None], atol=1e-6)


def test_gct_count():
    assert _count(attentions.build("gct", channels=48)) == 3 * 48


def test_gct_starts_as_identity(x):
    np.testing.assert_array_equal(_run(attentions.build("gct", channels=32), x), x)


def test_gct(x):
    module = attentions.build("gct", channels=32)
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter)
    w = {name: value.ravel() for name, value in _weights(module).items()}
    s = w["alpha"] * np.sqrt((x.astype(np.float64) ** 2).sum((2, 3)) + 1e-5)
    normalized = np.sqrt(32) * s / np.sqrt((s**2).sum(1, keepdims=True) + 32e-5)
    gate = 1 + np.tanh(w["gamma"] * normalized + w["beta"])
    np.testing.assert_allclose(_run(module, x), x * gate[:, :, None, None], atol=1e-5)


def test_gct_survives_half_precision():
    x = torch.full((1, 4, 64, 64), 100.0, dtype=torch.float16)  # the sum of squares is 4e7, beyond float16
    module = attentions.build("gct", channels=4)
    torch.nn.init.ones_(module.gamma)
    y = module(x)
    assert y.dtype == torch.float16
    torch.testing.assert_close(
        y.float(), torch.full_like(y, 100 * (1 + np.tanh(1.0)), dtype=torch.float32), rtol=2e-3, atol=0
    )


@pytest.mark.parametrize(("channels", "hidden"), [(64, 4), (8, 1)])
def test_cbam_count(channels, hidden):
    assert _count(attentions.build("cbam", channels=channels)) == 2 * channels * hidden + 98


def test_cbam(x):
    module = attentions.build("cbam", channels=32, kernel_size=3)
    w = _weights(module)

    def mlp(pooled):
        return np.maximum(pooled @ w["squeeze.weight"].T, 0) @ w["excite.weight"].T

    refined = x * _sigmoid(mlp(x.mean((2, 3))) + mlp(x.max((2, 3))))[:, :, None, None]
    pooled = np.pad(np.stack([refined.mean(1), refined.max(1)], 1), ((0, 0), (0, 0), (1, 1), (1, 1)))
    where = np.zeros((2, 4, 6))
    for v in range(4):
        for u in range(6):
            where[:, v, u] = (pooled[:, :, v : v + 3, u : u + 3] * w["spatial.weight"]).sum((1, 2, 3))
    np.testing.assert_allclose(_run(module, x), refined * _sigmoid(where)[:, None], atol=1e-5)


def test_cbam_even_kernel():
    with pytest.raises(ConfigError, match="kernel_size is 4; it must be an odd number"):
        attentions.build("cbam", channels=8, kernel_size=4)


def test_none(x):
    module = attentions.build("none", channels=32)
    assert _count(module) == 0
    np.testing.assert_array_equal(_run(module, x), x)


@pytest.mark.parametrize("name", ["eca", "se", "gct", "cbam", "none"])
def test_no_channels(name):
    with pytest.raises(ConfigError, match="channels is 0"):
        attentions.build(name, channels=0)
