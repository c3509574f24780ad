"""Window blocks a few rows at a time, for prediction on a CPU: wide intermediate results never leave its cache.

At 192x640 the hidden activations of one block of the first stage fill 47 MB. Fresh memory of that size costs more than
the arithmetic, so here each half of a block (norm, layer, residual) runs piece by piece, with one small buffer for all.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils._python_dispatch import _get_current_dispatch_mode

from saunet.models.layers.window_attention import WindowAttention
from saunet.models.layers.window_plan import window_groups, window_order

_FUSED = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")  # type: ignore[no-untyped-call]
"""Whether oneDNN applies a linear layer and GELU in one pass; what torch.compile uses too."""
_CACHED_ELEMENTS = 1_500_000
"""Elements of the widest intermediate result of a piece: a few MB, about the cache of two cores."""


def streams(tokens: Tensor, block: nn.Module) -> bool:
    """Return whether a block may work in pieces: on a CPU, in prediction, while nobody is watching its layers.

    Gradients, autocast, a compiler, exporter or tracer, a dispatch mode (which counts FLOPs by the operators it knows),
    hooks and layers that somebody replaced (quantized, adapted) get the plain way through the layers' own ``forward``.

    Args:
        tokens: n x c, whatever the axes before c are.
        block: The block whose layers it is about.
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


def rows_per_piece(width: int) -> int:
    """Return how many rows make a piece when the widest intermediate result has ``width`` columns."""
    return max(64, _CACHED_ELEMENTS // width)


def add_attention(
    x: Float[Tensor, "b h w c"], norm: nn.LayerNorm, attention: WindowAttention
) -> Float[Tensor, "b h w c"]:
    """Return ``x + attention(norm(x))`` for a map that needs no padding."""
    batch, height, width, dim = x.shape
    window, shift = attention.window, attention.shift
    order, inverse = window_order(batch, height, width, window, shift, x.device)
    rows = F.embedding(order, x.reshape(-1, dim))
    start, size = 0, rows_per_piece(3 * dim)
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
    """Add ``fc2(gelu(fc1(norm(x))))`` to ``x``, in place.

    Args:
        x: Tokens; changed.
        norm: Over the channels.
        fc1: From c channels to the hidden ones.
        fc2: Back to c channels.
    """
    rows = x.view(-1, x.shape[-1])
    size = rows_per_piece(fc1.out_features)
    buffer = rows.new_empty(min(size, len(rows)), fc1.out_features)
    for piece in torch.split(rows, size):
        _add(piece, fc2, _hidden(norm(piece), fc1, buffer))
    return x


def _hidden(rows: Tensor, layer: nn.Linear, buffer: Tensor) -> Tensor:
    """Return ``gelu(layer(rows))``; where it takes two passes, both work on ``buffer``."""
    if _FUSED and rows.dtype == torch.float32:
        fused: Tensor = torch.ops.mkldnn._linear_pointwise(rows, layer.weight, layer.bias, "gelu", [], "none")
        return fused
    return torch.ops.aten.gelu_(_into(buffer[: len(rows)], layer, rows))  # type: ignore[no-any-return]


def _into(out: Tensor, layer: nn.Linear, rows: Tensor) -> Tensor:
    """Write ``layer(rows)`` to ``out``."""
    return torch.addmm(layer.bias, rows, layer.weight.t(), out=out)


def _add(out: Tensor, layer: nn.Linear, rows: Tensor) -> None:
    """Add ``layer(rows)`` to ``out``, in place."""
    out.add_(layer.bias).addmm_(rows, layer.weight.t())
