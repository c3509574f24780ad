"""The depth network: any encoder, any decoder, and the step from sigmoid disparity to meters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from saunet.errors import ConfigError, checked, divisible
from saunet.geometry.depth import disparity_to_depth, sigmoid_to_disparity
from saunet.models.layers.conv import lay_out
from saunet.types import DepthPyramid, FeatureSpec

torch.export.register_dataclass(DepthPyramid)  # so that a depth network can be exported with its result type


@checked
class DepthNet(nn.Module):
    """One image to depth at several scales (SAU-Net section III-A: Z_t from H_t).

    Weights and the image are kept in channels-last memory order: convolutions run fastest in it on CPU and GPU, and a
    transformer's tokens become a feature map without a copy.

    Args:
        encoder: A network with ``features`` and ``size_divisor``, returning feature maps finest first.
        decoder: Called with ``features=encoder.features``; the result maps feature maps to sigmoid disparities.
        min_depth: Depth at sigmoid 1.
        max_depth: Depth at sigmoid 0.

    Attributes:
        features: Channels and stride of each feature map of the encoder.
        size_divisor: Image height and width must be multiples of it.

    Raises:
        ConfigError: if not 0 < min_depth < max_depth, the encoder takes several frames, or the decoder does not fit.

    Examples:
        >>> import functools
        >>> encoder = saunet.build("encoder", "stratified_nano")
        >>> decoder = functools.partial(saunet.build, "decoder", "aunet")
        >>> pyramid = saunet.DepthNet(encoder, decoder)(torch.rand(1, 3, 64, 96))
        >>> [tuple(depth.shape[-2:]) for depth in pyramid.depth]
        [(64, 96), (32, 48), (16, 24), (8, 12)]
    """

    memory_format = torch.channels_last

    def __init__(
        self, encoder: nn.Module, decoder: Callable[..., nn.Module], min_depth: float = 0.1, max_depth: float = 100.0
    ) -> None:
        super().__init__()
        if not 0 < min_depth < max_depth:
            raise ConfigError(
                f"min_depth is {min_depth} and max_depth {max_depth}; they must satisfy 0 < min_depth < max_depth"
            )
        frames = getattr(encoder, "frames", 1)  # a pose network's encoder may see several
        if frames != 1:
            raise ConfigError(
                f"the depth network's encoder has frames={frames}; depth comes from one image: set frames=1"
            )
        for needed in ("features", "size_divisor"):
            if not hasattr(encoder, needed):
                raise ConfigError(
                    f"the encoder {type(encoder).__name__} has no attribute '{needed}'; set it in __init__ "
                    "(docs/add_encoder.md)"
                )
        announced: Any = encoder.features
        if not all(isinstance(each, FeatureSpec) for each in announced):
            raise ConfigError(
                f"'features' of the encoder {type(encoder).__name__} is {announced!r}; it needs a "
                "FeatureSpec(channels, stride) for each map that it returns (docs/add_encoder.md)"
            )
        self.encoder = encoder
        self.decoder = decoder(features=encoder.features)
        self.features: Any = announced
        self.size_divisor = int(encoder.size_divisor)  # type: ignore[arg-type]
        self.min_depth, self.max_depth = float(min_depth), float(max_depth)
        lay_out(self)

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> DepthPyramid:
        """Return disparity and depth at each of the decoder's scales.

        Args:
            image: RGB in [0, 1].

        Raises:
            ConfigError: if the image has another shape or is not floating-point, its height or width is not a multiple
                of the encoder's stride, or the encoder's maps differ from its ``features``.
        """
        if image.ndim != 4 or image.shape[1] != 3 or not image.dtype.is_floating_point:
            raise ConfigError(
                f"the image is {image.dtype} of shape {tuple(image.shape)}; a depth network takes floating-point RGB "
                "in [0, 1] of shape batch x 3 x height x width; saunet.load(...).predict accepts any picture"
            )
        divisible(image.shape[-2], image.shape[-1], self.size_divisor)
        features = self.encoder(image.contiguous(memory_format=self.memory_format))
        if not torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]  # there, sizes are tensors
            self._check(features, *image.shape[-2:])
        sigmoid = tuple(self.decoder(features))
        disparity = tuple(sigmoid_to_disparity(x, self.min_depth, self.max_depth) for x in sigmoid)
        return DepthPyramid(sigmoid, disparity, tuple(disparity_to_depth(x) for x in disparity))

    def _check(self, maps: Sequence[Tensor], height: int, width: int) -> None:
        """Check that the encoder's maps are as announced, because the decoder was built for those."""
        got = [tuple(each.shape[1:]) for each in maps]
        announced = [(each.channels, height // each.stride, width // each.stride) for each in self.features]
        if got != announced:
            raise ConfigError(
                f"the encoder {type(self.encoder).__name__} returns maps of {_sizes(got)} for an image of "
                f"{height}x{width}, but its 'features' announce {_sizes(announced)}; set channels and stride of each "
                "map there, finest first (docs/add_encoder.md)"
            )


def _sizes(maps: Iterable[tuple[int, ...]]) -> str:
    return ", ".join("x".join(map(str, each)) for each in maps) or "nothing"
