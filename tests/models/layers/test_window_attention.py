"""Window attention against a loop over windows, cyclic shift with mask, and its own promises."""

from __future__ import annotations

import copy
import io
import pickle

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from saunet.errors import ConfigError
from saunet.models.layers.window import WindowAttention, add_attention


def make(window: int = 4, shift: int = 2, mask_padding: bool = True, heads: int = 2, dim: int = 8) -> WindowAttention:
    layer = WindowAttention(dim, heads, window, shift, mask_padding).double()
    with torch.no_grad():
        layer.relative_position_bias_table.normal_()
        layer.qkv.bias.normal_()
    return layer.eval()


def naive(layer: WindowAttention, x: Tensor) -> Tensor:
    """The textbook way: pad, roll, cut into windows, attend under a mask of region labels, glue, roll back, crop."""
    _, height, width, dim = x.shape
    window, heads = layer.window, layer.heads
    padded = F.pad(x, (0, 0, 0, -width % window, 0, -height % window))
    rows, columns = padded.shape[1:3]
    shift_y = layer.shift if height > window else 0
    shift_x = layer.shift if width > window else 0
    label = torch.zeros(rows, columns)
    if shift_y:
        label[-window:-shift_y] += 1
        label[-shift_y:] += 2
    if shift_x:
        label[:, -window:-shift_x] += 10
        label[:, -shift_x:] += 20
    real = torch.zeros(rows, columns)
    real[:height, :width] = 1
    rolled = padded.roll((-shift_y, -shift_x), (1, 2))
    real = real.roll((-shift_y, -shift_x), (0, 1))
    out = torch.zeros_like(rolled)
    for top in range(0, rows, window):
        for left in range(0, columns, window):
            box = (slice(None), slice(top, top + window), slice(left, left + window))
            tokens = rolled[box].reshape(x.shape[0], window * window, dim)
            labels, exists = label[box[1:]].flatten(), real[box[1:]].flatten()
            query, key, value = layer.qkv(tokens).chunk(3, -1)
            heads_out = []
            for head in range(heads):
                part = slice(head * dim // heads, (head + 1) * dim // heads)
                scores = query[..., part] @ key[..., part].transpose(1, 2) * (dim // heads) ** -0.5
                for i in range(window * window):
                    for j in range(window * window):
                        dy, dx = i // window - j // window, i % window - j % window
                        row = (dy + window - 1) * (2 * window - 1) + dx + window - 1
                        scores[:, i, j] = scores[:, i, j] + layer.relative_position_bias_table[row, head]
                        if labels[i] != labels[j] or (layer.mask_padding and exists[j] == 0 and exists[i] == 1):
                            scores[:, i, j] = -1e9
                heads_out.append(scores.softmax(-1) @ value[..., part])
            out[box] = layer.proj(torch.cat(heads_out, -1)).view_as(out[box])
    return out.roll((shift_y, shift_x), (1, 2))[:, :height, :width]


@pytest.mark.parametrize("mask_padding", [True, False])
@pytest.mark.parametrize("shift", [0, 2])
@pytest.mark.parametrize(("height", "width", "window"), [(8, 8, 4), (6, 11, 4), (3, 9, 4), (2, 3, 4), (9, 7, 5)])
def test_equals_roll_and_mask(height: int, width: int, window: int, shift: int, mask_padding: bool) -> None:
    layer = make(window, shift, mask_padding)
    x = torch.randn(2, height, width, 8, dtype=torch.double)
    norm = torch.nn.LayerNorm(8).double()
    with torch.no_grad():
        expected = naive(layer, x)
        if not layer.pads(height, width):
            torch.testing.assert_close(add_attention(x, norm, layer), x + naive(layer, norm(x)))
    torch.testing.assert_close(layer(x), expected)


def test_padding_changes_nothing_where_windows_coincide() -> None:
    layer = make(window=4, shift=0)
    x = torch.randn(1, 8, 10, 8, dtype=torch.double)
    torch.testing.assert_close(layer(x)[:, :, :8], layer(x[:, :, :8]))
    wrong = make(window=4, shift=0, mask_padding=False)
    wrong.load_state_dict(layer.state_dict())
    assert (wrong(x) - layer(x))[:, :, 8:].abs().max() > 0.01


def test_tokens_of_other_windows_have_no_influence() -> None:
    layer = make(window=4, shift=0)
    x = torch.randn(1, 8, 8, 8, dtype=torch.double, requires_grad=True)
    layer(x)[0, 0, 0].sum().backward()
    assert x.grad is not None
    reached = x.grad[0].abs().sum(-1) > 0
    assert reached[:4, :4].all()
    assert not reached[4:].any()
    assert not reached[:, 4:].any()


@pytest.mark.usefixtures("unchecked")
def test_gradcheck() -> None:
    layer = make(window=2, shift=1, dim=4)
    x = torch.randn(1, 3, 4, 4, dtype=torch.double, requires_grad=True)
    inputs = (x, layer.relative_position_bias_table)
    assert torch.autograd.gradcheck(lambda x, _: layer(x), inputs)
    assert torch.autograd.gradgradcheck(lambda x, _: layer(x), inputs)


@pytest.mark.parametrize("batch", [1, 3])
def test_batch_of_maps_equals_one_by_one(batch: int) -> None:
    layer = make()
    x = torch.randn(batch, 6, 9, 8, dtype=torch.double)
    torch.testing.assert_close(layer(x), torch.cat([layer(one[None]) for one in x]))


def test_survives_copy_pickle_and_state_dict_after_use() -> None:
    layer = make()
    x = torch.randn(1, 8, 8, 8, dtype=torch.double)
    expected = layer(x)
    assert set(layer.state_dict()) == {
        "relative_position_bias_table",
        "qkv.weight",
        "qkv.bias",
        "proj.weight",
        "proj.bias",
    }
    buffer = io.BytesIO()
    torch.save(layer.state_dict(), buffer)
    for twin in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        torch.testing.assert_close(twin(x), expected)


def test_what_inference_mode_left_behind_can_be_trained_with() -> None:
    layer = make(window=5, shift=2)
    x = torch.randn(1, 11, 13, 8, dtype=torch.double)
    with torch.inference_mode():
        layer(x)
    layer(x.requires_grad_()).sum().backward()
    assert x.grad is not None


def test_refuses_heads_that_do_not_divide() -> None:
    with pytest.raises(ConfigError, match="heads is 3; it must divide the 8 channels"):
        WindowAttention(8, 3, 4)


@pytest.mark.parametrize(("window", "shift"), [(0, 0), (4, 4), (4, -1)])
def test_refuses_impossible_windows(window: int, shift: int) -> None:
    with pytest.raises(ConfigError, match=r"window|shift"):
        WindowAttention(8, 2, window, shift)


@pytest.mark.parametrize("mask_padding", [True, False])
def test_exported_with_any_number_of_maps(mask_padding: bool) -> None:
    """An exporter that leaves the batch open must not fix it, and computes the same."""
    layer = make(mask_padding=mask_padding)
    dynamic = {"x": {0: torch.export.Dim("batch", min=1, max=8)}}
    with torch.no_grad():
        program = torch.export.export(layer, (torch.rand(2, 6, 9, 8).double(),), dynamic_shapes=dynamic).module()
        for batch in (1, 3):
            x = torch.rand(batch, 6, 9, 8).double()
            assert torch.allclose(program(x), layer(x))
