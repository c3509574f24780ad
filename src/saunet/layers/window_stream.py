"""Linear layers over a few rows at a time on a CPU, so that wide intermediate results never leave its cache.

At 192x640 the hidden activations of one block of the first stage fill 47 MB. Fresh memory of that size costs more than
the arithmetic, so in prediction on a CPU the blocks work through their rows in pieces, with one small buffer for all.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

_CACHED_ELEMENTS = 1_500_000
"""Elements of the widest intermediate result of a piece: a few MB, about the cache of two cores."""


def streams(tokens: Tensor, *layers: nn.Module) -> bool:
    """Return whether to work in pieces: on a CPU, in prediction, while nobody is watching the layers.

    Gradients, autocast, a compiler or exporter, hooks and layers that somebody replaced (quantised, adapted) get the
    plain way through the layers' own ``forward``.
    """
    return (
        tokens.device.type == "cpu"
        and not torch.is_grad_enabled()
        and not torch.compiler.is_compiling()
        and not torch.is_autocast_enabled("cpu")
        and all(type(layer) is nn.Linear and not layer._forward_hooks | layer._forward_pre_hooks for layer in layers)
    )


def rows_per_piece(width: int) -> int:
    """Return how many rows make a piece when the widest intermediate result has ``width`` columns."""
    return max(64, _CACHED_ELEMENTS // width)


def linear_into(layer: nn.Linear, rows: Float[Tensor, "n i"], out: Float[Tensor, "n o"]) -> Float[Tensor, "n o"]:
    """Write ``layer(rows)`` (with a bias) into ``out`` and return it."""
    return torch.addmm(layer.bias, rows, layer.weight.t(), out=out)
