"""Pictures with a composition: house fronts, shop fronts and the sides and ends of cars."""

from __future__ import annotations

import numpy as np

from saunet.synthetic.noise import Canvas, blank, colored_noise, disc, rectangle

WINDOWS = 4
"""Windows across one period of a facade picture."""
FLOORS = 2
"""Floors in one period of a facade picture."""

# window left, right, top, bottom as fractions of its cell
_OPENINGS = {
    "sash": (0.28, 0.72, 0.24, 0.78),
    "tall": (0.32, 0.68, 0.14, 0.90),
    "ribbon": (0.03, 0.97, 0.30, 0.72),
    "panel": (0.12, 0.88, 0.16, 0.80),
}


def facade(rng: np.random.Generator, style: str) -> Canvas:
    """Paint `WINDOWS` x `FLOORS` windows with frames, sills and blinds on a wall. The mask is 1 on glass."""
    canvas = blank()
    canvas[0] += 0.05 * colored_noise(rng, 1, 16, 0.8) + 0.05 * colored_noise(rng, 16, 128, 0.2)
    courses = {"sash": 64, "tall": 16, "ribbon": 0, "panel": 4}[style]
    for course in range(courses):
        rectangle(canvas, 0, 1, course / courses, course / courses + 0.006, 0.86, 0.0)
    left, right, top, bottom = _OPENINGS[style]
    for floor in range(FLOORS):
        if style in ("tall", "panel"):
            rectangle(canvas, 0, 1, floor / FLOORS, (floor + 0.05) / FLOORS, 1.25, 0.0)
        for number in range(WINDOWS):
            x, y = number / WINDOWS, floor / FLOORS
            if style == "panel":
                rectangle(canvas, x, x + 0.012, y, y + 1 / FLOORS, 0.7, 0.0)
            x0, x1 = x + left / WINDOWS, x + right / WINDOWS
            y0, y1 = y + top / FLOORS, y + bottom / FLOORS
            rectangle(canvas, x0 - 0.012, x1 + 0.012, y0 - 0.016, y1 + 0.016, 1.35, 0.12)
            rectangle(canvas, x0, x1, y0, y1, rng.uniform(0.5, 1.1), 1.0)
            rectangle(canvas, x0, x1, y0, y0 + 0.25 * (y1 - y0), rng.uniform(0.7, 1.3), 1.0)
            blind = rng.uniform(0, 1)
            if blind < 0.45:  # a blind or curtain in the wall's color
                rectangle(canvas, x0, x1, y0, y0 + blind * 2 * (y1 - y0), rng.uniform(0.8, 1.4), 0.25)
            if rng.uniform() < 0.3:
                rectangle(canvas, x0, x0 + 0.3 * (x1 - x0), y0, y1, 1.2, 0.3)
            middle = (x0 + x1) / 2
            rectangle(canvas, middle - 0.005, middle + 0.005, y0, y1, 1.3, 0.1)
            rectangle(canvas, x0 - 0.02, x1 + 0.02, y1 + 0.012, y1 + 0.035, 1.5, 0.05)
    return canvas


def shop(rng: np.random.Generator) -> Canvas:
    """Paint a ground floor: shop windows, doors, sign boards."""
    canvas = blank(0.9)
    canvas[0] += 0.05 * colored_noise(rng, 4, 100, 0.3)
    for number in range(3):
        x = number / 3
        rectangle(canvas, x + 0.01, x + 0.32, 0.05, 0.2, rng.uniform(0.6, 1.7), rng.uniform(0, 0.4))
        for letter in range(7):
            at = x + 0.05 + letter * 0.033
            rectangle(canvas, at, at + rng.uniform(0.008, 0.02), 0.08, 0.17, 1.8, 0.1)
        rectangle(canvas, x + 0.02, x + 0.22, 0.25, 0.86, rng.uniform(0.5, 0.9), 1.0)
        for _ in range(8):
            at, top = x + rng.uniform(0.03, 0.17), rng.uniform(0.3, 0.7)
            rectangle(canvas, at, at + rng.uniform(0.01, 0.05), top, 0.84, rng.uniform(0.4, 1.6), rng.uniform(0.2, 1))
        rectangle(canvas, x + 0.24, x + 0.31, 0.28, 1.0, rng.uniform(0.4, 0.9), rng.uniform(0.2, 0.6))
        rectangle(canvas, x + 0.25, x + 0.30, 0.34, 0.6, 0.7, 1.0)
    return canvas


def car_side(rng: np.random.Generator) -> Canvas:
    """Paint a car's flank: door seams, handles, sill, wheel arches. One period is one car."""
    canvas = blank()
    canvas[0] += np.linspace(0.12, -0.22, canvas.shape[1])[:, None] + 0.02 * colored_noise(rng, 2, 32, 0.5)
    rectangle(canvas, 0, 1, 0.86, 1.0, 0.35, 0.6)
    rectangle(canvas, 0, 1, 0.40, 0.44, 0.8, 0.0)
    for x in (0.31, 0.52, 0.72):
        rectangle(canvas, x, x + 0.008, 0, 0.88, 0.3, 0.3)
    for x in (0.45, 0.66):
        rectangle(canvas, x, x + 0.045, 0.18, 0.24, 0.4, 0.5)
    for x in (0.19, 0.80):
        disc(canvas, x, 1.05, 0.17, 0.1, 0.0)
    rectangle(canvas, 0.0, 0.05, 0.12, 0.34, 1.6, 0.9)
    rectangle(canvas, 0.95, 1.0, 0.12, 0.34, 1.1, 0.9)
    return canvas


def car_end(rng: np.random.Generator, rear: bool) -> Canvas:
    """Paint a car's front or rear: lights, grille, plate, bumper. The mask is 1 on lights."""
    canvas = blank()
    canvas[0] += np.linspace(0.1, -0.15, canvas.shape[1])[:, None] + 0.02 * colored_noise(rng, 2, 32, 0.5)
    rectangle(canvas, 0, 1, 0.68, 1.0, 0.7, 0.0)
    rectangle(canvas, 0.04, 0.24, 0.15, 0.38, 1.5, 1.0)
    rectangle(canvas, 0.76, 0.96, 0.15, 0.38, 1.5, 1.0)
    if not rear:
        rectangle(canvas, 0.28, 0.72, 0.18, 0.5, 0.2, 0.0)
        for y in (0.26, 0.36, 0.44):
            rectangle(canvas, 0.28, 0.72, y, y + 0.015, 0.7, 0.0)
    rectangle(canvas, 0.35, 0.65, 0.55, 0.68, 1.9, 0.0)
    rectangle(canvas, 0.38, 0.62, 0.59, 0.64, 0.3, 0.0)
    rectangle(canvas, 0, 1, 0.9, 1.0, 0.3, 0.0)
    return canvas


def wheel(rng: np.random.Generator) -> Canvas:
    """Paint a wheel that fills the period: tyre, rim, spokes. The mask is 1 on the rim."""
    canvas = blank(0.22)
    canvas[0] += 0.02 * colored_noise(rng, 4, 64, 0.3)
    disc(canvas, 0.5, 0.5, 0.33, 1.1, 1.0)
    for angle in np.linspace(0, 2 * np.pi, 5, endpoint=False):
        disc(canvas, 0.5 + 0.2 * np.cos(angle), 0.5 + 0.2 * np.sin(angle), 0.07, 0.35, 0.5)
    disc(canvas, 0.5, 0.5, 0.06, 0.6, 1.0)
    return canvas
