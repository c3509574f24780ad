"""The camera of what is predicted: as it is given, or as a ``camera.yaml`` beside the pictures describes it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from saunet.errors import ConfigError
from saunet.prediction.pointcloud import Camera
from saunet.prediction.prediction import ImagePredictor
from saunet.prediction.sources import Recording, clips_of

if TYPE_CHECKING:
    from saunet.prediction.tool import PredictOptions


def with_camera(
    options: PredictOptions, recording: Recording, outputs: Sequence[str], asked_by: str | None = None
) -> PredictOptions:
    """Return options with the nearest ``camera.yaml`` where a camera is needed and none is given; say which.

    Of a given one, say which nearer files it goes before. ``asked_by`` is what needs one besides points and the scale.

    Raises:
        ConfigError: if points are asked for and there is no camera, or clips of several cameras need one.
    """
    points = next((output for output in outputs if output in ("ply", "html")), None)
    needs = [f"outputs=[{points}]"] if points else []
    needs += [f"scale.method={options.scale.method}"] if options.scale.method in ("camera_height", "stereo") else []
    needs += ["motion=tracked"] if options.motion == "tracked" else []
    needs += [asked_by] if asked_by else []
    given = options.camera if options.undistort is None else options.undistort
    if given is None and not needs:
        return options
    from saunet.data.video.calibrations import nearest_camera

    clips = clips_of(options.input, recording.images)
    if given is not None:
        found = {nearest_camera(clip, base) for clip, base in clips.items()} - {None}
        others = sorted(str(file) for file in found if file and not _same(file, given))
        if others:
            key = "camera" if options.undistort is None else "undistort"
            text = given if isinstance(given, str | Path) else "..." if isinstance(given, Camera) else [*given]
            print(f"{key}={text} is used for every frame; passed over: {', '.join(others)}")
        return options
    by_content: dict[bytes | None, tuple[Path, Path | None]] = {}
    for clip, base in clips.items():
        file = nearest_camera(clip, base)
        by_content.setdefault(None if file is None else file.read_bytes(), (clip, file))
    if len(by_content) > 1:
        told = [f"{clip}: {file or 'no camera.yaml'}" for clip, file in by_content.values()]
        raise ConfigError(
            f"{needs[0]} needs one camera, and the clips of the input have different ones ({'; '.join(told[:3])}); "
            "predict the clips of each camera on their own, or set camera= for all"
        )
    _, file = next(iter(by_content.values()), (None, None))
    if file is not None:
        print(f"camera: {file}")
        return replace(options, camera=file)
    if points:
        raise ConfigError(
            f"outputs has '{points}', which needs the camera's true intrinsics; give camera fx, fy, cx, cy, "
            "a camera.yaml, or one number, the horizontal field of view in degrees, or put camera.yaml beside the input"
        )
    return options


def _same(file: Path, given: object) -> bool:
    """Return whether a camera file is the given one, or has the same content."""
    if not isinstance(given, str | Path):
        return False
    path = Path(given)
    return path.is_file() and (path.samefile(file) or path.read_bytes() == file.read_bytes())


def read_given(
    options: PredictOptions, recording: Recording, predictor: ImagePredictor
) -> tuple[Camera | None, float | None]:
    """Return the true intrinsics of what is predicted and the camera's height, None if they are not given.

    Makes the predictor undistort.
    """
    given = options.camera if options.undistort is None else options.undistort
    if given is None or isinstance(given, Camera):
        return given, None
    if given == "checkpoint":
        from saunet.weights.files import read_model

        found, size = read_model(options.checkpoint).record.intrinsics, recording.first_size
        if found is None:
            raise ConfigError(
                f"camera=checkpoint uses the focal length that a training found, but '{options.checkpoint}' has "
                "none; give the camera, or train with model.intrinsics=learned"
            )
        view = math.degrees(2 * math.atan(0.5 / found.mean[1]))
        return None if size is None else Camera.from_numbers([view], *size), None
    numbers = _numbers(str(given)) if isinstance(given, str | Path) else given
    if numbers is not None:
        size = recording.first_size
        return None if size is None else Camera.from_numbers(numbers, *size), None
    from saunet.data.video.calibrations import split_name
    from saunet.data.video.camera import Undistorter, read_camera

    file = read_camera(str(given))
    if options.undistort is not None:
        predictor.undistort = undistorter = Undistorter(file)
        content = hashlib.sha256(f"{split_name(str(given))[1]}\n".encode() + file.path.read_bytes())
        predictor.undistorted_by = f"camera {content.hexdigest()[:16]}"
        size = file.image_size or recording.first_size
        if size is None:
            return None, file.camera_height
        lens = undistorter.lens(*size)
        return Camera(lens.K, lens.height, lens.width), file.camera_height
    if not file.is_straight:
        raise ConfigError(
            f"camera={given} describes a lens with distortion, but points need undistorted images; set "
            f"undistort={given} instead"
        )
    size = recording.first_size
    camera = None if size is None else Camera(file.intrinsics(*size, "the images"), *size)
    return camera, file.camera_height


def _numbers(text: str) -> list[float] | None:
    """Return the numbers in a text such as ``80,80,44.5,29.5``; None for the name of a file."""
    words = text.split(",")
    plain = all(word.strip().replace(".", "", 1).replace("-", "", 1).isdigit() for word in words)
    return [float(word) for word in words] if plain else None
