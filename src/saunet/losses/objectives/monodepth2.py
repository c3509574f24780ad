"""The objective of Monodepth2, the field's baseline."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from saunet.losses.base import Objective
from saunet.losses.terms.photometric import Monodepth2Photometric
from saunet.losses.terms.smoothness import Smoothness
from saunet.registry import objectives


@objectives.register("monodepth2")
class Monodepth2Objective(Objective):
    """Photometric loss plus edge-aware smoothness, each averaged over scales, as in Monodepth2.

    Args:
        smoothness: Weight of the smoothness term at scale 0; scale s has 1/2**s of it.
        photometric: The photometric term; with the defaults of `Monodepth2Photometric` if None.
        extra: Further terms, each with its own weight: ``{"velocity": {"weight": 0.1}}``; see `Objective`.

    Raises:
        ConfigError: see `Objective`.
    """

    def __init__(
        self,
        smoothness: float = 1e-3,
        photometric: Monodepth2Photometric | None = None,
        extra: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        super().__init__(
            terms={"photometric": photometric or Monodepth2Photometric(), "smoothness": Smoothness()},
            weights={"photometric": 1.0, "smoothness": smoothness},
            extra=extra,
        )
