"""What the window-attention encoders share: stages of Swin blocks behind a stem, one normalized map out of each."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet import errors
from saunet.models.layers.window import SwinStage
from saunet.types import FeatureSpec

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_PUBLIC: dict[tuple[int, tuple[int, ...], tuple[int, ...]], str] = {
    (96, (2, 2, 6, 2), (3, 6, 12, 24)): "swin_tiny",
    (96, (2, 2, 18, 2), (3, 6, 12, 24)): "swin_small",
}


class WindowEncoder(nn.Module):
    """A stem to tokens, stages of (shifted-)window blocks, 2x2 merging between them, a LayerNorm on each output.

    State-dict keys of the stages are those of the dense Swin backbone: ``layers.0.blocks.0.attn.qkv.weight``,
    ``layers.0.downsample.reduction.weight``, ``norm0.weight``.

    Args:
        stride: Pixels of the image per token of the first stage.
        dim: Channels of the first stage; they double from stage to stage.
        depths: Blocks per stage.
        heads: Attention heads per stage.
        window: Side of a window in tokens, per stage.
        mlp_ratio: Hidden channels of the MLPs per channel.
        drop_path: Probability of stochastic depth at the last block, growing linearly from 0 at the first.
        mask_padding: See `saunet.models.layers.window.WindowAttention`.

    Attributes:
        features: Channels and stride of each feature map, finest first.
        size_divisor: Input height and width must be multiples of it.
        variant: Name of the public weights that fit, None where there are none.
        not_pretrained: Beginnings of the names of entries that no public file has.

    Raises:
        ConfigError: if the sequences differ in length or hold a value below 1.
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
            raise errors.ConfigError(
                f"depths, heads and window have {len(depths)}, {len(heads)} and {len(window)} entries; "
                "give one number per stage in each"
            )
        for name, value in (("depths", min(depths)), ("heads", min(heads)), ("window", min(window)), ("dim", dim)):
            errors.positive(name, value)
        errors.positive("mlp_ratio", mlp_ratio)
        errors.in_range("drop_path", drop_path, 0, 0.99)
        stages = len(depths)
        self.features = tuple(FeatureSpec(dim * 2**i, stride * 2**i) for i in range(stages))
        self.size_divisor = self.features[-1].stride
        self.variant = _PUBLIC.get((dim, depths, heads))
        self.not_pretrained: tuple[str, ...] = tuple(f"norm{i}." for i in range(stages - 1))
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(3, 1, 1), persistent=False)

        rates = torch.linspace(0, drop_path, sum(depths), device="cpu").tolist()
        self.layers = nn.ModuleList()
        for i, (depth, spec) in enumerate(zip(depths, self.features, strict=True)):
            own = rates[sum(depths[:i]) : sum(depths[: i + 1])]
            self.layers.append(
                SwinStage(
                    dim=spec.channels,
                    depth=depth,
                    heads=heads[i],
                    window=window[i],
                    mlp_ratio=mlp_ratio,
                    drop_path=own,
                    mask_padding=mask_padding,
                    merge=i + 1 < stages,
                )
            )
            self.add_module(f"norm{i}", nn.LayerNorm(spec.channels))

    def tokens(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b h2 w2 c"]:
        """Turn a normalized image into the tokens of the first stage; each encoder has its own stem."""
        raise NotImplementedError(f"{type(self).__name__} has no stem")

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> tuple[Tensor, ...]:
        """Return one feature map per stage of RGB in [0, 1], b c h/s w/s, finest first (in channels-last memory)."""
        errors.divisible(image.shape[2], image.shape[3], self.size_divisor)
        x = self.tokens((image - self.mean) / self.std)
        maps = []
        for i, stage in enumerate(self.layers):
            out, x = stage(x)
            maps.append(self.get_submodule(f"norm{i}")(out).permute(0, 3, 1, 2))
        return tuple(maps)

    def _init_weights(self) -> None:
        """Initialize as Swin: truncated normal (0.02) for linear weights, zero biases."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
