"""Pictures side by side with their names, as in the demo, the training log and reports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from saunet.errors import ConfigError, positive
from saunet.io.colormaps import colorize, value_range
from saunet.io.images import resize

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_INK, _PAPER = (245, 245, 245), (24, 24, 24)


def panel(
    tiles: Mapping[str, UInt8[np.ndarray, "_ _ 3"]], columns: int = 1, tile_width: int = 640, gap: int = 4
) -> UInt8[np.ndarray, "h w 3"]:
    """Arrange named RGB pictures in a grid, row by row, each under its name."""
    if not tiles:
        raise ConfigError("a panel needs at least one picture, got none")
    positive("columns", columns)
    positive("tile_width", tile_width)
    first = next(iter(tiles.values()))
    height = max(1, round(tile_width * first.shape[0] / first.shape[1]))
    strip = label_height(tile_width)
    rows = math.ceil(len(tiles) / columns)
    columns = min(columns, len(tiles))
    down, across = strip + height + gap, tile_width + gap
    canvas = np.full((gap + rows * down, gap + columns * across, 3), _PAPER, np.uint8)
    for index, (name, picture) in enumerate(tiles.items()):
        row, column = divmod(index, columns)
        tile = np.concatenate([label(name, tile_width), fit(picture, height, tile_width)])
        canvas[gap + row * down :, gap + column * across :][: strip + height, :tile_width] = tile
    return canvas


def depth_panel(
    image: UInt8[np.ndarray, "h w 3"],
    disparity: Float[np.ndarray, "hd wd"],
    truth: Float[np.ndarray, "hg wg"] | None = None,
    *,
    columns: int = 1,
    tile_width: int = 640,
    colormap: str = "magma",
    note: str = "",
    others: Mapping[str, Float[np.ndarray, "_ _"]] = MappingProxyType({}),
) -> UInt8[np.ndarray, "hp wp 3"]:
    """Show an image, its disparity and, if the true depth is known, the truth and the relative error.

    The prediction is scaled to the truth by the ratio of medians before the comparison, as in evaluation, and both are
    painted with the truth's colors. ``others`` are further predictions by name, shown before it in the same way.
    """
    tiles = {"input": image}
    predictions = {**others, f"disparity{' ' + note if note else ''}": disparity}
    shown = {name: resize(np.asarray(each, dtype=np.float32), *image.shape[:2]) for name, each in predictions.items()}
    if truth is None or not (truth > 0).any():
        tiles |= {name: colorize(each, colormap=colormap) for name, each in shown.items()}
        return panel(tiles, columns, tile_width)
    known = truth > 0
    true_disparity = np.where(known, 1 / np.where(known, truth, 1), 0).astype(np.float32)
    limits = value_range(true_disparity[known])
    for name, each in shown.items():
        predicted = resize(each, *truth.shape)
        predicted = predicted * (np.median(1 / predicted[known]) / np.median(truth[known]))
        tiles[name] = colorize(predicted, limits, colormap)
    error = np.where(known, np.abs(1 / predicted - truth) / np.where(known, truth, 1), 0).astype(np.float32)
    dot = max(1, round(truth.shape[1] / tile_width * 3)) if known.mean() < 0.3 else 1
    tiles["ground truth"] = _dots(colorize(true_disparity, limits, colormap, known), dot)
    tiles["relative error: dark 0, bright 30 % or more"] = _dots(colorize(error, (0.0, 0.3), "inferno", known), dot)
    return panel(tiles, columns, tile_width)


def label_height(width: int) -> int:
    """Return the height in pixels of a name strip above a picture of this width."""
    return max(14, min(28, round(width / 20)))


def label(text: str, width: int) -> UInt8[np.ndarray, "_ {width} 3"]:
    """Return a strip with a name, in smaller letters if it does not fit."""
    height = label_height(width)
    size = height / 34
    (length, _), _ = cv2.getTextSize(text, _FONT, size, 1)
    if length > width - 8:
        size *= max(1, width - 8) / length
    strip = np.full((height, width, 3), _PAPER, np.uint8)
    return cv2.putText(strip, text, (4, round(height * 0.72)), _FONT, size, _INK, 1, cv2.LINE_AA)


def fit(picture: UInt8[np.ndarray, "_ _ 3"], height: int, width: int) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Return a picture at exactly this size: smooth when shrinking, sharp pixels when growing much."""
    if height >= 3 * picture.shape[0] and width >= 3 * picture.shape[1]:
        return cv2.resize(picture, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(resize(picture, height, width))


def _dots(picture: UInt8[np.ndarray, "h w 3"], size: int) -> UInt8[np.ndarray, "h w 3"]:
    """Spread single bright pixels over ``size`` x ``size``, so that they survive shrinking."""
    return cv2.dilate(picture, np.ones((size, size), np.uint8)) if size > 1 else picture
