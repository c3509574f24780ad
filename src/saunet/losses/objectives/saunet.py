"""The objective of the SAU-Net paper."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from saunet.losses.base import Objective
from saunet.losses.terms.gradient import Gradient
from saunet.losses.terms.photometric import Photometric
from saunet.registry import objectives


@objectives.register("saunet")
class SaunetObjective(Objective):
    """L = alpha L1 + beta L2, SAU-Net eq. (14): a primary photometric and an auxiliary gradient loss.

    Args:
        alpha: Weight of the photometric term.
        beta: Weight of the gradient term; 0 trains on the photometric term alone.
        photometric: L1, eqs. (8)-(12); with the defaults of `Photometric` if None.
        gradient: L2, eq. (13); with the defaults of `Gradient` if None.
        extra: Further terms, each with its own weight: ``{"smoothness": {"weight": 0.001}}``; see `Objective`.

    Raises:
        ConfigError: see `Objective`.
    """

    def __init__(
        self,
        alpha: float = 10.0,
        beta: float = 0.1,
        photometric: Photometric | None = None,
        gradient: Gradient | None = None,
        extra: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        super().__init__(
            terms={"photometric": photometric or Photometric(), "gradient": gradient or Gradient()},
            weights={"photometric": alpha, "gradient": beta},
            extra=extra,
        )
