"""The doctor's findings as one picture: frames, their motion and brightness, and the findings."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.tools.doctor.findings import Finding, band_profile
from saunet.tools.doctor.survey import Survey, Timeline

WIDTH = 1312
_GAP = 8
_LINE = 22
"""Height of a line of text."""
_INK, _GRID, _BAR, _RED = (40, 40, 40), (210, 210, 210), (70, 130, 180), (190, 30, 30)
_ORANGE, _WHITE = (190, 110, 0), (255, 255, 255)
_COLORS = {"error": _RED, "warning": _ORANGE, "note": (60, 60, 60)}
_TIMELINES = 16
"""Largest number of timelines."""
_Picture = NDArray[np.uint8]


def draw_sheet(survey: Survey, findings: Sequence[Finding], title: str) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a picture sheet, RGB: a title, up to eight frames, three charts, timelines, and the findings as text."""
    rows = [_text(title, WIDTH, 0.7, _INK, bold=True), *_frames(survey), _charts(survey), *_timelines(survey)]
    for finding in findings:
        lines = textwrap.wrap(str(finding), 165, subsequent_indent="    ")
        rows.append(np.concatenate([_text(line, WIDTH, 0.45, _COLORS[finding.level]) for line in lines]))
    return np.concatenate([part for row in rows for part in (row, _blank(_GAP, WIDTH))])


def _frames(survey: Survey) -> list[_Picture]:
    shown = survey.pictures[:8]
    if not shown:
        return []
    columns, width = 4, (WIDTH - 5 * _GAP) // 4
    height = max(round(picture.shape[0] * width / picture.shape[1]) for _, picture in shown)
    tiles = []
    for name, picture in shown:
        tile, rows = _blank(height + _LINE, width), round(picture.shape[0] * width / picture.shape[1])
        tile[:_LINE] = _text(name if len(name) < 46 else "..." + name[-43:], width, 0.42, _INK)
        tile[_LINE : _LINE + rows] = cv2.resize(picture, (width, rows))
        tiles.append(tile)
    return [_side_by_side(tiles[start : start + columns]) for start in range(0, len(tiles), columns)]


def _blank(height: int, width: int) -> _Picture:
    return np.full((height, width, 3), 255, np.uint8)


def _side_by_side(tiles: Sequence[_Picture]) -> _Picture:
    row = _blank(tiles[0].shape[0], WIDTH)
    for place, tile in enumerate(tiles):
        left = _GAP + place * (tile.shape[1] + _GAP)
        row[:, left : left + tile.shape[1]] = tile
    return row


def _charts(survey: Survey) -> _Picture:
    flows = np.array([frame.flow for frame in survey.compared()], dtype=np.float64)
    light = np.array([frame.brightness for frame in survey.readable()], dtype=np.float64)
    top = max(10.0, float(np.quantile(flows, 0.99)) if flows.size else 0.0)
    step = f"{survey.step} frame{'s' if survey.step > 1 else ''}"
    motion = _histogram(flows, 0.0, top, f"motion over {step}, px at 320 width")
    return _side_by_side([motion, _histogram(light, 0.0, 1.0, "brightness, 0 to 1"), _profile(band_profile(survey))])


def _axes(title: str, low: str, high: str) -> tuple[_Picture, tuple[int, int, int, int]]:
    """Return an empty chart and its (left, top, right, bottom)."""
    width, height = (WIDTH - 4 * _GAP) // 3, 190
    chart = _blank(height, width)
    chart[:_LINE] = _text(title, width, 0.45, _INK)
    box = (10, 30, width - 10, height - 26)
    cv2.rectangle(chart, box[:2], box[2:], _GRID, 1)
    (size, _), _ = cv2.getTextSize(high, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
    _write(chart, low, (box[0], height - 8))
    _write(chart, high, (box[2] - size, height - 8))
    return chart, box


def _write(
    picture: _Picture,
    text: str,
    at: tuple[int, int],
    color: tuple[int, int, int] = _INK,
    size: float = 0.42,
    thickness: int = 1,
) -> None:
    ascii_only = text.encode("ascii", "replace").decode()  # characters that OpenCV's font can draw
    cv2.putText(picture, ascii_only, at, cv2.FONT_HERSHEY_SIMPLEX, size, color, thickness, cv2.LINE_AA)


def _histogram(values: NDArray[np.float64], low: float, high: float, title: str) -> _Picture:
    chart, (left, top, right, bottom) = _axes(title, f"{low:g}", f"{high:.3g}")
    if values.size == 0:
        _write(chart, "not measured", (20, 60), size=0.45)
        return chart
    counts, _ = np.histogram(np.clip(values, low, high), bins=40, range=(low, high))
    step = (right - left - 2) / len(counts)
    for place, count in enumerate(counts):
        if count:
            rise = max(1, round((bottom - top - 4) * count / counts.max()))
            first, last = round(left + 1 + place * step), round(left + (place + 1) * step)
            cv2.rectangle(chart, (first, bottom - rise), (last, bottom - 1), _BAR, -1)
    middle = round(left + (right - left) * (np.clip(np.median(values), low, high) - low) / (high - low))
    cv2.line(chart, (middle, top), (middle, bottom), _RED, 1)
    _write(chart, f"median {np.median(values):.2g}", (min(middle + 4, right - 90), top + 14), _RED)
    return chart


def _profile(profile: NDArray[np.float64] | None) -> _Picture:
    """Draw the motion of the image's bands as horizontal bars, from the top of the image down."""
    chart, (left, top, right, bottom) = _axes("motion by height in the image (top to bottom)", "still", "moves most")
    if profile is None:
        _write(chart, "not measured", (20, 60), size=0.45)
        return chart
    step, most = (bottom - top - 2) / len(profile), float(profile.max())
    for place, value in enumerate(profile):
        first, last = round(top + 1 + place * step), round(top + (place + 1) * step)
        length = round((right - left - 4) * float(value) / max(most, 1e-6))
        cv2.rectangle(chart, (left + 1, first), (left + 1 + length, last), _BAR, -1)
    return chart


def _timelines(survey: Survey) -> list[_Picture]:
    """Draw recordings as bars over time, with the frame rate as height; those with gaps and duplicates come first."""
    lines = sorted(
        (line for line in survey.timelines if line.rates), key=lambda each: -len(each.gaps + each.duplicates)
    )
    if not lines:
        return []
    shown, rest = lines[:_TIMELINES], len(lines) - _TIMELINES
    more = f"; {rest} more recordings, with fewer of both, are not drawn" if rest > 0 else ""
    head = f"timelines: bar height is the frame rate, gaps are red, duplicates are orange{more}"
    return [np.concatenate([_text(head, WIDTH, 0.45, _INK), *map(_timeline, shown)])]


def _timeline(line: Timeline) -> _Picture:
    row, left, right, top, bottom = _blank(_LINE + 12, WIDTH), 640, WIDTH - _GAP, 8, _LINE + 10
    rates, name = line.rates or (0.0, 0.0, 0.0), line.drive
    recorded = f" of {line.recorded:.3g}" if line.recorded and line.recorded > 1.2 * rates[1] else ""
    facts = [
        name if len(name) < 34 else f"...{name[-30:]}",
        f"{line.frames} frames in {line.times[-1]:.1f} s",
        f"{rates[1]:.3g}{recorded} per second",
        *([f"{len(line.gaps)} gaps"] if line.gaps else []),
        *([f"{len(line.duplicates)} duplicates"] if line.duplicates else []),
    ]
    _write(row, ", ".join(facts), (_GAP, bottom - 6))

    def column(time: float) -> int:
        return left + round(float((right - left) * min(max(time / max(line.times[-1], 1e-9), 0), 1)))

    def bar(start: float, end: float, height: float, color: tuple[int, int, int]) -> None:
        first = column(start)
        cv2.rectangle(
            row, (first, bottom - round((bottom - top) * height)), (max(column(end), first + 1), bottom), color, -1
        )

    usual = 1 / rates[1]
    for start, end in itertools.pairwise(line.times.tolist()):
        bar(start, end, min(1.0, usual / max(end - start, usual)), _BAR)
    for start, end in line.gaps:
        bar(start, end, 1.0, _WHITE)
        bar(start, end, 0.4, _RED)
    for time in line.duplicates:
        cv2.line(row, (column(time), top - 6), (column(time), top), _ORANGE, 1)
    return row


def _text(text: str, width: int, size: float, color: tuple[int, int, int], bold: bool = False) -> _Picture:
    row = _blank(_LINE + (8 if bold else 0), width)
    _write(row, text, (_GAP, row.shape[0] - 6), color, size, 1 + bold)
    return row
