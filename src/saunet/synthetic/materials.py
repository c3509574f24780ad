"""The materials, from asphalt to the ends of cars: painted as periodic pictures, and looked up at any distance.

A picture has two channels: luminance (1 = the surface's own color) and a mask that blends between the surface's two
colors (wall and window, grass and earth). Positions and sizes are fractions of the period, y downwards.

So that nothing shimmers between frames, pictures are stored as ripmaps, averaged beforehand by powers of two along u
and v independently, and looked up at the size of a pixel's footprint.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE = 256  # pixels of one period of a material, a power of two
WINDOWS, FLOORS = 4, 2
"""Windows and floors in one period of a facade picture."""
_OPENINGS = {
    "sash": (0.28, 0.72, 0.24, 0.78),
    "tall": (0.32, 0.68, 0.14, 0.90),
    "ribbon": (0.03, 0.97, 0.30, 0.72),
    "panel": (0.12, 0.88, 0.16, 0.80),
}
"""Left, right, top and bottom of a window as fractions of its cell."""

F32 = NDArray[np.float32]
Canvas = NDArray[np.float64]
"""2 x SIZE x SIZE: luminance and mask."""
Number = float | int
"""Whole numbers are welcome; a checker at run time takes ``float`` at its word."""


def _blank(luminance: Number = 1.0, mask: Number = 0.0) -> Canvas:
    canvas = np.empty((2, SIZE, SIZE))
    canvas[0], canvas[1] = luminance, mask
    return canvas


def colored_noise(rng: np.random.Generator, low: Number, high: Number, slope: Number) -> NDArray[np.float64]:
    """Return periodic noise, n x n, Gaussian of mean 0 and deviation 1, within ``low``..``high`` cycles a period."""
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None]) * SIZE
    inside = (frequency >= low) & (frequency <= high)
    gain = np.where(inside, np.maximum(frequency, 1.0) ** -slope, 0.0)
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * gain, (SIZE, SIZE))
    return np.asarray(field / field.std())


def coverage(start: Number, end: Number) -> NDArray[np.float64]:
    """Return how much of each of the n pixels of a row an interval covers; fractions of a period, wrapping around."""
    pixel = np.arange(-SIZE, 2 * SIZE, dtype=np.float64)
    covered = np.clip(np.minimum(pixel + 1, end * SIZE) - np.maximum(pixel, start * SIZE), 0, 1)
    return np.asarray(covered.reshape(3, SIZE).sum(axis=0).clip(0, 1))


def _rectangle(canvas: Canvas, x0: Number, x1: Number, y0: Number, y1: Number, luminance: Number, mask: Number) -> None:
    alpha = coverage(y0, y1)[:, None] * coverage(x0, x1)[None]
    rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
    if rows.size == 0 or columns.size == 0:
        return
    index = np.ix_(rows, columns)
    part = alpha[index]
    for channel, value in zip(canvas, (luminance, mask), strict=True):
        channel[index] += part * (value - channel[index])


def _disc(canvas: Canvas, x: Number, y: Number, radius: Number, luminance: Number, mask: Number) -> None:
    center = (np.arange(SIZE) + 0.5) / SIZE
    distance = np.hypot(center[None] - x, center[:, None] - y)
    alpha = np.clip((radius - distance) * SIZE + 0.5, 0, 1)
    canvas[0] += alpha * (luminance - canvas[0])
    canvas[1] += alpha * (mask - canvas[1])


def _laid(
    canvas: Canvas, rng: np.random.Generator, columns: int, rows: int, spread: float, mask: float, bond: float = 0.0
) -> Iterator[tuple[float, float]]:
    """Paint stones of differing color row by row, and yield the corner of each; ``bond`` shifts every second row."""
    for row in range(rows):
        for column in range(columns):
            x, y = (column + bond * (row % 2)) / columns, row / rows
            color = 1 + spread * rng.standard_normal(), rng.uniform(0, mask)
            _rectangle(canvas, x, x + 1 / columns, y, y + 1 / rows, *color)
            yield x, y


Band = tuple[Number, Number, Number, Number]
"""Strength, lowest and highest cycles a period, and slope of a noise."""


def _noise(luminance: tuple[Band, ...], mask: float, spots: Band) -> Callable[[np.random.Generator], Canvas]:
    def paint(rng: np.random.Generator) -> Canvas:
        canvas = _blank()
        canvas[0] += sum(strength * colored_noise(rng, *band) for strength, *band in luminance)
        canvas[1] = np.clip(mask + spots[0] * colored_noise(rng, *spots[1:]), 0, 1)
        return canvas

    return paint


def _paving(rng: np.random.Generator) -> Canvas:
    canvas = _blank()
    for x, y in _laid(canvas, rng, 8, 8, 0.13, 0.8):
        _rectangle(canvas, x, x + 1 / 8, y, y + 0.012, 0.6, 0.5)
        _rectangle(canvas, x, x + 0.012, y, y + 1 / 8, 0.6, 0.5)
    canvas[0] += 0.07 * colored_noise(rng, 4, 128, 0.3)
    return canvas


def _kerb(rng: np.random.Generator) -> Canvas:
    canvas = _blank()
    for x, _ in _laid(canvas, rng, 4, 1, 0.12, 0.5):
        _rectangle(canvas, x, x + 0.01, 0, 1, 0.5, 0.5)
    canvas[0] += 0.08 * colored_noise(rng, 4, 128, 0.4)
    return canvas


def _foliage(rng: np.random.Generator) -> Canvas:
    canvas = _blank()
    lumps = colored_noise(rng, 3, 20, 0.5)
    canvas[0] = 0.95 + 0.30 * lumps + 0.24 * colored_noise(rng, 16, 100, 0.3)
    canvas[1] = np.clip(0.4 + 0.3 * lumps + 0.3 * colored_noise(rng, 4, 60, 0.5), 0, 1)
    return canvas


def _brick(rng: np.random.Generator) -> Canvas:
    canvas = _blank()
    for x, y in _laid(canvas, rng, 8, 20, 0.16, 0.7, bond=0.5):
        _rectangle(canvas, x, x + 0.014, y, y + 1 / 20, 1.25, 0.9)
    for row in range(20):
        _rectangle(canvas, 0, 1, row / 20, row / 20 + 0.012, 1.25, 0.9)
    canvas[0] += 0.06 * colored_noise(rng, 2, 128, 0.5)
    return canvas


def _roof(rng: np.random.Generator) -> Canvas:
    canvas = _blank()
    list(_laid(canvas, rng, 12, 12, 0.14, 0.8, bond=0.5))
    for row in range(12):
        _rectangle(canvas, 0, 1, row / 12, row / 12 + 0.02, 0.62, 0.5)
    canvas[0] += 0.06 * colored_noise(rng, 2, 100, 0.5)
    return canvas


def _planks(rng: np.random.Generator) -> Canvas:
    canvas = _blank()
    for x, _ in _laid(canvas, rng, 16, 1, 0.16, 0.8):
        _rectangle(canvas, x, x + 0.01, 0, 1, 0.4, 0.5)
    for y in (0.2, 0.75):
        _rectangle(canvas, 0, 1, y, y + 0.06, 0.8, 0.5)
    canvas[0] += 0.07 * colored_noise(rng, 2, 100, 0.4)
    return canvas


def _bands(rng: np.random.Generator) -> Canvas:
    """Bark, weathered metal: variation along v, little along u."""
    canvas = _blank()
    profile = colored_noise(rng, 2, 60, 0.5)[:, :1]
    canvas[0] += 0.16 * profile + 0.12 * colored_noise(rng, 4, 100, 0.4)
    canvas[1] = np.clip(0.4 + 0.4 * colored_noise(rng, 1, 20, 0.5), 0, 1)
    return canvas


def _glass(rng: np.random.Generator) -> Canvas:
    canvas = _blank()
    canvas[0] = 1.25 - 0.6 * np.linspace(0, 1, SIZE)[:, None] + 0.2 * colored_noise(rng, 1, 24, 0.5)
    for x in (0.0, 0.49):  # pillars and what is behind the window
        _rectangle(canvas, x, x + 0.05, 0, 1, 0.3, 0.8)
        _rectangle(canvas, x + 0.14, x + 0.28, 0.3, 1.0, 0.45, 0.3)
    return canvas


def _poster(rng: np.random.Generator) -> Canvas:
    canvas = _blank()
    for _ in range(40):
        x, y = rng.uniform(0, 0.8, 2)
        width, height = rng.uniform(0.03, 0.3, 2)
        _rectangle(canvas, x, x + width, y, y + height, rng.uniform(0.4, 1.7), rng.uniform(0, 1))
    return canvas


def _facade(rng: np.random.Generator, style: str) -> Canvas:
    """`WINDOWS` x `FLOORS` windows with frames, sills and blinds on a wall; the mask is 1 on glass."""
    canvas = _blank()
    canvas[0] += 0.05 * colored_noise(rng, 1, 16, 0.8) + 0.05 * colored_noise(rng, 16, 128, 0.2)
    courses = {"sash": 64, "tall": 16, "ribbon": 0, "panel": 4}[style]
    for course in range(courses):
        _rectangle(canvas, 0, 1, course / courses, course / courses + 0.006, 0.86, 0.0)
    left, right, top, bottom = _OPENINGS[style]
    for floor in range(FLOORS):
        if style in ("tall", "panel"):
            _rectangle(canvas, 0, 1, floor / FLOORS, (floor + 0.05) / FLOORS, 1.25, 0.0)
        for number in range(WINDOWS):
            x, y = number / WINDOWS, floor / FLOORS
            if style == "panel":
                _rectangle(canvas, x, x + 0.012, y, y + 1 / FLOORS, 0.7, 0.0)
            x0, x1 = x + left / WINDOWS, x + right / WINDOWS
            y0, y1 = y + top / FLOORS, y + bottom / FLOORS
            _rectangle(canvas, x0 - 0.012, x1 + 0.012, y0 - 0.016, y1 + 0.016, 1.35, 0.12)
            _rectangle(canvas, x0, x1, y0, y1, rng.uniform(0.5, 1.1), 1.0)
            _rectangle(canvas, x0, x1, y0, y0 + 0.25 * (y1 - y0), rng.uniform(0.7, 1.3), 1.0)
            blind = rng.uniform(0, 1)
            if blind < 0.45:  # a blind or curtain in the wall's color
                _rectangle(canvas, x0, x1, y0, y0 + blind * 2 * (y1 - y0), rng.uniform(0.8, 1.4), 0.25)
            if rng.uniform() < 0.3:
                _rectangle(canvas, x0, x0 + 0.3 * (x1 - x0), y0, y1, 1.2, 0.3)
            middle = (x0 + x1) / 2
            _rectangle(canvas, middle - 0.005, middle + 0.005, y0, y1, 1.3, 0.1)
            _rectangle(canvas, x0 - 0.02, x1 + 0.02, y1 + 0.012, y1 + 0.035, 1.5, 0.05)
    return canvas


def _shop(rng: np.random.Generator) -> Canvas:
    """A ground floor: shop windows, doors, sign boards."""
    canvas = _blank(0.9)
    canvas[0] += 0.05 * colored_noise(rng, 4, 100, 0.3)
    for number in range(3):
        x = number / 3
        _rectangle(canvas, x + 0.01, x + 0.32, 0.05, 0.2, rng.uniform(0.6, 1.7), rng.uniform(0, 0.4))
        for letter in range(7):
            at = x + 0.05 + letter * 0.033
            _rectangle(canvas, at, at + rng.uniform(0.008, 0.02), 0.08, 0.17, 1.8, 0.1)
        _rectangle(canvas, x + 0.02, x + 0.22, 0.25, 0.86, rng.uniform(0.5, 0.9), 1.0)
        for _ in range(8):
            at, top = x + rng.uniform(0.03, 0.17), rng.uniform(0.3, 0.7)
            _rectangle(canvas, at, at + rng.uniform(0.01, 0.05), top, 0.84, rng.uniform(0.4, 1.6), rng.uniform(0.2, 1))
        _rectangle(canvas, x + 0.24, x + 0.31, 0.28, 1.0, rng.uniform(0.4, 0.9), rng.uniform(0.2, 0.6))
        _rectangle(canvas, x + 0.25, x + 0.30, 0.34, 0.6, 0.7, 1.0)
    return canvas


def _car_side(rng: np.random.Generator) -> Canvas:
    """A car's flank: door seams, handles, sill, wheel arches. One period is one car."""
    canvas = _blank()
    canvas[0] += np.linspace(0.12, -0.22, canvas.shape[1])[:, None] + 0.02 * colored_noise(rng, 2, 32, 0.5)
    _rectangle(canvas, 0, 1, 0.86, 1.0, 0.35, 0.6)
    _rectangle(canvas, 0, 1, 0.40, 0.44, 0.8, 0.0)
    for x in (0.31, 0.52, 0.72):
        _rectangle(canvas, x, x + 0.008, 0, 0.88, 0.3, 0.3)
    for x in (0.45, 0.66):
        _rectangle(canvas, x, x + 0.045, 0.18, 0.24, 0.4, 0.5)
    for x in (0.19, 0.80):
        _disc(canvas, x, 1.05, 0.17, 0.1, 0.0)
    _rectangle(canvas, 0.0, 0.05, 0.12, 0.34, 1.6, 0.9)
    _rectangle(canvas, 0.95, 1.0, 0.12, 0.34, 1.1, 0.9)
    return canvas


def _car_end(rng: np.random.Generator, rear: bool) -> Canvas:
    """A car's front or rear: lights, grille, plate, bumper. The mask is 1 on lights."""
    canvas = _blank()
    canvas[0] += np.linspace(0.1, -0.15, canvas.shape[1])[:, None] + 0.02 * colored_noise(rng, 2, 32, 0.5)
    _rectangle(canvas, 0, 1, 0.68, 1.0, 0.7, 0.0)
    _rectangle(canvas, 0.04, 0.24, 0.15, 0.38, 1.5, 1.0)
    _rectangle(canvas, 0.76, 0.96, 0.15, 0.38, 1.5, 1.0)
    if not rear:
        _rectangle(canvas, 0.28, 0.72, 0.18, 0.5, 0.2, 0.0)
        for y in (0.26, 0.36, 0.44):
            _rectangle(canvas, 0.28, 0.72, y, y + 0.015, 0.7, 0.0)
    _rectangle(canvas, 0.35, 0.65, 0.55, 0.68, 1.9, 0.0)
    _rectangle(canvas, 0.38, 0.62, 0.59, 0.64, 0.3, 0.0)
    _rectangle(canvas, 0, 1, 0.9, 1.0, 0.3, 0.0)
    return canvas


def _wheel(rng: np.random.Generator) -> Canvas:
    """A wheel that fills the period: tyre, rim, spokes. The mask is 1 on the rim."""
    canvas = _blank(0.22)
    canvas[0] += 0.02 * colored_noise(rng, 4, 64, 0.3)
    _disc(canvas, 0.5, 0.5, 0.33, 1.1, 1.0)
    for angle in np.linspace(0, 2 * np.pi, 5, endpoint=False):
        _disc(canvas, 0.5 + 0.2 * np.cos(angle), 0.5 + 0.2 * np.sin(angle), 0.07, 0.35, 0.5)
    _disc(canvas, 0.5, 0.5, 0.06, 0.6, 1.0)
    return canvas


MAKERS: dict[str, Callable[[np.random.Generator], Canvas]] = {
    "asphalt": _noise(((0.12, 24, 128, 0.0), (0.15, 2, 24, 0.6)), 0.35, (0.35, 2, 40, 0.5)),
    "paving": _paving,
    "kerb": _kerb,
    "grass": _noise(((0.22, 8, 128, 0.4), (0.12, 1, 8, 0.5)), 0.4, (0.4, 1, 32, 0.8)),
    "foliage": _foliage,
    "brick": _brick,
    "plaster": _noise(((0.09, 1, 12, 0.8), (0.06, 12, 128, 0.2)), 0.15, (0.25, 1, 12, 1.0)),
    "roof": _roof,
    "planks": _planks,
    "bands": _bands,
    "paint": _noise(((0.05, 1, 24, 0.6),), 0.0, (0.3, 1, 8, 0.6)),
    "glass": _glass,
    "clouds": _noise((), 0.1, (0.55, 1, 64, 1.6)),
    "poster": _poster,
    **{f"facade_{style}": partial(_facade, style=style) for style in _OPENINGS},
    "shop": _shop,
    "car_side": _car_side,
    "car_front": partial(_car_end, rear=False),
    "car_rear": partial(_car_end, rear=True),
    "wheel": _wheel,
}
"""How each material is painted, by name."""
MATERIALS = tuple(MAKERS)
INDEX = {name: number for number, name in enumerate(MATERIALS)}
"""Number of each material in `atlas`."""

_LEVELS = SIZE.bit_length()  # 256, 128, ..., 1
_WIDTHS = np.array([SIZE >> level for level in range(_LEVELS)])
_STARTS = np.concatenate([[0], np.cumsum(_WIDTHS + 2)[:-1]])
_SIDE = int((_WIDTHS + 2).sum())
_BRIGHT = 127.5  # the byte that stores luminance 1, so that 255 is about 2
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
