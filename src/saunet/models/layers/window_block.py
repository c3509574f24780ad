"""The Swin block, stage and patch merging: what SAU-Net's stratified transformer and Swin are made of."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from saunet.models.layers.drop_path import DropPath
from saunet.models.layers.window_attention import WindowAttention
from saunet.models.layers.window_stream import add_attention, add_mlp_, streams


class Mlp(nn.Module):
    """Two linear layers with an exact (erf) GELU between them, SAU-Net eqs. (2) and (4).

    Args:
        dim: Channels in and out.
        hidden: Channels between.
    """

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, dim)

    def forward(self, x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
        """Map each token on its own."""
        return self.fc2(F.gelu(self.fc1(x)))  # type: ignore[no-any-return]


class SwinBlock(nn.Module):
    """One (shifted-)window transformer block, SAU-Net eqs. (1)-(2) without and (3)-(4) with a shift.

    Args:
        dim: Channels.
        heads: Attention heads.
        window: Side of a window in tokens.
        shift: Shift of the windows in tokens.
        mlp_ratio: Hidden channels of the MLP per channel.
        drop_path: Probability of stochastic depth.
        mask_padding: See `WindowAttention`.
    """

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
        """Apply attention and MLP, each behind a norm and around a residual."""
        if streams(x, self) and not self.attn.pads(x.shape[1], x.shape[2]):
            return add_mlp_(add_attention(x, self.norm1, self.attn), self.norm2, self.mlp.fc1, self.mlp.fc2)
        x = x + self.drop_path(self.attn(self.norm1(x)))
        return x + self.drop_path(self.mlp(self.norm2(x)))  # type: ignore[no-any-return]


class PatchMerging(nn.Module):
    """Halve a map of tokens: the 2x2 neighbors are concatenated (4C), normalized and projected to 2C.

    The order of the four is Swin's: (0, 0), (1, 0), (0, 1), (1, 1) as (row, column).

    Args:
        dim: Channels in; twice as many come out.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(4 * dim)
        self.reduction = nn.Linear(4 * dim, 2 * dim, bias=False)

    def forward(self, x: Float[Tensor, "b h w c"]) -> Float[Tensor, "b h2 w2 c2"]:
        """Merge; height and width must be even."""
        batch, height, width, channels = x.shape
        pairs = x.view(batch, height // 2, 2, width // 2, 2, channels)
        merged = pairs.permute(0, 1, 3, 4, 2, 5).reshape(batch, height // 2, width // 2, 4 * channels)
        return self.reduction(self.norm(merged))  # type: ignore[no-any-return]


class SwinStage(nn.Module):
    """Blocks at one resolution, plain and shifted windows in turn, after which the map may be halved.

    Args:
        dim: Channels.
        depth: Number of blocks.
        heads: Attention heads.
        window: Side of a window in tokens.
        mlp_ratio: Hidden channels of the MLP per channel.
        drop_path: Probability of stochastic depth, one per block.
        mask_padding: See `WindowAttention`.
        merge: Whether a `PatchMerging` follows.
        checkpointing: Recompute blocks in the backward pass instead of keeping what is inside them.
    """

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
        checkpointing: bool = False,
    ) -> None:
        super().__init__()
        self.checkpointing = checkpointing
        self.blocks = nn.ModuleList(
            SwinBlock(dim, heads, window, window // 2 * (i % 2), mlp_ratio, drop_path[i], mask_padding)
            for i in range(depth)
        )
        self.downsample = PatchMerging(dim) if merge else None

    def forward(self, x: Float[Tensor, "b h w c"]) -> tuple[Tensor, Tensor]:
        """Return the map after the last block, b h w c, and what the next stage starts from, b h/2 w/2 2c."""
        for block in self.blocks:
            if self.checkpointing and torch.is_grad_enabled():
                x = checkpoint(block, x, use_reentrant=False)
            else:
                x = block(x)
        return x, x if self.downsample is None else self.downsample(x)
