"""Metric scale on the command line: what ``scale.method`` asks for, measured, reported, applied and stored."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from saunet.errors import ConfigError, one_of, positive
from saunet.roots import SCALE_METHODS


def _fps(cfg: DictConfig, recorded: float | None) -> float:
    """Return the frame rate as set, as recorded, or KITTI's."""
    return cfg.scale.fps if cfg.scale.fps is not None else recorded or 10.0


def scale_predictor(cfg: DictConfig, predictor: Any) -> None:
    """Give a predictor the scale that ``cfg.scale`` asks for; report what was measured.

    Args:
        cfg: The root of ``saunet predict``.
        predictor: An `ImagePredictor`; its own scale is the stored one.

    Raises:
        ConfigError: if the method is unknown or lacks what it needs.
        DataError: if no frame could be measured.
    """
    from saunet.scale import METHODS, estimate_scale

    method = _check(cfg)
    if method in METHODS:
        import torch

        def depth(image: Any) -> Any:
            return 1 / torch.from_numpy(predictor.disparity(image.numpy()))[:, None]

        pose, offsets = _pose(cfg) if method == "speed" else (None, ())
        with _clip_batches(cfg, predictor, method, offsets) as batches:
            estimate = estimate_scale(method, batches, depth, pose, cfg.scale.camera_height)
        predictor.scale = _report(cfg, estimate, Path(cfg.output))
    predictor.scale = _chosen(method, predictor.scale)


@contextlib.contextmanager
def _clip_batches(cfg: DictConfig, predictor: Any, method: str, offsets: Any) -> Iterator[Any]:
    from saunet.prediction.clips import open_clip
    from saunet.prediction.pointcloud import Camera
    from saunet.scale.clips import clip_batches
    from saunet.scale.speeds import read_speeds

    if str(cfg.input).isdecimal() and not Path(cfg.input).exists():
        raise ConfigError(
            f"scale.method={method} measures over a whole recording and a live camera cannot be looked at beforehand; "
            "measure with scale.store=true on recorded frames, then leave scale.method out"
        )
    options: dict[str, Any] = {"offsets": offsets, "most": cfg.scale.frames}
    with contextlib.ExitStack() as stack:
        clip = open_clip(cfg.input)
        stack.callback(clip.close)
        if method != "speed":
            needed = _needed(cfg.camera, "camera", method, "fx,fy,cx,cy in pixels of the images")
            first = next(iter(clip))
            camera = Camera.from_numbers(list(needed), *first.shape[:2])
            clip = open_clip(cfg.input)
            stack.callback(clip.close)
            options["intrinsics"] = lambda height, width: camera.resized(height, width).K
        if method == "speed":
            path = _needed(cfg.scale.speeds, "scale.speeds", method, "a CSV file with the columns frame,speed")
            table, fps = read_speeds(path), _fps(cfg, clip.fps)
            table.check_drives([])
            options["distance"] = lambda first, second: table.distance("", first, second, fps)
        if method == "stereo":
            other = open_clip(_needed(cfg.scale.partner, "scale.partner", method, "the other camera's images"))
            stack.callback(other.close)
            options["partner"] = other
            options["baseline"] = _needed(cfg.scale.baseline, "scale.baseline", method, "meters to the right camera")
        yield clip_batches(clip, predictor.height, predictor.width, count=clip.declared, **options)


def _pose(cfg: DictConfig) -> tuple[Any, Any]:
    from saunet.weights.files import read_model

    checkpoint = read_model(cfg.checkpoint)
    pose = checkpoint.networks()[1]
    return (None, ()) if pose is None else (pose.eval(), checkpoint.record.offsets)


def _check(cfg: DictConfig) -> str:
    from saunet.scale import METHODS
    from saunet.weights.locate import shipped

    method = one_of("scale.method", cfg.scale.method, SCALE_METHODS)
    positive("scale.frames", cfg.scale.frames)
    if cfg.scale.fps is not None:
        positive("scale.fps", cfg.scale.fps)
    if cfg.scale.store and method not in METHODS:
        raise ConfigError(
            f"scale.store=true stores what is measured and scale.method is '{method}'; "
            f"set scale.method to one of {', '.join(METHODS)}"
        )
    if cfg.scale.store and cfg.checkpoint in shipped():
        raise ConfigError(
            f"scale.store=true writes into the checkpoint, but '{cfg.checkpoint}' comes with saunet and stays as it "
            "is; leave scale.store out"
        )
    return method


def _chosen(method: str, scale: Any) -> Any:
    if method == "none":
        return None
    if method == "stored" and scale is None:
        raise ConfigError(
            "scale.method=stored and the checkpoint stores no scale; measure one, "
            "such as with scale.method=camera_height, and keep it with scale.store=true"
        )
    return scale


def _needed(value: Any, key: str, method: str, what: str) -> Any:
    if value is None:
        raise ConfigError(f"scale.method={method} needs {key}: {what}")
    return value


def _report(cfg: DictConfig, estimate: Any, folder: Path) -> Any:
    from saunet.io.atomic import write_json
    from saunet.runs.checkpoint import store_scale

    print(estimate)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "scale.json", estimate.as_json())
    scale = estimate.scale()
    if cfg.scale.store:
        store_scale(cfg.checkpoint, scale)
        print(f"stored in {cfg.checkpoint}")
    return scale
