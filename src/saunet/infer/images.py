"""Images from and to disk: whatever a camera or a user hands over becomes RGB bytes; files are written whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Shaped, UInt8
from numpy.typing import NDArray

from saunet.atomic import write_bytes
from saunet.checks import DataError, one_of

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})
"""File name endings that are taken for images when a folder is read."""


def read_image(path: str | Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as RGB bytes.

    Grey images get three equal channels, 16-bit ones are scaled so that white stays white, transparency is dropped,
    and the camera's EXIF rotation is applied.

    Raises:
        DataError: naming the file, if it is missing, empty, broken or not an image.
    """
    path = Path(path)
    if path.is_dir():
        raise DataError(f"{path} is a folder where an image file is needed")
    try:
        data = np.fromfile(path, dtype=np.uint8)  # not imread: it cannot open every unicode path on every system
    except FileNotFoundError as reason:
        raise DataError(f"no image at {path}; check the path") from reason
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    return decode_image(data, str(path))


def decode_image(data: UInt8[np.ndarray, " n"], name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Decode an encoded image as `read_image` does.

    Args:
        data: The bytes of the file.
        name: What to call it in messages.

    Raises:
        DataError: if the bytes are empty, incomplete or not an image.
    """
    if data.size == 0:
        raise DataError(f"{name} is empty (0 bytes); copy it again")
    if not _complete(data.tobytes()):
        raise DataError(f"{name} is truncated: the end of the image is missing; copy it again")
    try:
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error as reason:
        raise DataError(f"{name} cannot be decoded: {str(reason).strip().splitlines()[-1]}") from reason
    if image is None:
        raise DataError(f"{name} is not an image that OpenCV can read, or is damaged; convert it to PNG or JPEG")
    return as_rgb_bytes(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), name)


def as_rgb_bytes(image: Shaped[np.ndarray, "..."], name: str = "the image") -> UInt8[np.ndarray, "h w 3"]:
    """Return an image array as h x w x 3 bytes: grey is repeated, a fourth channel dropped, 16 bits scaled down.

    Raises:
        DataError: for another shape, an empty image, or numbers that are neither 8 nor 16 bits.
    """
    if image.ndim == 2:
        image = image[:, :, None]
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4) or image.size == 0:
        raise DataError(f"{name} has shape {image.shape}; it must be h x w, h x w x 1, h x w x 3 (RGB) or h x w x 4")
    image = image[:, :, :3] if image.shape[2] > 1 else np.repeat(image, 3, axis=2)
    if image.dtype == np.uint16:
        image = np.round(image / 257.0).astype(np.uint8)
    if image.dtype != np.uint8:
        raise DataError(
            f"{name} has numbers of type {image.dtype}; it must be 8-bit or 16-bit unsigned (0 to 255 or 65535)"
        )
    return np.ascontiguousarray(image)


def resize(array: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """Resize h x w or h x w x c, averaging areas when it shrinks and interpolating linearly when it grows."""
    if array.shape[:2] == (height, width):
        return array
    shrinks = height <= array.shape[0] and width <= array.shape[1]
    return cv2.resize(array, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def network_input(
    image: UInt8[np.ndarray, "_ _ 3"], height: int, width: int
) -> Float32[np.ndarray, "3 {height} {width}"]:
    """Resize an RGB image to a network's input size and return it as channels of floats in [0, 1]."""
    resized = resize(image, height, width).astype(np.float32)
    return np.ascontiguousarray(resized.transpose(2, 0, 1) / np.float32(255))


def write_image(path: str | Path, image: Shaped[np.ndarray, "..."]) -> None:
    """Write RGB or grey bytes, or 16-bit grey, in the format of the path's suffix, whole or not at all.

    Raises:
        ConfigError: if the suffix is not that of an image format.
        DataError: if the format cannot hold the numbers or the system refuses to write.
    """
    path = Path(path)
    one_of(f"the suffix of {path.name}", path.suffix.lower(), sorted(IMAGE_SUFFIXES))
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    try:
        done, data = cv2.imencode(path.suffix.lower(), bgr)
    except cv2.error as reason:
        raise DataError(f"cannot encode {path}: {str(reason).strip().splitlines()[-1]}") from reason
    if not done:
        raise DataError(f"cannot encode {path}: {path.suffix} does not hold {image.dtype} of shape {image.shape}")
    write_bytes(path, data.tobytes())


def _complete(data: bytes) -> bool:
    """Return False for a PNG or JPEG whose end is missing; decoders paint the rest grey, some without a word."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")
    return True
