"""Straight pictures for prediction: ``rectify=camera.yaml`` undistorts and crops as training on clips does."""

from __future__ import annotations

import hashlib
from typing import Any

from omegaconf import DictConfig

from saunet.errors import ConfigError


def rectify(cfg: DictConfig, predictor: Any) -> Any:
    """Make a predictor straighten its images, and return their `Camera` where it is known; None without ``rectify``.

    Args:
        cfg: The root of ``saunet predict``.
        predictor: An `ImagePredictor`.

    Raises:
        ConfigError: if it does not go with other settings.
        DataError: if the camera file cannot be read.
    """
    if not cfg.rectify:
        return None
    from saunet.data.video.camera_file import read_camera
    from saunet.data.video.lens import Straightener
    from saunet.prediction.pointcloud import Camera
    from saunet.scale import METHODS

    if cfg.scale.method in METHODS:
        raise ConfigError(
            f"scale.method={cfg.scale.method} measures on the images as they are, so it does not go with rectify; "
            "measure with saunet evaluate data=video scale.store=true first"
        )
    if cfg.camera is not None:
        raise ConfigError("camera and rectify are both set; the camera file has the intrinsics, leave camera out")
    camera = read_camera(cfg.rectify)
    predictor.straighten = straightener = Straightener(camera)
    predictor.straightened_by = f"camera {hashlib.sha256(camera.path.read_bytes()).hexdigest()[:16]}"
    if camera.image_size is None:
        return None
    lens = straightener.lens(*camera.image_size)
    return Camera(lens.K, lens.height, lens.width)
