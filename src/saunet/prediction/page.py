"""Views of a prediction: a figure for notebooks, and a page that shows the depth under the cursor."""

from __future__ import annotations

import base64
import html
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from saunet.io.colormaps import colorize, value_range
from saunet.io.images import encode_jpeg, resize
from saunet.prediction.pointcloud import encoded, script_json
from saunet.prediction.prediction import Prediction

_PAGE = Path(__file__).with_name("depth.html")
_WIDTH = 1280
"""Largest width in pixels; larger predictions are shown smaller."""


def depth_figure(prediction: Prediction) -> str:
    """Return image and disparity beside each other as HTML, with the unit and the range of depth."""
    low, high = prediction.range
    caption = f"{Path(prediction.name).name}: depth {low:.3g} to {high:.3g}, {prediction.unit}; bright is near"
    cells = (
        f'<img alt="{alt}" src="data:image/jpeg;base64,{_jpeg(picture, 640)}" style="flex: 1 1 300px; min-width: 0">'
        for alt, picture in (("image", prediction.image), ("disparity in colors", prediction.color()))
    )
    return (
        f'<figure style="margin: 0; max-width: 1290px"><div style="display: flex; flex-wrap: wrap; gap: 6px">'
        f"{''.join(cells)}</div><figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def depth_page(prediction: Prediction, colormap: str = "magma") -> str:
    """Return a page that loads nothing else: image, disparity, the depth under the cursor, and a color scale."""
    height, width = prediction.depth.shape
    rows, columns = max(1, round(height * min(1, _WIDTH / width))), min(width, _WIDTH)
    disparity = np.asarray(resize(prediction.disparity, rows, columns), dtype=np.float32)
    limits = value_range(prediction.disparity)
    bar = colorize(np.linspace(*limits, 256, dtype=np.float32)[None], limits, colormap)
    data = {
        "name": Path(prediction.name).name,
        "unit": prediction.unit,
        "metric": prediction.metric,
        "size": [width, height],
        "shown": [columns, rows],
        "limits": limits,
        "image": _jpeg(prediction.image, columns),
        "color": _jpeg(prediction.color(limits, colormap), columns),
        "bar": _jpeg(np.repeat(bar, 8, axis=0), 256),
        **encoded(disparity, disparity > 0),
    }
    return _PAGE.read_text(encoding="utf-8").replace("@DATA@", script_json(data))


def _jpeg(picture: UInt8[np.ndarray, "_ _ 3"], width: int) -> str:
    width = min(width, picture.shape[1])
    height = max(1, round(picture.shape[0] * width / picture.shape[1]))
    return base64.b64encode(encode_jpeg(resize(picture, height, width), quality=90)).decode()
