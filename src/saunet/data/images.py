"""Frames and depth maps from disk; a broken file is named, never passed on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.checks import DataError

_ENDINGS = {b"\x89PNG": (b"IEND", 16), b"\xff\xd8": (b"\xff\xd9", 4096)}
"""First bytes of a format -> the bytes that end a whole file, and how far from its end they are looked for."""


def read_bytes(path: Path) -> NDArray[np.uint8]:
    """Return the content of a file that should not be empty.

    Raises:
        DataError: if it is missing, empty or not readable.
    """
    try:
        data = np.fromfile(path, np.uint8)
    except FileNotFoundError as reason:
        raise DataError(f"no file at {path}; check the data root or copy the file again") from reason
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror or reason}") from reason
    if data.size == 0:
        raise DataError(f"{path} is empty (0 bytes); copy the file again")
    return data


def decode(path: Path, flags: int) -> NDArray[Any]:
    """Read and decode an image file with OpenCV's flags.

    Raises:
        DataError: if it is missing, empty, cut off or not an image.
    """
    data = read_bytes(path)
    head = data[:4].tobytes()
    for start, (end, within) in _ENDINGS.items():
        if head.startswith(start) and end not in data[-within:].tobytes():
            raise DataError(f"{path} is cut off ({data.size} bytes, its end is missing); copy the file again")
    try:
        image = cv2.imdecode(data, flags)
    except cv2.error as reason:
        raise DataError(f"{path} cannot be decoded: {str(reason).strip().splitlines()[-1]}") from reason
    if image is None:
        raise DataError(f"{path} is damaged or not an image ({data.size} bytes); copy the file again")
    return np.asarray(image)


def read_image(path: Path) -> NDArray[np.uint8]:
    """Return a frame as RGB, h x w x 3; grey frames get three equal channels.

    Raises:
        DataError: if it is missing, empty, cut off or not an image.
    """
    return np.asarray(cv2.cvtColor(decode(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_depth(path: Path) -> NDArray[np.float32]:
    """Return a depth map stored as KITTI does: 16-bit PNG, 256 a metre, 0 where unknown.

    Raises:
        DataError: if it is missing, broken or not a 16-bit image.
    """
    stored = decode(path, cv2.IMREAD_UNCHANGED)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise DataError(
            f"{path} holds {stored.dtype} of shape {stored.shape}; a depth map is one channel of 16-bit numbers"
        )
    return np.asarray(stored / np.float32(256), dtype=np.float32)


def image_size(path: Path) -> tuple[int, int]:
    """Return (height, width) of an image; a PNG is not decoded for that.

    Raises:
        DataError: if it is missing, empty or not an image.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(24)
    except OSError:
        head = b""
    if head[:8] == b"\x89PNG\r\n\x1a\n" and head[12:16] == b"IHDR" and len(head) == 24:
        return int.from_bytes(head[20:24], "big"), int.from_bytes(head[16:20], "big")
    shape = decode(path, cv2.IMREAD_GRAYSCALE).shape
    return shape[0], shape[1]
