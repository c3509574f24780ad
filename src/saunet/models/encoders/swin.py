"""The Swin Transformer (Liu et al. 2021) as a feature extractor, from the same blocks as the stratified transformer."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from saunet import errors
from saunet.models.pretrained import load_pretrained
from saunet.models.window_encoder import WindowEncoder
from saunet.registry import encoders


@encoders.register("swin_tiny")
@encoders.register("swin_small", depths=(2, 2, 18, 2), drop_path=0.3)
class SwinTransformer(WindowEncoder):
    """Swin features at 1/4, 1/8, 1/16, 1/32 (Liu et al. 2021); numbers are those of torchvision with the same weights.

    State-dict keys are those of the dense Swin backbone. As in torchvision, maps that the window does not divide are
    padded with zeros that take part in attention, and an axis that fits in one window is not shifted.

    Args:
        patch: Side of a patch in pixels.
        dim: Channels of the first stage; they double from stage to stage.
        depths: Blocks per stage.
        heads: Attention heads per stage.
        window: Side of a window in tokens, per stage.
        mlp_ratio: Hidden channels of the MLPs per channel.
        drop_path: Probability of stochastic depth at the last block, growing linearly from 0 at the first.
        mask_padding: True keeps padded tokens out of the attention instead.
        weights: Public weights to start from: ``imagenet``, a name, a URL or a file; see `load_pretrained`.

    Attributes:
        features: Channels and stride of each feature map, finest first.
        size_divisor: Input height and width must be multiples of it.

    Raises:
        ConfigError: for sequences of different lengths, values below 1, or heads that do not divide the channels.
        CheckpointError: if ``weights`` cannot be found, fetched, read or fitted.
    """

    def __init__(
        self,
        patch: int = 4,
        dim: int = 96,
        depths: Sequence[int] = (2, 2, 6, 2),
        heads: Sequence[int] = (3, 6, 12, 24),
        window: Sequence[int] = (7, 7, 7, 7),
        mlp_ratio: float = 4.0,
        drop_path: float = 0.2,
        mask_padding: bool = False,
        weights: str | None = None,
    ) -> None:
        errors.positive("patch", patch)
        super().__init__(patch, dim, depths, heads, window, mlp_ratio, drop_path, mask_padding)
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, dim, patch, stride=patch), "norm": nn.LayerNorm(dim)})
        self._init_weights()
        if weights is not None:
            load_pretrained(self, weights)

    def tokens(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b h4 w4 c"]:
        """Turn a normalized image into one token per patch."""
        return self.patch_embed["norm"](self.patch_embed["proj"](image).permute(0, 2, 3, 1))  # type: ignore[no-any-return]
