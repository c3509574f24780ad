"""The runs' networks in a report: their sizes, and their predictions for the same scenes, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from saunet.errors import ConfigError, SaunetError
from saunet.io.colormaps import colorize
from saunet.io.images import as_rgb_bytes, read_image, resize
from saunet.prediction.predictor import Predictor
from saunet.prediction.sources import find_sources
from saunet.reporting.page import Picture, Scene, Tile
from saunet.runs.run import Run
from saunet.tools.benchmark.measure import count_parameters
from saunet.weights.files import read_model

MARKS = ((226, 52, 58), (0, 190, 220), (120, 200, 60))
"""Colors of the boxes, RGB."""
_WIDTH = 880
"""Largest width in pixels of a picture on the page: twice its displayed width."""


@dataclass(frozen=True, slots=True)
class Box:
    """A part of an image in pixels."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class View:
    """One image to show, with its source and the condition in which it was taken."""

    path: Path
    image: UInt8[np.ndarray, "h w 3"]
    title: str
    condition: str


def read_views(scenes: Mapping[str, str | Sequence[str]], limit: int) -> list[View]:
    """Read the images that a report shows."""
    views = []
    for condition, given in scenes.items():
        inputs = [given] if isinstance(given, str) else list(given or ())
        if not inputs:
            raise ConfigError(f"scenes.{condition} is empty; name an image, a folder or a pattern")
        paths = [frame.image for item in inputs for frame in find_sources(item)]
        if limit < len(paths):
            paths = [paths[int(place)] for place in np.linspace(0, len(paths) - 1, limit + 2).round()[1:-1]]
        views += [View(path, read_image(path), "/".join(path.parts[-4:]), condition) for path in paths]
    return views


@dataclass(frozen=True, eq=False)
class Seen:
    """A run's networks, used once and released."""

    parameters: tuple[int, int]
    """Number of parameters of the depth and the pose network."""
    size: tuple[int, int]
    """Height and width of its input in pixels."""
    disparities: tuple[Float32[np.ndarray, "_ _"], ...]
    """One prediction per view, at the image's size."""


def look(run: Run, views: Sequence[View], device: str = "cpu", flip: bool = False) -> Seen | str:
    """Build a run's networks, count their parameters and predict the views."""
    if run.checkpoint is None:
        return run.error or "it has no checkpoint"
    try:
        checkpoint = read_model(run.checkpoint)
        depth, pose = checkpoint.networks()
        record = checkpoint.record
        predictor = Predictor(depth, record.height, record.width, device, record.scale, flip)
        disparities = tuple(predictor.predict(view.image, view.title).disparity for view in views)
    except SaunetError as error:
        return str(error)
    size = (record.height, record.width)
    return Seen((count_parameters(depth), count_parameters(pose)), size, disparities)


def edge_boxes(
    disparities: Sequence[Float[np.ndarray, "h w"]], image: UInt8[np.ndarray, "h w 3"], count: int
) -> list[Box]:
    """Choose parts of a scene, without overlap, where the models see most depth edges on edges of the image.

    All models get the same parts. A part is a sixth of the width, and two thirds as high as wide.
    """
    height, width = image.shape[:2]
    size = max(8, width // 6)
    box = (min(height, round(size / 1.5)), min(width, size))
    strength = _gradient(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)) + 0.1
    flat = np.zeros((height, width), np.float32)
    edges = sum((_gradient(np.log(np.maximum(one, 1e-6))) for one in disparities), flat)
    sums = cv2.boxFilter(edges * strength, -1, box[::-1], normalize=True, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    sums = sums[: height - box[0] + 1, : width - box[1] + 1]
    boxes: list[Box] = []
    for _ in range(count):
        top, left = np.unravel_index(int(sums.argmax()), sums.shape)
        if not sums[top, left] > 0:
            break
        boxes.append(Box(int(left), int(top), box[1], box[0]))
        sums[max(0, top - box[0]) : top + box[0], max(0, left - box[1]) : left + box[1]] = 0
    return sorted(boxes, key=lambda one: one.left)


def scene(view: View, disparities: Mapping[str, Float32[np.ndarray, "h w"]], name: str, boxes: int) -> Scene:
    """Return a scene as input and as predicted by each model, with the same parts enlarged.

    Each model's disparity is colored over its own range, because its scale is arbitrary.
    """
    found = edge_boxes(list(disparities.values()), view.image, boxes)
    pictures = {"input": view.image, **{model: colorize(one) for model, one in disparities.items()}}
    tiles = []
    for index, (label, picture) in enumerate(pictures.items()):
        zooms = tuple(
            Picture(f"{name}_{index}_zoom{number}.jpg", _jpeg(_enlarged(picture, box, number)), f"{label}, enlarged")
            for number, box in enumerate(found)
        )
        shown = Picture(f"{name}_{index}.jpg", _jpeg(_boxed(picture, found)), f"{label}: {view.title}")
        tiles.append(Tile(label, shown, zooms))
    return Scene(view.title, tuple(tiles))


def _gradient(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return how much a map changes at each pixel, relative to the largest change that is not an outlier."""
    across, down = (cv2.Sobel(values, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
    change = cv2.magnitude(across, down)
    top = float(np.percentile(change, 99))
    return np.asarray(np.minimum(change / top, 1.0) if top > 0 else change, dtype=np.float32)


def _boxed(picture: UInt8[np.ndarray, "h w 3"], boxes: Sequence[Box]) -> UInt8[np.ndarray, "_ _ 3"]:
    height, width = picture.shape[:2]
    zoom = min(1.0, _WIDTH / width)
    shown = np.array(resize(picture, max(1, round(height * zoom)), _WIDTH) if zoom < 1 else picture)
    line = max(1, round(shown.shape[1] / 300))
    for number, box in enumerate(boxes):
        corners = ((box.left, box.top), (box.left + box.width - 1, box.top + box.height - 1))
        first, last = ((round(x * zoom), round(y * zoom)) for x, y in corners)
        cv2.rectangle(shown, first, last, MARKS[number % len(MARKS)], line)
    return shown


def _enlarged(picture: UInt8[np.ndarray, "h w 3"], box: Box, number: int) -> UInt8[np.ndarray, "_ _ 3"]:
    part = picture[box.top : box.top + box.height, box.left : box.left + box.width]
    width = _WIDTH // 2
    large = cv2.resize(part, (width, max(1, round(width * box.height / box.width))), interpolation=cv2.INTER_CUBIC)
    corner = (large.shape[1] - 1, large.shape[0] - 1)
    return as_rgb_bytes(cv2.rectangle(large, (0, 0), corner, MARKS[number % len(MARKS)], 6))


def _jpeg(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)[1].tobytes())
