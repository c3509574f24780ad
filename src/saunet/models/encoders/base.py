"""Shared parts of encoders."""

from __future__ import annotations

import abc
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn


class StemEncoder(nn.Module, abc.ABC):
    """An encoder whose first layers can be recomputed for the gradient: their maps are the largest of all."""

    @abc.abstractmethod
    def begin(self, image: Float[Tensor, "b c h w"]) -> Any:
        """Return the input of the first block, and the finest feature if there is one before it."""
