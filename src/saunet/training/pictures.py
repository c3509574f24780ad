"""What the networks see and do, as one picture: input, disparity, warped neighbor and auto-mask."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from saunet.io.colormaps import colorize
from saunet.prediction.panel import panel
from saunet.types import DepthPyramid, LossTerms, TrainBatch, View


def training_panel(
    batch: TrainBatch, pyramid: DepthPyramid, views: Sequence[View], terms: LossTerms, rows: int = 2
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the first samples of a batch, one a row.

    Args:
        batch: What the networks were given.
        pyramid: The depth they predicted.
        views: The sources warped into the target, one a scale.
        terms: The objective's result; its maps (b 1 h w) are drawn in gray, white is 1 or the largest value.
        rows: How many samples.

    Returns:
        RGB.
    """
    tiles: dict[str, UInt8[np.ndarray, "_ _ 3"]] = {}
    count = min(rows, len(batch["name"]))
    for row in range(count):
        tag = f" {row + 1}" if count > 1 else ""
        tiles[f"input{tag}"] = _rgb(batch["target"][row])
        tiles[f"disparity{tag}"] = colorize(_array(pyramid.disparity[0][row, 0]))
        tiles[f"warped neighbor{tag}"] = _rgb(views[0].image[row, 0])
        for name, values in terms.maps.items():
            shown = _array(values[row, 0].float())
            top = max(float(shown.max()), 1e-6) if name != "automask" else 1.0
            tiles[f"{name.replace('_', ' ')}{tag}"] = colorize(shown, (0.0, top), "gray")
    return panel(tiles, columns=len(tiles) // count, tile_width=320)


def _array(values: Tensor) -> Any:
    return values.detach().float().cpu().numpy()


def _rgb(image: Float[Tensor, "3 h w"]) -> UInt8[np.ndarray, "h w 3"]:
    return np.asarray((_array(image).transpose(1, 2, 0).clip(0, 1) * 255).round(), dtype=np.uint8)
