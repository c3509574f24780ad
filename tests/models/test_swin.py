"""Swin features against the established implementations, number by number."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from saunet.models.encoders.swin import SwinTransformer
from saunet.registry import encoders

Reference = Callable[[str], Mapping[str, Any]]


@pytest.fixture(scope="module")
def small(reference: Reference) -> SwinTransformer:
    encoder = SwinTransformer(dim=24, depths=(2, 2), heads=(2, 4), window=(7, 7)).eval()
    state = {
        name: torch.from_numpy(value).float()
        for name, value in reference("swin_state").items()
        if "relative_position_index" not in name and "attn_mask" not in name and not name.startswith("norm.")
    }
    missing, unexpected = encoder.load_state_dict(state, strict=False)
    assert not unexpected
    assert all(name.startswith("norm") for name in missing)
    encoder.norm0 = nn.Identity()
    encoder.norm1 = nn.Identity()
    encoder.mean.zero_()
    encoder.std.fill_(1)
    return encoder


def rows(feature: Tensor) -> Tensor:
    return feature.flatten(2).transpose(1, 2)


@pytest.mark.parametrize("grad", [False, True])
@pytest.mark.parametrize(
    ("case", "last"),
    [("", "stage1"), ("padded_", "stage1"), ("edge_", "stage1_torchvision")],
    ids=["plain", "padded", "edge"],
)
def test_stages_equal_the_reference(
    small: SwinTransformer, reference: Reference, case: str, last: str, grad: bool
) -> None:
    data = reference("swin")
    with torch.set_grad_enabled(grad):
        stage0, stage1 = small(torch.from_numpy(data[f"{case}input"]))
    assert list(stage0.shape[2:]) == data[f"{case}stage0_hw"].tolist()
    assert list(stage1.shape[2:]) == data[f"{case}stage1_hw"].tolist()
    torch.testing.assert_close(rows(stage0), torch.from_numpy(data[f"{case}stage0"]), atol=1e-4, rtol=0)
    torch.testing.assert_close(rows(stage1), torch.from_numpy(data[f"{case}{last}"]), atol=1e-4, rtol=0)


def test_masked_padding_differs_only_where_windows_are_cut(small: SwinTransformer, reference: Reference) -> None:
    masked = SwinTransformer(dim=24, depths=(2, 2), heads=(2, 4), window=(7, 7), mask_padding=True).eval()
    masked.load_state_dict(small.state_dict(), strict=False)
    masked.mean.zero_()
    masked.std.fill_(1)
    masked.norm0 = nn.Identity()
    with torch.no_grad():
        image = torch.from_numpy(reference("swin")["padded_input"])
        ours, theirs = masked(image)[0], small(image)[0]
    difference = (ours - theirs).abs().amax(1)[0]
    assert difference.max() > 0.1
    # window 7, shift 3: rows 14, 15 and columns 35 ... 39 are cut; two blocks carry that one window further
    assert difference[:10, :31].max() < 1e-4


def test_presets_have_swins_sizes() -> None:
    with torch.device("meta"):
        tiny, small = encoders.build("swin_tiny"), encoders.build("swin_small")
    assert [(spec.channels, spec.stride) for spec in tiny.features] == [(96, 4), (192, 8), (384, 16), (768, 32)]
    assert tiny.size_divisor == 32
    head = 768 * 1000 + 1000
    norms = 2 * (96 + 192 + 384)  # the classifier has only the last of the four output norms
    parameters = sum(parameter.numel() for parameter in tiny.parameters())
    assert parameters + head - norms == 28_288_354
    assert sum(parameter.numel() for parameter in small.parameters()) + head - norms == 49_606_258
