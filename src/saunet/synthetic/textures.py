"""Filtered lookup of materials: detail at every distance, and no shimmer between frames.

Pictures are stored as ripmaps, averaged beforehand by powers of two along u and v independently, and looked up at the
size of a pixel's footprint.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.synthetic.materials import MAKERS, MATERIALS
from saunet.synthetic.noise import SIZE, colored_noise

F32 = NDArray[np.float32]

_LEVELS = SIZE.bit_length()  # 256, 128, ..., 1
_WIDTHS = np.array([SIZE >> level for level in range(_LEVELS)])
_STARTS = np.concatenate([[0], np.cumsum(_WIDTHS + 2)[:-1]])
_SIDE = int((_WIDTHS + 2).sum())
_BRIGHT = 127.5  # stored value of luminance 1, so that luminance reaches 2
_ROW = 512  # the flat list of samples is looked up in rows of this length


@functools.cache
def atlas() -> NDArray[np.uint8]:
    """Return the ripmaps of all materials, h x w x 2, their squares below each other; channels luminance and mask."""
    stacked = np.zeros((len(MATERIALS), _SIDE, _SIDE, 2), np.float32)
    for number, (name, make) in enumerate(MAKERS.items()):
        picture = np.moveaxis(make(np.random.default_rng([7, *name.encode()])), 0, -1)
        picture = np.clip(picture * (_BRIGHT, 255.0), 0, 255).astype(np.float32)
        for row in range(_LEVELS):
            level = picture
            for column in range(_LEVELS):
                padded = np.pad(level, ((1, 1), (1, 1), (0, 0)), mode="wrap")
                y, x = _STARTS[row], _STARTS[column]
                stacked[number, y : y + padded.shape[0], x : x + padded.shape[1]] = padded
                level = (level[:, 0::2] + level[:, 1::2]) / 2 if level.shape[1] > 1 else level
            picture = (picture[0::2] + picture[1::2]) / 2 if picture.shape[0] > 1 else picture
    return np.rint(stacked).astype(np.uint8).reshape(-1, _SIDE, 2)


@functools.cache
def _grain() -> F32:
    """Mipmap levels of a periodic noise that varies surfaces at every scale, padded, side by side."""
    rng = np.random.default_rng(11)
    picture = np.clip(colored_noise(rng, 2, 128, 1.0), -2.5, 2.5).astype(np.float32)
    levels = np.zeros((SIZE + 2, _SIDE), np.float32)
    for start in _STARTS:
        padded = np.pad(picture, 1, mode="wrap")
        levels[: padded.shape[0], start : start + padded.shape[1]] = padded
        if picture.shape[0] > 1:
            four = (picture[i::2, j::2] for i in (0, 1) for j in (0, 1))
            picture = np.mean(list(four), axis=0, dtype=np.float32)
    return levels


def _remap(picture: NDArray[np.uint8] | F32, x: F32, y: F32) -> F32:
    """Look a picture up bilinearly at a flat list of positions (a multiple of `_ROW` long)."""
    shape = (-1, _ROW)
    found = cv2.remap(picture, x.reshape(shape), y.reshape(shape), cv2.INTER_LINEAR)
    return np.asarray(found.reshape(x.size, *picture.shape[2:]), np.float32)


def _padded(*arrays: F32) -> list[F32]:
    length = -(-arrays[0].size // _ROW) * _ROW
    return [np.pad(a.astype(np.float32, copy=False), (0, length - a.size), mode="edge") for a in arrays]


def _level(footprint: F32) -> tuple[NDArray[np.intp], F32]:
    exact = np.log2(np.clip(footprint * SIZE, 1.0, SIZE * 0.999))
    whole = exact.astype(np.intp)
    return whole, (exact - whole).astype(np.float32)


def _position(texture: F32, level: NDArray[np.intp]) -> F32:
    starts, widths = _STARTS.astype(np.float32) + 0.5, _WIDTHS.astype(np.float32)
    return starts[level] + texture * widths[level]


def sample(material: F32, u: F32, v: F32, du: F32, dv: F32) -> tuple[F32, F32]:
    """Look materials up, averaged over each sample's footprint."""
    count = u.size
    if count == 0:
        return u, v
    material, u, v, du, dv = _padded(material, u, v, du, dv)
    level_u, blend_u = _level(du)
    level_v, blend_v = _level(dv)
    u, v = u - np.floor(u), v - np.floor(v)
    left, right = _position(u, level_u), _position(u, level_u + 1)
    offset = material * np.float32(_SIDE)
    upper, lower = _position(v, level_v) + offset, _position(v, level_v + 1) + offset
    fine_u, fine_v = (1 - blend_u)[:, None], (1 - blend_v)[:, None]
    picture = atlas()
    top = _remap(picture, left, upper) * fine_u + _remap(picture, right, upper) * (1 - fine_u)
    bottom = _remap(picture, left, lower) * fine_u + _remap(picture, right, lower) * (1 - fine_u)
    both = np.asarray(top * fine_v + bottom * (1 - fine_v), np.float32)[:count]
    return both[:, 0] / np.float32(_BRIGHT), both[:, 1] / np.float32(255)


def grain(u: F32, v: F32, footprint: F32) -> F32:
    """Look up the noise that varies every surface, mean 0, deviation about 1 near by and fading with distance."""
    count = u.size
    if count == 0:
        return u
    u, v, footprint = _padded(u, v, footprint)
    level, blend = _level(footprint)
    u, v = u - np.floor(u), v - np.floor(v)
    rows = _WIDTHS.astype(np.float32)
    fine = _remap(_grain(), _position(u, level), v * rows[level] + np.float32(0.5))
    coarse = _remap(_grain(), _position(u, level + 1), v * rows[level + 1] + np.float32(0.5))
    return (fine * (1 - blend) + coarse * blend)[:count].astype(np.float32, copy=False)
