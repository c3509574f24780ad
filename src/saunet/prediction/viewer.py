"""One HTML page to walk around a clip's point clouds in any browser: everything is inside, nothing is fetched."""

from __future__ import annotations

import base64
import contextlib
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt16

from saunet.errors import ConfigError, DataError, positive
from saunet.io.atomic import replacing
from saunet.io.images import resize
from saunet.prediction.pointcloud import Camera, jumps
from saunet.prediction.prediction import Prediction

_TEMPLATE = "viewer.html"
_MARKS = ("@CLIP@", "@FRAMES@")
_LEVELS = 65534


class ViewerWriter:
    """Writes predictions as one self-contained page, to orbit the points and scrub through the clip.

    Use it as a context manager: frames are written as they come, each adds about 0.1 MB at the default width, and the
    page gets its name only when it is complete; leaving it by an error discards it.

    """

    def __init__(
        self,
        path: str | Path,
        camera: Camera | Sequence[float | int],
        *,
        width: int = 320,
        fps: float | int = 10.0,
        max_depth: float | int | None = None,
        edge: float = 0.15,
        title: str = "saunet depth",
    ) -> None:
        self.path, self.count = Path(path), 0
        if self.path.suffix.lower() not in (".html", ".htm"):
            raise ConfigError(f"the page {path} must end in .html")
        positive("width", width)
        self._camera, self._width, self._rows = camera, width, 0
        self._fps, self._title, self._edge = float(positive("fps", fps)), title, edge
        self._max_depth = None if max_depth is None else positive("max_depth", max_depth)
        self._open = contextlib.ExitStack()

    def __enter__(self) -> ViewerWriter:
        template = resources.files("saunet.prediction").joinpath(_TEMPLATE).read_text(encoding="utf-8")
        self._before, rest = template.split(_MARKS[0])
        self._between, self._after = rest.split(_MARKS[1])
        temporary = self._open.enter_context(replacing(self.path))
        try:
            self._page = self._open.enter_context(temporary.open("w", encoding="utf-8"))
        except OSError as reason:
            self.__exit__(type(reason), reason, reason.__traceback__)
            raise
        return self

    def add(self, prediction: Prediction) -> None:
        """Write one more frame."""
        if self.count == 0:
            self._rows = max(1, round(self._width * prediction.depth.shape[0] / prediction.depth.shape[1]))
            if not isinstance(self._camera, Camera):
                self._camera = Camera.from_numbers(self._camera, *prediction.depth.shape)
            head = _head(prediction, self._camera.resized(self._rows, self._width), self._title, self._fps)
            self._page.write(self._before + _json(head) + self._between)
        frame = _frame(prediction, self._rows, self._width, self._max_depth, self._edge)
        self._page.write(f'<script class="frame" type="application/json">{_json(frame)}</script>\n')
        self.count += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._open:  # closes the page, then lets it take its name or vanish
            if error is not None:
                raise error
            if self.count == 0:
                raise DataError(f"no frame was given, so {self.path} was not written")
            self._page.write(self._after)


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


def _frame(prediction: Prediction, rows: int, width: int, max_depth: float | int | None, edge: float) -> dict[str, Any]:
    disparity = np.asarray(resize(prediction.disparity, rows, width), dtype=np.float32)
    keep = disparity > 0
    if max_depth is not None:
        keep &= disparity >= 1 / max_depth
    if edge:
        keep &= ~jumps(disparity, edge)
    low, high = float(disparity.min()), float(disparity.max())
    picture = cv2.cvtColor(np.asarray(resize(prediction.image, rows, width)), cv2.COLOR_RGB2BGR)
    _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    levels = np.where(keep, quantize(disparity, low, high), 0).astype("<u2")
    return {
        "image": base64.b64encode(jpeg.tobytes()).decode(),
        "disparity": base64.b64encode(levels.tobytes()).decode(),
        "low": low,
        "high": high,
    }


def quantize(disparity: Float32[np.ndarray, "h w"], low: float, high: float) -> UInt16[np.ndarray, "h w"]:
    """Return disparity as levels 1 (``low``) to 65535 (``high``); 0 is left for points that are not shown."""
    span = high - low if high > low else 1.0
    return (1 + np.round(np.clip((disparity - low) / span, 0, 1) * _LEVELS)).astype(np.uint16)


def _json(value: dict[str, Any]) -> str:
    """Return JSON that is safe inside a script element."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
