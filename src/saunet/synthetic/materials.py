"""The plain materials, from asphalt to clouds, and the list of all.

Every material is a periodic picture of two channels: luminance (1 = the surface's own color) and a mask that blends
between the surface's two colors (wall and window, grass and earth).
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np

from saunet.synthetic.facades import car_end, car_side, facade, shop, wheel
from saunet.synthetic.noise import SIZE, Canvas, blank, colored_noise, rectangle


def _asphalt(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    canvas[0] += 0.12 * colored_noise(rng, 24, 128, 0.0) + 0.15 * colored_noise(rng, 2, 24, 0.6)
    canvas[1] = np.clip(0.35 + 0.35 * colored_noise(rng, 2, 40, 0.5), 0, 1)
    return canvas


def _paving(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    for row in range(8):
        for column in range(8):
            x, y = column / 8, row / 8
            rectangle(canvas, x, x + 1 / 8, y, y + 1 / 8, 1 + 0.13 * rng.standard_normal(), rng.uniform(0, 0.8))
            rectangle(canvas, x, x + 1 / 8, y, y + 0.012, 0.6, 0.5)
            rectangle(canvas, x, x + 0.012, y, y + 1 / 8, 0.6, 0.5)
    canvas[0] += 0.07 * colored_noise(rng, 4, 128, 0.3)
    return canvas


def _kerb(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    for stone in range(4):
        rectangle(canvas, stone / 4, (stone + 1) / 4, 0, 1, 1 + 0.12 * rng.standard_normal(), rng.uniform(0, 0.5))
        rectangle(canvas, stone / 4, stone / 4 + 0.01, 0, 1, 0.5, 0.5)
    canvas[0] += 0.08 * colored_noise(rng, 4, 128, 0.4)
    return canvas


def _grass(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    canvas[0] += 0.22 * colored_noise(rng, 8, 128, 0.4) + 0.12 * colored_noise(rng, 1, 8, 0.5)
    canvas[1] = np.clip(0.4 + 0.4 * colored_noise(rng, 1, 32, 0.8), 0, 1)
    return canvas


def _foliage(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    lumps = colored_noise(rng, 3, 20, 0.5)
    canvas[0] = 0.95 + 0.30 * lumps + 0.24 * colored_noise(rng, 16, 100, 0.3)
    canvas[1] = np.clip(0.4 + 0.3 * lumps + 0.3 * colored_noise(rng, 4, 60, 0.5), 0, 1)
    return canvas


def _brick(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    courses, bricks = 20, 8
    for row in range(courses):
        for column in range(bricks):
            x, y = (column + 0.5 * (row % 2)) / bricks, row / courses
            rectangle(
                canvas, x, x + 1 / bricks, y, y + 1 / courses, 1 + 0.16 * rng.standard_normal(), rng.uniform(0, 0.7)
            )
            rectangle(canvas, x, x + 0.014, y, y + 1 / courses, 1.25, 0.9)
        rectangle(canvas, 0, 1, row / courses, row / courses + 0.012, 1.25, 0.9)
    canvas[0] += 0.06 * colored_noise(rng, 2, 128, 0.5)
    return canvas


def _plaster(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    canvas[0] += 0.09 * colored_noise(rng, 1, 12, 0.8) + 0.06 * colored_noise(rng, 12, 128, 0.2)
    canvas[1] = np.clip(0.15 + 0.25 * colored_noise(rng, 1, 12, 1.0), 0, 1)
    return canvas


def _roof(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    for row in range(12):
        for column in range(12):
            x, y = (column + 0.5 * (row % 2)) / 12, row / 12
            rectangle(canvas, x, x + 1 / 12, y, y + 1 / 12, 1 + 0.14 * rng.standard_normal(), rng.uniform(0, 0.8))
        rectangle(canvas, 0, 1, row / 12, row / 12 + 0.02, 0.62, 0.5)
    canvas[0] += 0.06 * colored_noise(rng, 2, 100, 0.5)
    return canvas


def _planks(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    for plank in range(16):
        rectangle(canvas, plank / 16, (plank + 1) / 16, 0, 1, 1 + 0.16 * rng.standard_normal(), rng.uniform(0, 0.8))
        rectangle(canvas, plank / 16, plank / 16 + 0.01, 0, 1, 0.4, 0.5)
    rectangle(canvas, 0, 1, 0.2, 0.26, 0.8, 0.5)
    rectangle(canvas, 0, 1, 0.75, 0.81, 0.8, 0.5)
    canvas[0] += 0.07 * colored_noise(rng, 2, 100, 0.4)
    return canvas


def _bands(rng: np.random.Generator) -> Canvas:
    """Bark, weathered metal: variation along v, little along u."""
    canvas = blank()
    profile = colored_noise(rng, 2, 60, 0.5)[:, :1]
    canvas[0] += 0.16 * profile + 0.12 * colored_noise(rng, 4, 100, 0.4)
    canvas[1] = np.clip(0.4 + 0.4 * colored_noise(rng, 1, 20, 0.5), 0, 1)
    return canvas


def _paint(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    canvas[0] += 0.05 * colored_noise(rng, 1, 24, 0.6)
    canvas[1] = np.clip(0.3 * colored_noise(rng, 1, 8, 0.6), 0, 1)
    return canvas


def _glass(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    canvas[0] = 1.25 - 0.6 * np.linspace(0, 1, SIZE)[:, None] + 0.2 * colored_noise(rng, 1, 24, 0.5)
    for x in (0.0, 0.49):  # pillars and what is behind the window
        rectangle(canvas, x, x + 0.05, 0, 1, 0.3, 0.8)
        rectangle(canvas, x + 0.14, x + 0.28, 0.3, 1.0, 0.45, 0.3)
    return canvas


def _clouds(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    canvas[1] = np.clip(0.1 + 0.55 * colored_noise(rng, 1, 64, 1.6), 0, 1)
    return canvas


def _poster(rng: np.random.Generator) -> Canvas:
    canvas = blank()
    for _ in range(40):
        x, y = rng.uniform(0, 0.8, 2)
        width, height = rng.uniform(0.03, 0.3, 2)
        rectangle(canvas, x, x + width, y, y + height, rng.uniform(0.4, 1.7), rng.uniform(0, 1))
    return canvas


MAKERS: dict[str, Callable[[np.random.Generator], Canvas]] = {
    "asphalt": _asphalt,
    "paving": _paving,
    "kerb": _kerb,
    "grass": _grass,
    "foliage": _foliage,
    "brick": _brick,
    "plaster": _plaster,
    "roof": _roof,
    "planks": _planks,
    "bands": _bands,
    "paint": _paint,
    "glass": _glass,
    "clouds": _clouds,
    "poster": _poster,
    "facade_sash": functools.partial(facade, style="sash"),
    "facade_tall": functools.partial(facade, style="tall"),
    "facade_ribbon": functools.partial(facade, style="ribbon"),
    "facade_panel": functools.partial(facade, style="panel"),
    "shop": shop,
    "car_side": car_side,
    "car_front": functools.partial(car_end, rear=False),
    "car_rear": functools.partial(car_end, rear=True),
    "wheel": wheel,
}
"""How each material is painted, by name."""
MATERIALS = tuple(MAKERS)
INDEX = {name: number for number, name in enumerate(MATERIALS)}
"""Number of each material in `saunet.synthetic.textures.atlas`."""
