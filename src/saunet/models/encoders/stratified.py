"""The stratified transformer, SAU-Net's encoder (section III.B, fig. 2): Swin stages at 1/2, 1/4, 1/8 and 1/16."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from saunet.models.encoders.swin import WindowEncoder
from saunet.registry import encoders


@encoders.register("stratified_nano", dim=32, depths=(2, 2, 2, 2), heads=(1, 2, 4, 8), mlp_ratio=3.0, drop_path=0.0)
@encoders.register("stratified_tiny")
@encoders.register("stratified_small", depths=(2, 2, 18, 2), drop_path=0.2)
class StratifiedTransformer(WindowEncoder):
    """SAU-Net's stratified transformer, section III.B: a convolution, then four stages of eqs. (1)-(4) at 1/2 ... 1/16.

    The stem is a 3x3 convolution with stride 2 and a LayerNorm; each pixel of its output is a token. Between stages the
    2x2 neighbors are concatenated (4C) and projected to 2C, as in Swin; Swin's public weights fit everything but the
    stem.

    Args:
        dim: Channels of the first stage; they double from stage to stage.
        depths: Blocks per stage.
        heads: Attention heads per stage.
        window: Side of a window in tokens, per stage; any size works, and one that divides the map is fastest.
        mlp_ratio: Hidden channels of the MLPs per channel.
        drop_path: Probability of stochastic depth at the last block, growing linearly from 0 at the first.
        mask_padding: Windows across the border attend to real tokens only; False pads with zeros that take part.
        weights: Public weights to start from: ``imagenet``, a name, a URL or a file; see `load_pretrained`.
    """

    def __init__(
        self,
        dim: int = 96,
        depths: Sequence[int] = (2, 2, 6, 2),
        heads: Sequence[int] = (3, 6, 12, 24),
        window: Sequence[int] = (8, 8, 8, 4),
        mlp_ratio: float = 4.0,
        drop_path: float = 0.1,
        mask_padding: bool = True,
        weights: str | None = None,
    ) -> None:
        super().__init__(2, dim, depths, heads, window, mlp_ratio, drop_path, mask_padding)
        self.size_divisor = 2 * self.features[-1].stride  # decoders may halve the deepest map again
        self.stem = nn.ModuleDict({"conv": nn.Conv2d(3, dim, 3, stride=2, padding=1), "norm": nn.LayerNorm(dim)})
        self.not_pretrained += ("stem.",)
        self.start_weights(weights)

    def tokens(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b h2 w2 c"]:
        return self.stem["norm"](self.stem["conv"](image).permute(0, 2, 3, 1))  # type: ignore[no-any-return]
