"""What the report's figures show, read from the drawing itself."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from saunet.reporting import figures

pytest.importorskip("matplotlib")


class _Named(dict):  # type: ignore[type-arg]
    """Runs of which only the names matter."""

    def __missing__(self, name: str) -> str:
        return name


def test_the_paper_s_best_ratios_are_a_band_from_95_to_105(monkeypatch: pytest.MonkeyPatch) -> None:
    ratios = {"a": 10.0, "b": 100.0, "c": 1000.0}
    scores = {name: SimpleNamespace(errors=(0.1, 0, 0, 0, 0.9)) for name in ratios}
    drawn = []
    monkeypatch.setattr(figures, "comparable", lambda runs: scores)
    monkeypatch.setattr(figures, "ratio", ratios.get)
    monkeypatch.setattr(figures, "svg", lambda figure: drawn.append(figure) or b"")
    figures.draw_ratio(_Named())
    (figure,) = drawn
    for axis in figure.axes:
        (band,) = axis.patches
        assert (band.get_x(), band.get_x() + band.get_width()) == (95, 105)
        (line,) = axis.lines
        assert list(line.get_xdata()) == [10, 100, 1000]
