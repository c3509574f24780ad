"""(Shifted-)window multi-head self-attention, the W-MSA and SW-MSA of SAU-Net eqs. (1) and (3)."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from saunet import errors
from saunet.models.layers.window_plan import WindowGroup, relative_position_index, window_groups, window_order


class _Reorder(torch.autograd.Function):
    """Permute rows; the gradient is permuted back by the known inverse instead of being scattered."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, order: Tensor, inverse: Tensor) -> Tensor:
        ctx.save_for_backward(order, inverse)
        return F.embedding(order, rows)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        order, inverse = ctx.saved_tensors
        return reorder(gradients[0], inverse, order), None, None


def reorder(rows: Float[Tensor, "n c"], order: Int[Tensor, " n"], inverse: Int[Tensor, " n"]) -> Float[Tensor, "n c"]:
    """Return ``rows[order]`` for a permutation whose inverse is known."""
    if not torch.is_grad_enabled():
        return F.embedding(order, rows)
    out: Tensor = _Reorder.apply(rows, order, inverse)  # type: ignore[no-untyped-call]
    return out


class WindowAttention(nn.Module):
    """Multi-head self-attention inside (shifted) windows with relative position bias, SAU-Net eqs. (1) and (3).

    Args:
        dim: Channels.
        heads: Attention heads; must divide ``dim``.
        window: Side of a window in tokens.
        shift: Tokens by which the partition is shifted, 0 for W-MSA, ``window // 2`` for SW-MSA.
        mask_padding: True: a window that reaches over the border attends to real tokens only, so a map that the window
            does not divide has the same features as one that it does, wherever windows coincide. False: such maps are
            padded with zeros that take part in attention, as in the dense Swin backbone and torchvision.

    Raises:
        ConfigError: if ``heads`` does not divide ``dim``.
    """

    def __init__(self, dim: int, heads: int, window: int, shift: int = 0, mask_padding: bool = True) -> None:
        super().__init__()
        if heads < 1 or dim % heads:
            raise errors.ConfigError(f"heads is {heads}; it must divide the {dim} channels")
        errors.positive("window", window)
        errors.in_range("shift", shift, 0, window - 1)
        self.dim, self.heads, self.window, self.shift, self.mask_padding = dim, heads, window, shift, mask_padding
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        nn.init.trunc_normal_(self.relative_position_bias_table, std=0.02)

    def forward(self, x: Float[Tensor, "b h w c"]) -> Float[Tensor, "b h w c"]:
        """Attend within each window of a map of tokens."""
        height, width = x.shape[1:3]
        if self.pads(height, width):
            x = F.pad(x, (0, 0, 0, -width % self.window, 0, -height % self.window))
        batch, rows, columns, _ = x.shape
        if _symbolic(batch):
            return self._attend_each(x)[:, :height, :width]
        order, inverse = window_order(batch, rows, columns, self.window, self.shift, x.device)
        groups = window_groups(rows, columns, self.window, self.shift)
        tokens = reorder(x.reshape(-1, self.dim), order, inverse)
        qkv = torch.split(self.qkv(tokens), [batch * group.windows * group.area for group in groups])
        parts = [
            self.attend(part, group, self.bias(group, part.dtype)) for part, group in zip(qkv, groups, strict=True)
        ]
        attended = self.proj(parts[0] if len(parts) == 1 else torch.cat(parts))
        out = reorder(attended, inverse, order).view(batch, rows, columns, self.dim)
        return out if (rows, columns) == (height, width) else out[:, :height, :width]

    def _attend_each(self, x: Float[Tensor, "b h w c"]) -> Float[Tensor, "b h w c"]:
        """Attend with one image's order of tokens for all: for an exporter that leaves the number of images open."""
        _, rows, columns, _ = x.shape
        order, inverse = window_order(1, rows, columns, self.window, self.shift, x.device)
        groups = window_groups(rows, columns, self.window, self.shift)
        qkv = self.qkv(x.flatten(1, 2).index_select(1, order))
        parts = [
            self.attend(part.reshape(-1, 3 * self.dim), group, self.bias(group, part.dtype)).view(
                -1, group.windows * group.area, self.dim
            )
            for part, group in zip(qkv.split([g.windows * g.area for g in groups], 1), groups, strict=True)
        ]
        return self.proj(torch.cat(parts, 1)).index_select(1, inverse).unflatten(1, (rows, columns))  # type: ignore[no-any-return]

    def pads(self, height: int, width: int) -> bool:
        """Return whether a map of this size is padded with zeros."""
        return not self.mask_padding and (height % self.window != 0 or width % self.window != 0)

    def bias(self, group: WindowGroup, dtype: torch.dtype) -> Float[Tensor, "1 heads n n"]:
        """Return the relative position bias of a window size."""
        table = self.relative_position_bias_table
        index = relative_position_index(group.height, group.width, self.window, table.device)
        pairs = table.to(dtype).t().index_select(1, index)
        return pairs.view(1, self.heads, group.area, group.area)

    def attend(
        self, qkv: Float[Tensor, "n c3"], group: WindowGroup, bias: Float[Tensor, "1 heads a a"]
    ) -> Float[Tensor, "n c"]:
        """Attend inside each window of a group, given queries, keys and values of its tokens and its bias."""
        split = qkv.view(-1, group.area, 3, self.heads, self.dim // self.heads)
        query, key, value = split.permute(2, 0, 3, 1, 4).unbind(0)
        out = F.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        return out.transpose(1, 2).reshape(-1, self.dim)


def _symbolic(size: object) -> bool:
    """Tell whether an exported network leaves a size open; the annotations of torch call it an int all the same."""
    return isinstance(size, torch.SymInt)
