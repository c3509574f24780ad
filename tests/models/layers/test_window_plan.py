"""The partition of a map into windows: complete, without overlap, kept between calls."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from saunet.models.layers import window
from saunet.models.layers.window import axis_windows, relative_position_index, window_groups, window_order

CPU = torch.device("cpu")


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 20), st.integers(1, 20), st.integers(1, 9), st.data())
def test_order_is_a_permutation_of_all_tokens(height: int, width: int, window: int, data: st.DataObject) -> None:
    shift = data.draw(st.integers(0, window - 1))
    order, inverse = window_order(2, height, width, window, shift, CPU)
    assert torch.equal(order[inverse], torch.arange(2 * height * width))
    groups = window_groups(height, width, window, shift)
    assert sum(group.windows * group.area for group in groups) == height * width
    assert all(group.height <= window and group.width <= window for group in groups)


def test_axis_windows_by_hand() -> None:
    assert axis_windows(8, 4, 0) == [(0, 4), (4, 4)]
    assert axis_windows(8, 4, 2) == [(0, 2), (2, 4), (6, 2)]
    assert axis_windows(10, 4, 0) == [(0, 4), (4, 4), (8, 2)]
    assert axis_windows(10, 4, 2) == [(0, 2), (2, 4), (6, 4)]
    assert axis_windows(4, 4, 2) == [(0, 4)]
    assert axis_windows(3, 4, 2) == [(0, 3)]


def test_order_by_hand() -> None:
    order, _ = window_order(1, 2, 4, 2, 0, CPU)
    assert order.tolist() == [0, 1, 4, 5, 2, 3, 6, 7]


def test_shifted_map_has_four_window_sizes() -> None:
    groups = window_groups(96, 320, 8, 4)
    assert set(groups) == {(8, 8, 11 * 39), (4, 8, 2 * 39), (8, 4, 2 * 11), (4, 4, 4)}
    assert len(groups) == 4


def test_relative_index_by_hand() -> None:
    index = relative_position_index(1, 2, 2, CPU).view(2, 2)
    assert index.tolist() == [[4, 3], [5, 4]]


def test_plans_are_kept() -> None:
    first, again = window_order(1, 12, 16, 4, 2, CPU), window_order(1, 12, 16, 4, 2, CPU)
    assert first[0].data_ptr() == again[0].data_ptr()
    assert first[1].data_ptr() == again[1].data_ptr()
    index, same = relative_position_index(4, 4, 4, CPU), relative_position_index(4, 4, 4, CPU)
    assert index.data_ptr() == same.data_ptr()


def test_kept_plans_have_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "_KEPT", {})
    monkeypatch.setattr(window, "_KEPT_AT_MOST", 4)
    for side in range(1, 10):
        relative_position_index(side, side, side, CPU)
    assert [key[1] for key in window._KEPT] == [6, 7, 8, 9]


def test_plans_made_in_a_trace_serve_everyone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "_KEPT", {})
    with FakeTensorMode():
        order, _ = window_order(1, 4, 4, 2, 1, CPU)
        assert type(order) is FakeTensor
    order, inverse = window_order(1, 4, 4, 2, 1, CPU)
    assert order[inverse].tolist() == list(range(16))
