"""Swin blocks, merging and recomputation."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch.utils.flop_counter import FlopCounterMode

from saunet.models.layers import window
from saunet.models.layers.window import PatchMerging, SwinBlock, SwinStage, streams


def test_block_is_eqs_1_to_4() -> None:
    block = SwinBlock(8, 2, 4, shift=2).double().eval()
    x = torch.randn(2, 8, 12, 8, dtype=torch.double)
    middle = block.attn(F.layer_norm(x, (8,), block.norm1.weight, block.norm1.bias)) + x
    hidden = block.mlp.fc1(F.layer_norm(middle, (8,), block.norm2.weight, block.norm2.bias))
    gelu = hidden * 0.5 * (1 + torch.erf(hidden / 2**0.5))
    torch.testing.assert_close(block(x), block.mlp.fc2(gelu) + middle)


def test_stage_alternates_plain_and_shifted_windows() -> None:
    stage = SwinStage(8, 3, 2, 5, 4.0, (0.0, 0.1, 0.2))
    assert [block.attn.shift for block in stage.blocks] == [0, 2, 0]
    assert [block.drop_path.rate for block in stage.blocks] == [0.0, 0.1, 0.2]


def test_merging_order_is_swins() -> None:
    merge = PatchMerging(1)
    with torch.no_grad():
        merge.reduction.weight.copy_(torch.eye(4)[[1, 2]])
    merge.norm = torch.nn.Identity()  # type: ignore[assignment]
    x = torch.arange(8.0).view(1, 2, 4, 1)  # rows 0 1 2 3 / 4 5 6 7
    assert merge(x)[0, 0].tolist() == [[4.0, 1.0], [6.0, 3.0]]  # (row 1, column 0), (row 0, column 1)


@pytest.mark.parametrize("mask_padding", [True, False])
@pytest.mark.parametrize("size", [(8, 12), (9, 11)])
def test_pieces_change_nothing(size: tuple[int, int], mask_padding: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "_CACHED_ELEMENTS", 64 * 24)  # several pieces in every group
    block = SwinBlock(8, 2, 4, shift=2, mask_padding=mask_padding).double().eval()
    x = torch.randn(3, *size, 8, dtype=torch.double)
    before = x.clone()
    with torch.no_grad():
        assert streams(x, block)
        torch.testing.assert_close(block(x), x + (y := block.attn(block.norm1(x))) + block.mlp(block.norm2(x + y)))
    assert torch.equal(x, before)


def test_what_watches_or_replaces_a_layer_is_respected() -> None:
    block, x, seen = SwinBlock(8, 2, 4).eval(), torch.randn(1, 8, 8, 8), []
    assert not streams(x, block)
    with torch.no_grad():
        assert streams(x, block)
        assert not streams(x, block.train())
        block.eval()
        with torch.autocast("cpu", torch.bfloat16):
            assert not streams(x, block)
        with FlopCounterMode(display=False):
            assert not streams(x, block)
        handle = block.mlp.fc1.register_forward_hook(lambda *call: seen.append(call[2].shape))
        assert not streams(x, block)
        block(x)
        assert seen == [(1, 8, 8, 32)]
        handle.remove()
        block.mlp.fc1 = torch.nn.Sequential(block.mlp.fc1)  # type: ignore[assignment]
        assert not streams(x, block)


@pytest.mark.parametrize("fused", [True, False])
def test_streamed_mlp_gives_the_same_fused_or_in_two_passes(fused: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if fused and not window._FUSED:
        pytest.skip("this PyTorch has no oneDNN")
    monkeypatch.setattr(window, "_FUSED", fused)
    monkeypatch.setattr(window, "_CACHED_ELEMENTS", 64 * 32)  # several pieces
    block = SwinBlock(8, 2, 4).eval()
    x = torch.randn(2, 8, 12, 8)
    with torch.no_grad():
        streamed = window.add_mlp_(x.clone(), block.norm2, block.mlp.fc1, block.mlp.fc2)
        torch.testing.assert_close(streamed, x + block.mlp(block.norm2(x)))
