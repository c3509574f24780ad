"""The files of single predictions, whole or not there, and the note of what made a folder's files."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from saunet.errors import ConfigError, DataError, positive
from saunet.io.atomic import write_bytes, write_json
from saunet.io.colormaps import depth_to_png16
from saunet.io.images import write_image
from saunet.io.plain import read_json
from saunet.prediction.pointcloud import Camera, point_cloud, write_ply
from saunet.prediction.prediction import ImagePredictor, Prediction
from saunet.prediction.sources import Frame, Source, holds_originals

OUTPUTS: tuple[str, ...] = ("color", "png16", "npy", "ply")
"""What can be written for each image: disparity in colors, depth as 16-bit PNG (x 256) or float32 array, points."""
MANIFEST = "predictions.json"
"""Written into the output folder: which model and settings its files come from."""

ENDINGS = {"color": "_disparity.png", "png16": "_depth.png", "npy": "_depth.npy", "ply": "_points.ply"}


@dataclass(frozen=True, slots=True)
class Style:
    """How results are drawn and written."""

    colormap: str = "magma"
    limits: tuple[float, float] | None = None
    camera: Camera | None = None
    max_depth: float | int | None = None

    def __post_init__(self) -> None:
        if self.max_depth is not None:
            positive("max_depth", self.max_depth)
        if self.limits is not None and not all(map(math.isfinite, self.limits)):
            raise ConfigError(f"color limits are {self.limits[0]} to {self.limits[1]}; they must be finite numbers")

    def plain(self) -> dict[str, object]:
        """Return the style as plain data."""
        K = self.camera.K.tolist() if self.camera else None
        return {"colormap": self.colormap, "limits": self.limits, "camera": K, "max_depth": self.max_depth}


class Manifest:
    """What an output folder says its files come from."""

    def __init__(self, folder: Path, predictor: ImagePredictor, style: Style, overwrite: bool) -> None:
        self.path = folder / MANIFEST
        self.settings: dict[str, object] = {
            "model": predictor.fingerprint,
            "unit": predictor.unit,
            "undistorted": predictor.undistorted_by,
            **style.plain(),
        }
        self.clips: dict[str, Any] = {}
        """How results of whole recordings were made, by the names of their files."""
        self.written = False
        if overwrite or not self.path.exists():
            return
        try:
            previous = read_json(self.path)
        except (OSError, ValueError) as reason:
            raise DataError(
                f"{self.path} cannot be read ({reason}); delete it, or choose another output folder"
            ) from reason
        current = json.loads(json.dumps(self.settings))
        changed = [key for key in current if not isinstance(previous, dict) or previous.get(key) != current[key]]
        if changed:
            raise ConfigError(
                f"{folder} holds predictions made with another {', '.join(changed)}; "
                "choose another output folder, or set overwrite=true"
            )
        clips = previous.get("clips")
        self.written, self.clips = True, clips if isinstance(clips, dict) else {}

    def claim(self) -> None:
        """Write down whose files these are, before the first one that has to be told from others' is finished."""
        if not self.written:
            self.write()

    def write(self, clips: Mapping[str, Any] | None = None) -> None:
        """Write it, with further results of whole recordings."""
        self.clips.update(clips or {})
        write_json(self.path, {**self.settings, **({"clips": self.clips} if self.clips else {})})
        self.written = True


def check_folder_of(folder: Path, sources: Sequence[Source]) -> None:
    """Check that results of images would not lie among the originals: the next run would read them as images."""
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"the output folder {folder} is a file; choose another name")
    own = folder.resolve()
    targets = {own} | {(own / source.stem).resolve().parent for source in sources}
    for source in sources:
        if source.path.resolve().parent in targets:
            raise holds_originals(folder, source.path)


def path_of(output: str, stem: Path) -> Path:
    """Return the file of an output: ``stem`` and an ending."""
    return stem.with_name(f"{stem.name}{ENDINGS[output]}")


def unfinished(frame: Frame, folder: Path, outputs: Sequence[str]) -> list[str]:
    """Return the outputs that are not there yet or older than their image; files appear only when they are complete."""
    changed = frame.path.stat().st_mtime if frame.path and frame.path.exists() else 0.0
    paths = {output: path_of(output, folder / frame.stem) for output in outputs}
    return [output for output, path in paths.items() if not path.is_file() or path.stat().st_mtime < changed]


def write_output(output: str, stem: Path, result: Prediction, style: Style) -> Path:
    """Write one of `OUTPUTS` of a prediction, whole or not at all, and return its path."""
    path = path_of(output, stem)
    _WRITERS[output](path, result, style)
    return path


def _write_npy(path: Path, result: Prediction, style: Style) -> None:
    buffer = io.BytesIO()
    np.save(buffer, result.depth)
    write_bytes(path, buffer.getvalue())


def _write_ply(path: Path, result: Prediction, style: Style) -> None:
    assert style.camera is not None  # the options have asked for it
    write_ply(path, point_cloud(result, style.camera, max_depth=style.max_depth))


_WRITERS: dict[str, Callable[[Path, Prediction, Style], None]] = {
    "color": lambda path, result, style: write_image(path, result.color(style.limits, style.colormap)),
    "png16": lambda path, result, style: write_image(path, depth_to_png16(result.depth)),
    "npy": _write_npy,
    "ply": _write_ply,
}
