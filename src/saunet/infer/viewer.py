"""One HTML page to walk around a clip's point clouds in any browser: everything is inside, nothing is fetched."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt16

from saunet.atomic import replacing
from saunet.checks import ConfigError, DataError, positive
from saunet.images import resize
from saunet.infer.pointcloud import Camera, jumps
from saunet.infer.prediction import Prediction

_TEMPLATE = "viewer.html"
_MARK = "@CLIP@"
_LEVELS = 65534


def write_viewer(
    path: str | Path,
    predictions: Iterable[Prediction],
    camera: Camera,
    *,
    width: int = 320,
    fps: float = 10.0,
    max_depth: float | None = None,
    edge: float = 0.15,
    title: str = "saunet depth",
) -> int:
    """Write predictions as one self-contained page, to orbit the points and scrub through the clip.

    Frames are taken and written one at a time; each adds about 0.1 MB at the default width.

    Args:
        path: The page to write, ending in ``.html``.
        predictions: The clip, in order; all frames have the first one's size.
        camera: True intrinsics of the camera that took the images.
        width: Points in a row; the rows follow from the aspect ratio.
        fps: Frames a second when played.
        max_depth: Leave out what is farther, in the unit of depth.
        edge: Leave out pixels around which depth changes by more than this share.
        title: Heading of the page.

    Returns:
        The number of frames.

    Raises:
        ConfigError: for another ending or settings out of range.
        DataError: if there is no frame, or the system refuses to write.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"the page {path} must end in .html")
    positive("width", width)
    positive("fps", fps)
    before, after = resources.files("saunet.infer").joinpath(_TEMPLATE).read_text(encoding="utf-8").split(_MARK)
    count = 0
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as page:
        for prediction in predictions:
            rows = max(1, round(width * prediction.depth.shape[0] / prediction.depth.shape[1]))
            if count == 0:
                page.write(
                    before + _json(_head(prediction, camera.resized(rows, width), title, fps))[:-1] + ',"frames":['
                )
            page.write(("," if count else "") + _json(_frame(prediction, rows, width, max_depth, edge)))
            count += 1
        if count == 0:
            raise DataError(f"no frame was given, so {path} was not written")
        page.write("]}" + after)
    return count


def _head(prediction: Prediction, camera: Camera, title: str, fps: float) -> dict[str, Any]:
    K = camera.K
    return {
        "title": title,
        "unit": prediction.unit,
        "fps": fps,
        "width": camera.width,
        "height": camera.height,
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "pivot": float(np.percentile(prediction.depth, 30)),
    }


def _frame(prediction: Prediction, rows: int, width: int, max_depth: float | None, edge: float) -> dict[str, Any]:
    disparity = np.asarray(resize(prediction.disparity, rows, width), dtype=np.float32)
    keep = disparity > 0
    if max_depth is not None:
        keep &= disparity >= 1 / positive("max_depth", max_depth)
    if edge:
        keep &= ~jumps(disparity, edge)
    low, high = float(disparity.min()), float(disparity.max())
    picture = cv2.cvtColor(np.asarray(resize(prediction.image, rows, width)), cv2.COLOR_RGB2BGR)
    _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    levels = np.where(keep, quantise(disparity, low, high), 0).astype("<u2")
    return {
        "image": base64.b64encode(jpeg.tobytes()).decode(),
        "disparity": base64.b64encode(levels.tobytes()).decode(),
        "low": low,
        "high": high,
    }


def quantise(disparity: Float32[np.ndarray, "h w"], low: float, high: float) -> UInt16[np.ndarray, "h w"]:
    """Return disparity as levels 1 (``low``) to 65535 (``high``); 0 is left for points that are not shown."""
    span = high - low if high > low else 1.0
    return (1 + np.round(np.clip((disparity - low) / span, 0, 1) * _LEVELS)).astype(np.uint16)


def _json(value: dict[str, Any]) -> str:
    """Return JSON that is safe inside a script element."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
