"""The only reader, writer and resize of images, so that a model gets the same in use as in training."""

from __future__ import annotations

import contextlib
import functools
import logging
import re
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Shaped, UInt8
from numpy.typing import NDArray

from saunet.errors import DataError, UnreadableError, one_of
from saunet.io.atomic import write_bytes

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm"})
"""File name endings that count as images in a folder."""

_NUMBER = re.compile(r"(\d{9,}\.\d+|\d+)", re.ASCII)
"""A number in a name; with decimals only where they are those of a time, in seconds since 1970."""


_ZEROS = str.maketrans("123456789", "000000000")
_DEFLATE = 1032
"""The most that PNG's compression can shrink: 258 bytes to two bits."""


def natural_order(name: str | Path) -> tuple[list[tuple[int, int | Fraction, str]], str]:
    """Return the key that sorts names of files by the numbers in them: ``frame_2`` before ``frame_10``."""
    parts: list[tuple[int, int | Fraction, str]] = [
        (0, Fraction(part) if "." in part else int(part), "") if index % 2 else (1, 0, part)
        for index, part in enumerate(_NUMBER.split(str(name)))
    ]
    return parts, str(name)  # the name decides between frame_1 and frame_01, whose numbers are equal


def name_times(names: Sequence[str]) -> list[float] | None:
    """Return the seconds that names of frames (without ending) state; None if they are not time stamps.

    Read are decimal seconds (``12.25``) and, behind the same text in every name, Unix time in seconds, milliseconds,
    microseconds or nanoseconds (``cam0_1403636579763555584``).
    """
    if len(names) > 1 and name_times(names[:1]) is None:
        return None
    found = [re.fullmatch(r"(.*?)(\d+)(\.\d+)?", name) for name in names]
    parts = [(match[1], match[2], (match[3] or ".")[1:]) for match in found if match]
    if len(parts) < max(1, len(names)) or len({prefix for prefix, _, _ in parts}) > 1:
        return None
    unix = {len(whole) for _, whole, _ in parts} in ({10}, {13}, {16}, {19})
    if unix and all("1" <= whole[0] < "2" for _, whole, _ in parts):
        times = [float(f"{whole[:10]}.{whole[10:]}{decimals}") for _, whole, decimals in parts]
    elif all(decimals and not prefix for prefix, _, decimals in parts):
        times = [float(name) for name in names]
    else:
        return None
    return times if len(set(times)) == len(times) else None


def frame_order(names: Sequence[str]) -> list[int]:
    """Return the order of frames in time: by the time stamps in their names, else by the numbers in them."""
    times = name_times([name.rpartition(".")[0] for name in names])
    alike = len({name.translate(_ZEROS) for name in names}) < 2  # same pattern of digits: sorts as text
    keys: Sequence[Any] = times or (names if alike else [natural_order(name) for name in names])
    return sorted(range(len(names)), key=keys.__getitem__)


def read_bytes(path: str | Path) -> UInt8[np.ndarray, " n"]:
    """Return the content of a file that should not be empty."""
    path = Path(path)
    try:
        data = np.fromfile(path, np.uint8)  # cv2.imread cannot open every Unicode path on every system
    except FileNotFoundError as reason:
        raise DataError(f"no file at {path}; check the path or copy the file again") from reason
    except IsADirectoryError as reason:
        raise DataError(f"{path} is a folder, but a file is needed") from reason
    except OSError as reason:
        raise UnreadableError(f"cannot read {path}: {reason.strerror or reason}") from reason
    if data.size == 0:
        raise UnreadableError(f"{path} is empty (0 bytes); copy the file again")
    return data


def read_image(path: str | Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as RGB bytes.

    Gray images get three equal channels. 16-bit images are scaled by the bits that the images of their folder use (16,
    12 or 10), so that white stays white. Transparency is dropped, and the camera's EXIF rotation is applied.
    """
    image = _decode(path, _COLOR)
    bits = 8
    if image.dtype == np.uint16:
        bits = max(_folder_bits(Path(path).resolve().parent, Path(path).suffix.lower()), _bits(image))
    return as_rgb_bytes(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), str(path), bits)


def decode_image(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Return the content of an image file of 8 bits as `read_image` does; ``name`` is for messages."""
    return as_rgb_bytes(cv2.cvtColor(_decoded(np.frombuffer(data, np.uint8), name, _COLOR), cv2.COLOR_BGR2RGB), name, 8)


def read_depth(path: str | Path, steps: float | int = 256) -> Float32[np.ndarray, "h w"]:
    """Return a depth map stored as 16-bit PNG, 0 where unknown, with so many steps per meter (KITTI's 256)."""
    stored = read_unchanged(path)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise DataError(
            f"{path} holds {stored.dtype} of shape {stored.shape}; a depth map is one channel of 16-bit numbers"
        )
    return np.asarray(stored / np.float32(steps), dtype=np.float32)


def read_unchanged(path: str | Path) -> NDArray[Any]:
    """Return the numbers of an image file as stored: h x w, or h x w x channels in OpenCV's order (BGR, BGRA)."""
    return _decode(path, cv2.IMREAD_UNCHANGED)


def image_size(path: str | Path) -> tuple[int, int]:
    """Return (height, width) of an image as `read_image` gives it, without decoding a PNG that is not rotated."""
    data = read_bytes(path).tobytes()
    # In a PNG, the EXIF rotation may come before or after the picture.
    if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR" and len(data) >= 24 and b"eXIf" not in data:
        return int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big")
    shape = _decode(path, cv2.IMREAD_GRAYSCALE).shape
    return shape[0], shape[1]


def read_jpeg(path: str | Path) -> tuple[bytes, bytes]:
    """Return the content of a whole JPEG, and the four bytes of its height and width as stored.

    Nothing and nothing for a file of another kind and one that `read_image` does not read.
    """
    try:
        with open(path, "rb", buffering=0) as stream:
            data = stream.read()
    except OSError:
        return b"", b""
    size = _jpeg_size(data)
    return (data, size) if size and _complete(data) else (b"", b"")


def quick_look(jpeg: bytes, stored: int, width: int) -> UInt8[np.ndarray, "h w"] | None:
    """Return a JPEG, ``stored`` pixels wide, as a gray picture at 1/8, 1/4 or 1/2 of its size, at least ``width`` wide.

    The codec leaves out the fine frequencies, which takes half of the time or less. None for a narrower one and one
    that `read_image` does not read.
    """
    fitting = [flag for shrink, flag in _REDUCED.items() if stored >= shrink * width]
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), fitting[0]) if fitting else None


_REDUCED = {
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8,
    4: cv2.IMREAD_REDUCED_GRAYSCALE_4,
    2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
}


def _jpeg_size(data: bytes) -> bytes:
    """Return the four bytes of height and width of a JPEG; none if the content does not begin as that of one."""
    at = 2
    while data[:2] == b"\xff\xd8" and data[at : at + 1] == b"\xff" and at + 9 <= len(data):
        if 0xC0 <= data[at + 1] <= 0xCF and data[at + 1] not in (0xC4, 0xC8, 0xCC):
            return data[at + 5 : at + 9]
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
    return b""


def as_rgb_bytes(
    image: Shaped[np.ndarray, "..."], name: str = "the image", bits: int | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image array as h x w x 3 bytes: gray is repeated, a fourth channel dropped, 16 bits scaled down."""
    if image.ndim == 2:
        image = image[:, :, None]
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4) or image.size == 0:
        raise DataError(f"{name} has shape {image.shape}; it must be h x w, h x w x 1, h x w x 3 (RGB) or h x w x 4")
    image = image[:, :, :3] if image.shape[2] > 1 else np.repeat(image, 3, axis=2)
    if image.dtype == np.uint16:
        white = 2 ** (bits or _bits(image)) - 1
        image = np.round(image / (white / 255.0)).clip(0, 255).astype(np.uint8)
    if image.dtype != np.uint8:
        raise DataError(
            f"{name} has numbers of type {image.dtype}; it must be 8-bit or 16-bit unsigned (0 to 255 or 65535)"
        )
    return np.ascontiguousarray(image)


_COLOR = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
_SAMPLED = 8  # number of images of a folder in which to look for the bits in use


def _bits(image: NDArray[Any]) -> int:
    """Return how many of 16 bits an image uses: sensors of 10 or 12 bits leave the upper ones 0."""
    brightest = int(image.max()) if image.dtype == np.uint16 and image.size else 0
    return 10 if 0 < brightest < 2**10 else 12 if 0 < brightest < 2**12 else 16


@functools.cache
def _folder_bits(folder: Path, suffix: str) -> int:
    """Return the bits that a folder's 16-bit images use, by some of them, so that all are scaled alike; say it once."""
    beside = sorted((path for path in folder.iterdir() if path.suffix.lower() == suffix), key=natural_order)
    bits = 10
    for index in np.unique(np.linspace(0, len(beside) - 1, _SAMPLED).astype(int)):
        with contextlib.suppress(DataError):
            image = _decode(beside[index], _COLOR)
            bits = max(bits, _bits(image)) if image.dtype == np.uint16 else bits
    if bits < 16:
        logging.getLogger(__name__).warning(
            "%s: 16-bit images that use %d bits, as from %d-bit sensors, so %d is white",
            folder, bits, bits, 2**bits - 1,
        )  # fmt: skip
    return bits


def resize(array: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """Resize h x w or h x w x c, averaging areas when it shrinks and interpolating linearly when it grows.

    Pixel u moves to (u + 0.5) * s - 0.5. An array that already has the size is returned itself.
    """
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


def encode_jpeg(image: UInt8[np.ndarray, "h w 3"], quality: int = 95) -> bytes:
    """Return an RGB image as the bytes of a JPEG file; quality 1 to 100."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done, "an image in memory of a size that JPEG holds"
    return bytes(data.tobytes())


def encode_png(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Return an RGB image as the bytes of a PNG file."""
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    assert done, "an image in memory"
    return bytes(data.tobytes())


def write_image(path: str | Path, image: Shaped[np.ndarray, "..."]) -> None:
    """Write RGB or gray bytes, or 16-bit gray, in the format of the path's suffix, whole or not at all."""
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


def _decode(path: str | Path, flags: int) -> NDArray[Any]:
    """Read and decode an image file with OpenCV's flags, refusing what is not whole."""
    return _decoded(read_bytes(path), path, flags)


def _decoded(data: UInt8[np.ndarray, " n"], path: str | Path, flags: int) -> NDArray[Any]:
    if not _complete(data.tobytes()):
        raise UnreadableError(
            f"{path} is truncated ({data.size} bytes, the end of the image is missing); copy it again"
        )
    if (claimed := _claimed_bytes(data[:26].tobytes())) > _DEFLATE * data.size:  # decoders would allocate it first
        raise UnreadableError(
            f"{path} is damaged: its header claims {claimed} bytes of pixels, too many for {data.size} bytes; copy "
            "it again"
        )
    try:
        image = cv2.imdecode(data, flags)
    except cv2.error as reason:
        raise UnreadableError(f"{path} cannot be decoded: {str(reason).strip().splitlines()[-1]}") from reason
    if image is None:
        raise UnreadableError(
            f"{path} is not an image that OpenCV can read, or is damaged ({data.size} bytes); copy it again or "
            "convert it to PNG or JPEG"
        )
    return np.asarray(image)


def _claimed_bytes(head: bytes) -> int:
    """Return how many bytes of pixels the header of a PNG promises; 0 for other formats."""
    if head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR" or len(head) < 26:
        return 0
    width, height = (int.from_bytes(head[start : start + 4], "big") for start in (16, 20))
    channels = {2: 3, 4: 2, 6: 4}.get(head[25], 1)
    return height * (width * channels * head[24] // 8)


def _complete(data: bytes) -> bool:
    """Return False for a PNG or JPEG whose end is missing; decoders paint the rest gray, some without a word.

    The end is looked for from behind and anywhere: cameras and editors append data of their own after it.
    """
    if data.startswith(b"\x89PNG"):
        at = 8
        while at < len(data) and data[at + 4 : at + 8] != b"IEND":  # a decoder allocates whatever length a chunk claims
            at += 12 + int.from_bytes(data[at : at + 4], "big")
        return at < len(data)
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")
    return True
