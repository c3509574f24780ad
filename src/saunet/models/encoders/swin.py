"""The Swin Transformer (Liu et al. 2021) as a feature extractor, and the stratified transformer's base."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, divisible, in_range, positive
from saunet.models.layers.window import SwinStage
from saunet.models.pretrained import load_pretrained
from saunet.registry import encoders
from saunet.types import FeatureSpec

_PUBLIC: dict[tuple[int, tuple[int, ...], tuple[int, ...]], str] = {
    (96, (2, 2, 6, 2), (3, 6, 12, 24)): "swin_tiny",
    (96, (2, 2, 18, 2), (3, 6, 12, 24)): "swin_small",
}
"""Dim, depths and heads -> the matching public weights."""


class WindowEncoder(nn.Module):
    """A stem to tokens, stages of (shifted-)window blocks, 2x2 merging between them, a LayerNorm on each output.

    State-dict keys of the stages are those of the dense Swin backbone: ``layers.0.blocks.0.attn.qkv.weight``,
    ``layers.0.downsample.reduction.weight``, ``norm0.weight``. ``stride`` is that of the first stage's tokens.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        stride: int,
        dim: int,
        depths: Sequence[int],
        heads: Sequence[int],
        window: Sequence[int],
        mlp_ratio: float,
        drop_path: float,
        mask_padding: bool,
    ) -> None:
        super().__init__()
        depths, heads, window = tuple(depths), tuple(heads), tuple(window)
        if not len(depths) == len(heads) == len(window) > 0:
            raise ConfigError(
                f"depths, heads and window have {len(depths)}, {len(heads)} and {len(window)} entries; "
                "give one number per stage in each"
            )
        for name, value in (("depths", min(depths)), ("heads", min(heads)), ("window", min(window)), ("dim", dim)):
            positive(name, value)
        positive("mlp_ratio", mlp_ratio)
        in_range("drop_path", drop_path, 0, 0.99)
        stages = len(depths)
        self.features = tuple(FeatureSpec(dim * 2**i, stride * 2**i) for i in range(stages))
        self.size_divisor = self.features[-1].stride
        self.variant = _PUBLIC.get((dim, depths, heads))
        self.not_pretrained: tuple[str, ...] = tuple(f"norm{i}." for i in range(stages - 1))
        """Prefixes of the names of entries that no public file has."""
        self.register_buffer("mean", torch.tensor((0.485, 0.456, 0.406)).view(3, 1, 1), persistent=False)  # ImageNet's
        self.register_buffer("std", torch.tensor((0.229, 0.224, 0.225)).view(3, 1, 1), persistent=False)

        rates = torch.linspace(0, drop_path, sum(depths), device="cpu").tolist()
        self.layers = nn.ModuleList()
        for i, (depth, spec) in enumerate(zip(depths, self.features, strict=True)):
            own, rates = rates[:depth], rates[depth:]
            last = i + 1 == stages
            stage = SwinStage(spec.channels, depth, heads[i], window[i], mlp_ratio, own, mask_padding, merge=not last)
            self.layers.append(stage)
            self.add_module(f"norm{i}", nn.LayerNorm(spec.channels))

    def tokens(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b h2 w2 c"]:
        """Turn a normalized image into the tokens of the first stage; each encoder has its own stem."""
        raise NotImplementedError(f"{type(self).__name__} has no stem")

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        divisible(image.shape[2], image.shape[3], self.size_divisor)
        x = self.tokens((image - self.mean) / self.std)
        maps = []
        for i, stage in enumerate(self.layers):
            out, x = stage(x)
            maps.append(self.get_submodule(f"norm{i}")(out).permute(0, 3, 1, 2))
        return tuple(maps)

    def start_weights(self, weights: str | None) -> None:
        """Initialize like Swin (truncated normal for linear weights, zero biases), then load public weights."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        if weights is not None:
            load_pretrained(self, weights)


@encoders.register("swin_tiny")
@encoders.register("swin_small", depths=(2, 2, 18, 2), drop_path=0.3)
class SwinTransformer(WindowEncoder):
    """Swin features at 1/4, 1/8, 1/16, 1/32 (Liu et al. 2021); results equal torchvision's with the same weights.

    State-dict keys are those of the dense Swin backbone. As in torchvision, maps not divisible by the window are padded
    with zeros that take part in attention, and an axis that fits in one window is not shifted.

    Args:
        patch: Side of a patch in pixels.
        dim: Channels of the first stage; they double from stage to stage.
        depths: Blocks per stage.
        heads: Attention heads per stage.
        window: Side of a window in tokens, per stage.
        mlp_ratio: Hidden channels of the MLPs per channel.
        drop_path: Probability of stochastic depth at the last block, growing linearly from 0 at the first.
        mask_padding: Exclude padded tokens from the attention instead.
        weights: Public weights to start from: ``imagenet``, a name, a URL or a file; see `load_pretrained`.
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
        positive("patch", patch)
        super().__init__(patch, dim, depths, heads, window, mlp_ratio, drop_path, mask_padding)
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, dim, patch, stride=patch), "norm": nn.LayerNorm(dim)})
        self.start_weights(weights)

    def tokens(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b h4 w4 c"]:
        return self.patch_embed["norm"](self.patch_embed["proj"](image).permute(0, 2, 3, 1))  # type: ignore[no-any-return]
