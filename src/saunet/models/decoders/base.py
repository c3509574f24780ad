"""What every decoder asks of the encoder before it and of the scales after it."""

from __future__ import annotations

from collections.abc import Sequence

from saunet.errors import ConfigError
from saunet.types import FeatureSpec


def by_level(features: Sequence[FeatureSpec]) -> dict[int, int]:
    """Return ``{level: channels}`` of an encoder's features, finest first; level l has stride 2**l."""
    strides = [feature.stride for feature in features]
    if not features or sorted(set(strides)) != strides or any(s < 1 or s & (s - 1) for s in strides) or strides[-1] < 2:
        raise ConfigError(
            f"the encoder's features have strides {strides}; a decoder needs ascending powers of two, such as [2, 4, 8]"
        )
    return {feature.stride.bit_length() - 1: feature.channels for feature in features}


def check_scales(scales: Sequence[int], levels: int) -> tuple[int, ...]:
    """Return ``scales`` as a tuple."""
    scales = tuple(scales)
    if not scales or scales != tuple(range(len(scales))) or len(scales) > levels:
        raise ConfigError(
            f"scales is {list(scales)}; allowed: {list(range(levels))} or its first entries, without gaps"
        )
    return scales
