"""Which token belongs to which attention window, worked out once per map size.

A shifted window that the cyclic shift glued together from opposite borders is masked so that its parts never see each
other; a window that reaches into masked padding sees only its real tokens. In both cases the attention of a part is
that of a smaller window of its own. So a map is cut into windows of a few sizes ("groups"), and no roll, mask or
padding is ever computed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

_KEPT: dict[tuple[object, ...], Tensor] = {}
_KEPT_AT_MOST = 512


class WindowGroup(NamedTuple):
    """Windows of one size."""

    height: int
    width: int
    windows: int
    """How many of them one image has."""

    @property
    def area(self) -> int:
        """Tokens per window."""
        return self.height * self.width


def axis_windows(size: int, window: int, shift: int) -> list[tuple[int, int]]:
    """Cut one axis into windows: ``[(start, length), ...]``, in order and without gaps.

    A shifted axis starts with a window of ``shift`` tokens; the last window ends at the border. An axis that fits in
    one window is not shifted: the shift would only cut it in two.

    Args:
        size: Tokens of the axis.
        window: Tokens of a full window.
        shift: Tokens of the first window; 0 for the unshifted partition.
    """
    first = shift if size > window else 0
    starts = [0, *range(first, size, window)] if first else list(range(0, size, window))
    return [(start, stop - start) for start, stop in zip(starts, [*starts[1:], size], strict=True)]


def window_groups(height: int, width: int, window: int, shift: int) -> list[WindowGroup]:
    """Return the window sizes of a map and how many there are of each, in the order in which they first appear.

    Args:
        height: Rows of the map, in tokens.
        width: Columns of the map, in tokens.
        window: Side of a full window.
        shift: Rows and columns in the first window; 0 for the unshifted partition.
    """
    counts: dict[tuple[int, int], int] = {}
    for _, tall in axis_windows(height, window, shift):
        for _, wide in axis_windows(width, window, shift):
            counts[tall, wide] = counts.get((tall, wide), 0) + 1
    return [WindowGroup(tall, wide, windows) for (tall, wide), windows in counts.items()]


def window_order(
    batch: int, height: int, width: int, window: int, shift: int, device: torch.device
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Return the permutation that sorts the flat tokens of a batch of maps by window, and its inverse.

    The order is (group, image, window row, window column, token row, token column), groups as in `window_groups`.
    Results are kept and shared between all modules; a compiled or exported graph holds them as constants.

    Args:
        batch: Number of maps.
        height: Rows of a map, in tokens.
        width: Columns of a map, in tokens.
        window: Side of a full window.
        shift: Rows and columns in the first window, 0 for the unshifted partition.
        device: Where the indices are wanted.
    """
    arguments = (batch, height, width, window, shift)
    order: Tensor = _order(*arguments, str(device))
    inverse: Tensor = _inverse(*arguments, str(device))
    return order, inverse


def relative_position_index(height: int, width: int, window: int, device: torch.device) -> Int[Tensor, " n2"]:
    """Return the row of the ``(2 window - 1)**2`` bias table for each (query, key) of a ``height x width`` window.

    Args:
        height: Rows of the window.
        width: Columns of the window.
        window: Side of a full window, which the table is made for.
        device: Where the index is wanted.
    """
    index: Tensor = _relative_index(height, width, window, str(device))
    return index


@torch.compiler.allow_in_graph  # type: ignore[untyped-decorator]
def _order(batch: int, height: int, width: int, window: int, shift: int, device: str) -> Tensor:
    arguments = (int(batch), int(height), int(width), window, shift)
    return _keep(("order", *arguments, device), lambda: _build_order(*arguments), device)


@torch.compiler.allow_in_graph  # type: ignore[untyped-decorator]
def _inverse(batch: int, height: int, width: int, window: int, shift: int, device: str) -> Tensor:
    arguments = (int(batch), int(height), int(width), window, shift)
    return _keep(("inverse", *arguments, device), lambda: np.argsort(_build_order(*arguments)), device)


@torch.compiler.allow_in_graph  # type: ignore[untyped-decorator]
def _relative_index(height: int, width: int, window: int, device: str) -> Tensor:
    arguments = (int(height), int(width), window)
    return _keep(("relative", *arguments, device), lambda: _build_relative_index(*arguments), device)


def _keep(key: tuple[object, ...], build: Callable[[], np.ndarray], device: str) -> Tensor:
    if key not in _KEPT:
        while len(_KEPT) >= _KEPT_AT_MOST:
            _KEPT.pop(next(iter(_KEPT)))
        # made outside of whatever mode is on: an index made for a prediction or a trace must serve everyone
        with torch.inference_mode(False), _disable_current_modes():
            _KEPT[key] = torch.from_numpy(build()).to(device)
    return torch.ops.aten.lift_fresh.default(_KEPT[key])  # type: ignore[no-any-return]  # a tracer takes it as a constant


def _build_order(batch: int, height: int, width: int, window: int, shift: int) -> np.ndarray:
    tokens = np.arange(batch * height * width).reshape(batch, height, width)
    parts = []
    for group in window_groups(height, width, window, shift):
        tops = [start for start, length in axis_windows(height, window, shift) if length == group.height]
        lefts = [start for start, length in axis_windows(width, window, shift) if length == group.width]
        rows = np.array(tops)[:, None] + np.arange(group.height)
        columns = np.array(lefts)[:, None] + np.arange(group.width)
        parts.append(tokens[:, rows[:, None, :, None], columns[None, :, None, :]].ravel())
    return np.concatenate(parts)


def _build_relative_index(height: int, width: int, window: int) -> np.ndarray:
    y, x = (axis.ravel() for axis in np.mgrid[:height, :width])
    down, right = y[:, None] - y[None, :], x[:, None] - x[None, :]
    return np.asarray((down + window - 1) * (2 * window - 1) + right + window - 1).ravel()
