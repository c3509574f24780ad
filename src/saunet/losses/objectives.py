"""Registered objectives: weighted compositions of terms."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from saunet.losses.base import Objective
from saunet.losses.terms import Gradient, Monodepth2Photometric, Photometric, Smoothness
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
    """

    def __init__(
        self,
        alpha: float = 10.0,
        beta: float = 0.1,
        photometric: Photometric | None = None,
        gradient: Gradient | None = None,
        extra: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        terms = {"photometric": photometric or Photometric(), "gradient": gradient or Gradient()}
        super().__init__(terms, {"photometric": alpha, "gradient": beta}, extra)


@objectives.register("monodepth2")
class Monodepth2Objective(Objective):
    """Photometric loss plus edge-aware smoothness, each averaged over scales, as in Monodepth2, the field's baseline.

    Args:
        smoothness: Weight of the smoothness term at scale 0; scale s has 1/2**s of it.
        photometric: The photometric term; with the defaults of `Monodepth2Photometric` if None.
        extra: Further terms, each with its own weight: ``{"velocity": {"weight": 0.1}}``; see `Objective`.
    """

    def __init__(
        self,
        smoothness: float = 1e-3,
        photometric: Monodepth2Photometric | None = None,
        extra: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        terms = {"photometric": photometric or Monodepth2Photometric(), "smoothness": Smoothness()}
        super().__init__(terms, {"photometric": 1.0, "smoothness": smoothness}, extra)
