"""No attention, for ablations."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import positive
from saunet.registry import attentions


@attentions.register("none")
class NoAttention(nn.Module):
    """The identity: 0 parameters. What remains of AU-Net's bottleneck without attention (SAU-Net Table 3).

    Args:
        channels: Channels of the map.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        positive("channels", channels)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Return ``x``."""
        return x
