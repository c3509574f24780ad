"""The doctor's findings as one picture: frames, how much they move and how bright they are, and what was found."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.tools.doctor.findings import Finding, band_profile
from saunet.tools.doctor.survey import Survey

WIDTH = 1312
_GAP = 8
_LINE = 22
"""Height of a line of text."""
_INK, _GRID, _BAR = (40, 40, 40), (210, 210, 210), (70, 130, 180)
_COLORS = {"error": (190, 30, 30), "warning": (190, 110, 0), "note": (60, 60, 60)}
_Picture = NDArray[np.uint8]


def draw_sheet(survey: Survey, findings: Sequence[Finding], title: str) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a picture sheet, RGB: a title, up to eight frames, three charts, and the findings as text."""
    rows = [_text(title, WIDTH, 0.7, _INK, bold=True), *_frames(survey), _charts(survey)]
    for finding in findings:
        rows += _paragraph(str(finding), _COLORS[finding.level])
    gap = np.full((_GAP, WIDTH, 3), 255, np.uint8)
    return np.concatenate([part for row in rows for part in (row, gap)])


def _frames(survey: Survey) -> list[_Picture]:
    shown = survey.pictures[:8]
    if not shown:
        return []
    columns, width = 4, (WIDTH - 5 * _GAP) // 4
    height = max(round(picture.shape[0] * width / picture.shape[1]) for _, picture in shown)
    rows = []
    for start in range(0, len(shown), columns):
        row = np.full((height + _LINE, WIDTH, 3), 255, np.uint8)
        for place, (name, picture) in enumerate(shown[start : start + columns]):
            left, rows_of = _GAP + place * (width + _GAP), round(picture.shape[0] * width / picture.shape[1])
            row[:_LINE, left : left + width] = _text(name if len(name) < 46 else "..." + name[-43:], width, 0.42, _INK)
            row[_LINE : _LINE + rows_of, left : left + width] = cv2.resize(picture, (width, rows_of))
        rows.append(row)
    return rows


def _charts(survey: Survey) -> _Picture:
    flows = np.array([frame.flow for frame in survey.compared()], dtype=np.float64)
    light = np.array([frame.brightness for frame in survey.readable()], dtype=np.float64)
    top = max(10.0, float(np.quantile(flows, 0.99)) if flows.size else 0.0)
    step = f"{survey.step} frame{'s' if survey.step > 1 else ''}"
    profile = band_profile(survey)
    charts = [
        _histogram(flows, 0.0, top, f"motion over {step}, px at 320 width"),
        _histogram(light, 0.0, 1.0, "brightness, 0 to 1"),
        _profile(profile),
    ]
    row = np.full((charts[0].shape[0], WIDTH, 3), 255, np.uint8)
    for place, chart in enumerate(charts):
        left = _GAP + place * (chart.shape[1] + _GAP)
        row[:, left : left + chart.shape[1]] = chart
    return row


def _axes(title: str, low: str, high: str) -> tuple[_Picture, tuple[int, int, int, int]]:
    """Return an empty chart and its (left, top, right, bottom)."""
    width, height = (WIDTH - 4 * _GAP) // 3, 190
    chart = np.full((height, width, 3), 255, np.uint8)
    chart[:_LINE] = _text(title, width, 0.45, _INK)
    box = (10, 30, width - 10, height - 26)
    cv2.rectangle(chart, box[:2], box[2:], _GRID, 1)
    cv2.putText(chart, low, (box[0], height - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    (size, _), _ = cv2.getTextSize(high, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
    cv2.putText(chart, high, (box[2] - size, height - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    return chart, box


def _histogram(values: NDArray[np.float64], low: float, high: float, title: str) -> _Picture:
    chart, (left, top, right, bottom) = _axes(title, f"{low:g}", f"{high:.3g}")
    if values.size == 0:
        return _nothing(chart)
    counts, _ = np.histogram(np.clip(values, low, high), bins=40, range=(low, high))
    step = (right - left - 2) / len(counts)
    for place, count in enumerate(counts):
        if count:
            rise = max(1, round((bottom - top - 4) * count / counts.max()))
            first, last = round(left + 1 + place * step), round(left + (place + 1) * step)
            cv2.rectangle(chart, (first, bottom - rise), (last, bottom - 1), _BAR, -1)
    middle = round(left + (right - left) * (np.clip(np.median(values), low, high) - low) / (high - low))
    cv2.line(chart, (middle, top), (middle, bottom), (190, 30, 30), 1)
    cv2.putText(
        chart,
        f"median {np.median(values):.2g}",
        (min(middle + 4, right - 90), top + 14),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.42,
        (190, 30, 30),
        1,
        cv2.LINE_AA,
    )
    return chart


def _profile(profile: NDArray[np.float64] | None) -> _Picture:
    """Draw the motion of the image's bands as bars from the left, the top of the image on top."""
    chart, (left, top, right, bottom) = _axes("motion by height in the image (top to bottom)", "still", "moves most")
    if profile is None:
        return _nothing(chart)
    step, most = (bottom - top - 2) / len(profile), float(profile.max())
    for place, value in enumerate(profile):
        first, last = round(top + 1 + place * step), round(top + (place + 1) * step)
        length = round((right - left - 4) * float(value) / max(most, 1e-6))
        cv2.rectangle(chart, (left + 1, first), (left + 1 + length, last), _BAR, -1)
    return chart


def _nothing(chart: _Picture) -> _Picture:
    cv2.putText(chart, "not measured", (20, 60), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _INK, 1, cv2.LINE_AA)
    return chart


def _paragraph(text: str, color: tuple[int, int, int]) -> list[_Picture]:
    lines = textwrap.wrap(_ascii(text), 165, subsequent_indent="    ")
    return [np.concatenate([_text(line, WIDTH, 0.45, color) for line in lines])]


def _text(text: str, width: int, size: float, color: tuple[int, int, int], bold: bool = False) -> _Picture:
    row = np.full((_LINE + (8 if bold else 0), width, 3), 255, np.uint8)
    baseline = row.shape[0] - 6
    cv2.putText(row, _ascii(text), (_GAP, baseline), cv2.FONT_HERSHEY_SIMPLEX, size, color, 1 + bold, cv2.LINE_AA)
    return row


def _ascii(text: str) -> str:
    """Return what OpenCV's font can draw."""
    return text.encode("ascii", "replace").decode()
