"""Token-wise layers over a few rows at a time on a CPU, so that wide intermediate results never leave its cache."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

_CACHED_ELEMENTS = 1_500_000
"""Elements of the widest intermediate result of a piece; a few MB, about the cache of one core."""


def streams(tokens: Tensor) -> bool:
    """Return whether to work in pieces: on a CPU, without gradients, and not while a compiler is watching."""
    return tokens.device.type == "cpu" and not torch.is_grad_enabled() and not torch.compiler.is_compiling()


def rows_per_piece(width: int) -> int:
    """Return how many rows make a piece when the widest intermediate result has ``width`` columns."""
    return max(64, _CACHED_ELEMENTS // width)


def stream(layer: Callable[[Tensor], Tensor], tokens: Float[Tensor, "*n c"], width: int) -> Float[Tensor, "*n c"]:
    """Apply a row-wise layer, in pieces where that helps; same result either way.

    Args:
        layer: Maps (n, c) rows to (n, c) rows, each on its own.
        tokens: Rows of channels.
        width: Columns of the widest intermediate result inside ``layer``.
    """
    if not streams(tokens):
        return layer(tokens)
    rows = tokens.reshape(-1, tokens.shape[-1])
    out = torch.empty_like(rows)
    size = rows_per_piece(width)
    for piece, target in zip(torch.split(rows, size), torch.split(out, size), strict=True):
        target.copy_(layer(piece))
    return out.view(tokens.shape)
