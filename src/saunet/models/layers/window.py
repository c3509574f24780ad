"""The Swin layer: assigning tokens to windows, attention inside windows, the block, the stage, the merging.

In Swin, a shifted window joined by the cyclic shift from opposite borders is masked so that its parts never see each
other, and a window that reaches into masked padding sees only its real tokens. In both cases a part's attention equals
that of a separate smaller window. So a map is cut into windows of a few sizes ("groups"), and no roll, mask or padding
is ever computed.

For prediction on a CPU, each half of a block (norm, layer, residual) runs a few rows at a time, with one small buffer
for all: at 192x640 the hidden activations of one block of the first stage take 47 MB, and new memory of that size costs
more than the arithmetic.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.utils._python_dispatch import _disable_current_modes, _get_current_dispatch_mode

from saunet import errors
from saunet.models.layers.conv import DropPath

_KEPT: dict[tuple[object, ...], Tensor] = {}
_KEPT_AT_MOST = 512
_FUSED = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")  # type: ignore[no-untyped-call]
"""Whether oneDNN applies a linear layer and GELU in one pass, as torch.compile also does."""
_CACHED_ELEMENTS = 1_500_000
"""Elements of the widest intermediate result of a piece: a few MB, about the cache of two cores."""


class WindowGroup(NamedTuple):
    """Windows of one size."""

    height: int
    width: int
    windows: int
    """Number of them per image."""

    @property
    def area(self) -> int:
        return self.height * self.width


def axis_windows(size: int, window: int, shift: int) -> list[tuple[int, int]]:
    """Cut one axis into windows: ``[(start, length), ...]``, in order and without gaps.

    A shifted axis starts with a window of ``shift`` tokens; the last window ends at the border. An axis that fits in
    one window is not shifted: the shift would only cut it in two.
    """
    if torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
        size = int(size)  # which is a tensor there: equal lengths must be equal keys of `window_groups`
    first = shift if size > window else 0
    starts = [0, *range(first, size, window)] if first else list(range(0, size, window))
    return [(start, stop - start) for start, stop in zip(starts, [*starts[1:], size], strict=True)]


def window_groups(height: int, width: int, window: int, shift: int) -> list[WindowGroup]:
    """Return the window sizes of a map and the number of each, in order of first appearance."""
    counts: dict[tuple[int, int], int] = {}
    for _, tall in axis_windows(height, window, shift):
        for _, wide in axis_windows(width, window, shift):
            counts[tall, wide] = counts.get((tall, wide), 0) + 1
    return [WindowGroup(tall, wide, windows) for (tall, wide), windows in counts.items()]


def window_order(
    batch: int, height: int, width: int, window: int, shift: int, device: torch.device
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Return the permutation that sorts the flat tokens of a batch of maps by window, and its inverse.

    The order is (group, image, window row, window column, token row, token column), groups as in `window_groups`.
    Results are cached and shared between all modules; a compiled or exported graph has them as constants.
    """
    arguments = (batch, height, width, window, shift, str(device))
    return _plan("order", *arguments), _plan("inverse", *arguments)


def relative_position_index(height: int, width: int, window: int, device: torch.device) -> Int[Tensor, " n2"]:
    """Return the row of the ``(2 window - 1)**2`` bias table for each (query, key) of a ``height x width`` window."""
    return _plan("relative", height, width, window, str(device))


def _plan(kind: str, *arguments: Any) -> Tensor:
    """Return a cached index tensor: ``arguments`` are sizes, which a tracer may wrap, and the device comes last."""
    if torch.compiler.is_dynamo_compiling():
        _mark_for_compiler()
    return _kept_plan(kind, *arguments)


def _mark_for_compiler() -> bool:
    """Tell the compiler to call `_kept_plan` without tracing it."""
    torch.compiler.allow_in_graph(_kept_plan)  # type: ignore[no-untyped-call]
    return True


# The attribute set by torch.compiler.assume_constant_result: the compiler calls the function when it meets it. Using
# torch.compiler's functions here would import the whole compiler with the network, seconds for each prediction.
_mark_for_compiler._dynamo_marked_constant = True  # type: ignore[attr-defined]


def _kept_plan(kind: str, *arguments: Any) -> Tensor:
    *sizes, device = arguments
    key = (kind, *map(int, sizes), device)
    if key not in _KEPT:
        while len(_KEPT) >= _KEPT_AT_MOST:
            _KEPT.pop(next(iter(_KEPT)))
        # made outside of whatever mode is on: an index made for a prediction or a trace must serve everyone
        with torch.inference_mode(False), _disable_current_modes(), _untraced():
            _KEPT[key] = torch.from_numpy(_BUILDERS[kind](*key[1:-1])).to(device)
    return torch.ops.aten.lift_fresh.default(_KEPT[key])  # type: ignore[no-any-return]  # a tracer takes it as a constant


@contextlib.contextmanager
def _untraced() -> Iterator[None]:
    """Keep from torch.jit.trace, which would otherwise find another graph when it checks itself, what is done."""
    state = torch._C._get_tracing_state()
    torch._C._set_tracing_state(None)  # type: ignore[attr-defined]
    try:
        yield
    finally:
        torch._C._set_tracing_state(state)  # type: ignore[attr-defined]


def _build_order(batch: int, height: int, width: int, window: int, shift: int) -> np.ndarray:
    tokens = np.arange(batch * height * width).reshape(batch, height, width)
    parts = []
    for tall, wide, _ in window_groups(height, width, window, shift):
        tops = [start for start, length in axis_windows(height, window, shift) if length == tall]
        lefts = [start for start, length in axis_windows(width, window, shift) if length == wide]
        rows, columns = np.add.outer(tops, np.arange(tall)), np.add.outer(lefts, np.arange(wide))
        parts.append(tokens[:, rows[:, None, :, None], columns[None, :, None, :]].ravel())
    return np.concatenate(parts)


def _build_relative_index(height: int, width: int, window: int) -> np.ndarray:
    y, x = (axis.ravel() for axis in np.mgrid[:height, :width])
    down, right = y[:, None] - y[None, :], x[:, None] - x[None, :]
    return np.asarray((down + window - 1) * (2 * window - 1) + right + window - 1).ravel()


_BUILDERS: dict[str, Callable[..., np.ndarray]] = {
    "order": _build_order,
    "inverse": lambda *sizes: np.argsort(_build_order(*sizes)),
    "relative": _build_relative_index,
}


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
    if not torch.is_grad_enabled() or torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
        return F.embedding(order, rows)
    out: Tensor = _Reorder.apply(rows, order, inverse)  # type: ignore[no-untyped-call]
    return out


class WindowAttention(nn.Module):
    """Multi-head self-attention inside (shifted) windows with relative position bias, SAU-Net eqs. (1) and (3).

    With ``mask_padding``, a window across the border attends to real tokens only, so features do not depend on whether
    the window divides the map, wherever windows coincide. Without it, such maps are padded with zeros that take part in
    attention, as in the dense Swin backbone and torchvision.
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
        parts = [self.attend(part, group) for part, group in zip(qkv, groups, strict=True)]
        attended = self.proj(parts[0] if len(parts) == 1 else torch.cat(parts))
        out = reorder(attended, inverse, order).view(x.shape)  # a trace, made for one size, refuses other sizes
        return out if (rows, columns) == (height, width) else out[:, :height, :width]

    def _attend_each(self, x: Float[Tensor, "b h w c"]) -> Float[Tensor, "b h w c"]:
        """Attend with the same token order for all images."""
        _, rows, columns, _ = x.shape
        order, inverse = window_order(1, rows, columns, self.window, self.shift, x.device)
        groups = window_groups(rows, columns, self.window, self.shift)
        qkv = self.qkv(x.flatten(1, 2).index_select(1, order))
        parts = []
        for part, group in zip(qkv.split([g.windows * g.area for g in groups], 1), groups, strict=True):
            attended = self.attend(part.reshape(-1, 3 * self.dim), group)
            parts.append(attended.view(-1, group.windows * group.area, self.dim))
        return self.proj(torch.cat(parts, 1)).index_select(1, inverse).unflatten(1, (rows, columns))  # type: ignore[no-any-return]

    def pads(self, height: int, width: int) -> bool:
        """Whether a map of this size is padded with zeros."""
        return not self.mask_padding and (height % self.window != 0 or width % self.window != 0)

    def bias(self, group: WindowGroup, dtype: torch.dtype) -> Float[Tensor, "1 heads n n"]:
        table = self.relative_position_bias_table
        index = relative_position_index(group.height, group.width, self.window, table.device)
        return table.to(dtype).t().index_select(1, index).view(1, self.heads, group.area, group.area)

    def attend(
        self, qkv: Float[Tensor, "n c3"], group: WindowGroup, bias: Float[Tensor, "1 heads a a"] | None = None
    ) -> Float[Tensor, "n c"]:
        """Attend inside each window of a group, given queries, keys and values of its tokens."""
        bias = self.bias(group, qkv.dtype) if bias is None else bias
        split = qkv.view(-1, group.area, 3, self.heads, self.dim // self.heads)
        query, key, value = split.permute(2, 0, 3, 1, 4).unbind(0)
        out = F.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        return out.transpose(1, 2).reshape(-1, self.dim)


def _symbolic(size: object) -> bool:
    """Whether an exported network leaves a size open; torch annotates it as an int anyway."""
    return isinstance(size, torch.SymInt)


def streams(tokens: Tensor, block: nn.Module) -> bool:
    """Return whether a block may work in pieces: on a CPU, in prediction, while nothing observes its layers.

    With gradients, autocast, a compiler, exporter or tracer, a dispatch mode (which counts FLOPs by known operators),
    hooks, or replaced layers (quantized, adapted), the layers' own ``forward`` is used.
    """
    return (
        tokens.device.type == "cpu"
        and not torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and not torch.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
        and not torch.is_autocast_enabled("cpu")
        and _get_current_dispatch_mode() is None
        and not block.training
        and all(_untouched(module) for module in block.children() for module in module.modules())
    )


def _untouched(module: nn.Module) -> bool:
    known = type(module) in (nn.Linear, nn.LayerNorm) or type(module).__module__.startswith("saunet.models.layers.")
    return known and not (module._forward_hooks or module._forward_pre_hooks)


def _rows_per_piece(width: int) -> int:
    return max(64, _CACHED_ELEMENTS // width)


def add_attention(
    x: Float[Tensor, "b h w c"], norm: nn.LayerNorm, attention: WindowAttention
) -> Float[Tensor, "b h w c"]:
    """Return ``x + attention(norm(x))`` for a map that needs no padding."""
    batch, height, width, dim = x.shape
    window, shift = attention.window, attention.shift
    order, inverse = window_order(batch, height, width, window, shift, x.device)
    rows = F.embedding(order, x.reshape(-1, dim))
    start, size = 0, _rows_per_piece(3 * dim)
    buffer = rows.new_empty(min(max(size, window**2), len(rows)), 3 * dim)
    for group in window_groups(height, width, window, shift):
        stop, step = start + batch * group.windows * group.area, max(1, size // group.area) * group.area
        bias = attention.bias(group, x.dtype)
        for piece in torch.split(rows[start:stop], step):
            qkv = _into(buffer[: len(piece)], attention.qkv, norm(piece))
            _add(piece, attention.proj, attention.attend(qkv, group, bias))
        start = stop
    return F.embedding(inverse, rows).view(x.shape)


def add_mlp_(x: Float[Tensor, "*n c"], norm: nn.LayerNorm, fc1: nn.Linear, fc2: nn.Linear) -> Float[Tensor, "*n c"]:
    """Add ``fc2(gelu(fc1(norm(x))))`` to ``x``, in place."""
    rows = x.view(-1, x.shape[-1])
    size = _rows_per_piece(fc1.out_features)
    buffer = rows.new_empty(min(size, len(rows)), fc1.out_features)
    for piece in torch.split(rows, size):
        _add(piece, fc2, _hidden(norm(piece), fc1, buffer))
    return x


def _hidden(rows: Tensor, layer: nn.Linear, buffer: Tensor) -> Tensor:
    """Return ``gelu(layer(rows))``; if that takes two passes, both use ``buffer``."""
    if _FUSED and rows.dtype == torch.float32:
        fused: Tensor = torch.ops.mkldnn._linear_pointwise(rows, layer.weight, layer.bias, "gelu", [], "none")
        return fused
    return torch.ops.aten.gelu_(_into(buffer[: len(rows)], layer, rows))  # type: ignore[no-any-return]


def _into(out: Tensor, layer: nn.Linear, rows: Tensor) -> Tensor:
    return torch.addmm(layer.bias, rows, layer.weight.t(), out=out)


def _add(out: Tensor, layer: nn.Linear, rows: Tensor) -> None:
    """Add ``layer(rows)`` to ``out``, in place."""
    out.add_(layer.bias).addmm_(rows, layer.weight.t())


class Mlp(nn.Module):
    """Two linear layers with an exact (erf) GELU between them, SAU-Net eqs. (2) and (4)."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, dim)

    def forward(self, x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        return self.fc2(F.gelu(self.fc1(x)))  # type: ignore[no-any-return]


class SwinBlock(nn.Module):
    """One (shifted-)window transformer block, SAU-Net eqs. (1)-(2) without and (3)-(4) with a shift."""

    def __init__(
        self,
        dim: int,
        heads: int,
        window: int,
        shift: int = 0,
        mlp_ratio: float = 4.0,
        drop_path: float = 0.0,
        mask_padding: bool = True,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attn = WindowAttention(dim, heads, window, shift, mask_padding)
        self.drop_path = DropPath(drop_path)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = Mlp(dim, int(dim * mlp_ratio))

    def forward(self, x: Float[Tensor, "b h w c"]) -> Float[Tensor, "b h w c"]:
        if streams(x, self) and not self.attn.pads(x.shape[1], x.shape[2]):
            return add_mlp_(add_attention(x, self.norm1, self.attn), self.norm2, self.mlp.fc1, self.mlp.fc2)
        x = x + self.drop_path(self.attn(self.norm1(x)))
        return x + self.drop_path(self.mlp(self.norm2(x)))  # type: ignore[no-any-return]


class PatchMerging(nn.Module):
    """Halve a map of tokens: the 2x2 neighbors are concatenated (4C), normalized and projected to 2C.

    The order of the four is Swin's: (0, 0), (1, 0), (0, 1), (1, 1) as (row, column).
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * dim)
        self.reduction = nn.Linear(4 * dim, 2 * dim, bias=False)

    def forward(self, x: Float[Tensor, "b h w c"]) -> Float[Tensor, "b h2 w2 c2"]:
        batch, height, width, channels = x.shape
        pairs = x.view(batch, height // 2, 2, width // 2, 2, channels)
        merged = pairs.permute(0, 1, 3, 4, 2, 5).reshape(batch, height // 2, width // 2, 4 * channels)
        return self.reduction(self.norm(merged))  # type: ignore[no-any-return]


class SwinStage(nn.Module):
    """Blocks at one resolution, plain and shifted windows in turn, after which the map may be halved."""

    def __init__(
        self,
        dim: int,
        depth: int,
        heads: int,
        window: int,
        mlp_ratio: float,
        drop_path: Sequence[float],
        mask_padding: bool = True,
        merge: bool = True,
    ) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            SwinBlock(dim, heads, window, window // 2 * (i % 2), mlp_ratio, drop_path[i], mask_padding)
            for i in range(depth)
        )
        self.downsample = PatchMerging(dim) if merge else None

    def forward(self, x: Float[Tensor, "b h w c"]) -> tuple[Tensor, Tensor]:
        """Return the map after the last block, b h w c, and the input of the next stage, b h/2 w/2 2c."""
        for block in self.blocks:
            x = block(x)
        return x, x if self.downsample is None else self.downsample(x)
