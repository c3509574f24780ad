"""Predictions as a recording for Rerun's viewer: image, depth, camera, points, and the camera's path."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from saunet.errors import ConfigError, DataError
from saunet.io.atomic import replacing
from saunet.io.images import encode_jpeg
from saunet.prediction.pointcloud import Camera, point_cloud
from saunet.prediction.prediction import Prediction
from saunet.prediction.sinks import Sink
from saunet.prediction.sources import Frame

if TYPE_CHECKING:
    from saunet.prediction.odometer import Odometer

POINTS = 50_000
"""Most points per frame; the viewer makes a full cloud from depth and camera itself."""
_PATIENCE = 120.0
"""Seconds for the last data to reach the disk."""


class RerunSink(Sink):
    """A ``.rrd`` file: image, depth with its ``meter``, and with a camera also the pinhole and points.

    One unit of the world is one unit of depth, so ``meter`` is 1. Axes are the camera's: x right, y down, z ahead.
    An odometer that another sink feeds gives each frame its pose, and the path as a line.
    """

    def __init__(
        self, path: Path, camera: Camera | None, max_depth: float | int | None, odometer: Odometer | None
    ) -> None:
        try:
            self._rr: Any = importlib.import_module("rerun")
        except ImportError as missing:
            raise ConfigError("outputs has 'rrd', which needs rerun-sdk; run: pip install 'saunet[rerun]'") from missing
        self._camera, self._max_depth, self._odometer = camera, max_depth, odometer
        self._times, self.paths = list[float | None](), (path,)

    def session(self) -> Iterator[None]:
        with replacing(self.paths[0]) as temporary:
            self._recording = recording = self._rr.RecordingStream("saunet")
            recording.save(temporary)
            recording.send_recording_name(self.paths[0].stem)
            recording.set_log_time_enabled(False)  # otherwise the viewer plays at the speed of the prediction
            recording.set_log_tick_enabled(False)
            recording.log("world", self._rr.ViewCoordinates.RDF, static=True, strict=True)
            yield
            if self._odometer is not None:
                self._log_path(self._odometer.trajectory())
            # A full disk raises no exception in Rerun: its writer thread logs a line and leaves half a file.
            with contextlib.suppress(RuntimeError):
                recording.flush(timeout_sec=_PATIENCE)
                recording.disconnect()
            with temporary.open("rb") as file:
                file.seek(-min(32, temporary.stat().st_size), os.SEEK_END)
                complete = b"FOOT" in file.read()
            if not complete:
                raise DataError(f"cannot write {self.paths[0]}: Rerun could not complete it; is the disk full?")

    def add(self, frame: Frame, result: Prediction, limits: tuple[float, float]) -> None:
        rr, height, width = self._rr, *result.depth.shape
        self._times.append(frame.time)
        self._set_time(len(self._times) - 1)
        if self._camera is not None:
            K = self._camera.resized(height, width).K
            stride = math.ceil(math.sqrt(height * width / POINTS))
            cloud = point_cloud(result, self._camera, max_depth=self._max_depth, stride=stride)
            # Rerun takes matrices by rows from NumPy and stores them by columns.
            pinhole = rr.Pinhole(image_from_camera=K, width=width, height=height, camera_xyz=rr.ViewCoordinates.RDF)
            self._log("world/camera/view", pinhole)
            self._log("world/camera/points", rr.Points3D(cloud.points, colors=cloud.colors))
        jpeg = encode_jpeg(result.image, quality=90)
        self._log("world/camera/view/image", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        low, high = result.range
        self._log("world/camera/view/depth", rr.DepthImage(result.depth, meter=1.0, depth_range=(low, high)))
        if len(self._times) == 1:
            self._log("unit", rr.TextDocument(f"one unit of depth, and of the world: {result.unit}"), static=True)

    def _log(self, entity: str, value: Any, static: bool = False) -> None:
        self._recording.log(entity, value, static=static, strict=True)

    def _set_time(self, index: int) -> None:
        self._recording.set_time("frame", sequence=index)
        if (seconds := self._times[index]) is not None:
            self._recording.set_time("time", duration=seconds - (self._times[0] or 0.0))

    def _log_path(self, T_world_cam: Float64[np.ndarray, "n 4 4"]) -> None:
        rr = self._rr
        for index, pose in enumerate(T_world_cam):
            self._set_time(index)
            self._log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        self._log("world/path", rr.LineStrips3D([T_world_cam[:, :3, 3]]), static=True)
