"""A direct solver for systems on an image grid whose equations couple each pixel to its eight neighbors.

Nested dissection: the image is cut into small cells by lines one pixel wide; what lies inside a cell is eliminated,
then neighboring cells are merged two by two and the line between them is eliminated, until one cell is left. All cells
of a level have the same size, so that a level is a handful of operations on stacked matrices: no sparse matrix is ever
built. For n pixels the work grows with n**1.5. Equations must be diagonally dominant with negative couplings, as those
of diffusion are: then no pivoting is needed, which is what makes the order of elimination free.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

NEIGHBORS = tuple(itertools.product((-1, 0, 1), (-1, 0, 1)))
"""Where the nine coefficients of an equation point to: (row, column) steps; the fifth is the pixel itself."""

Place = tuple[int, int]
"""A (row, column) inside a cell; row and column 0 are the lines above and left of it."""
Run = tuple[slice, slice]
"""Neighboring positions in one list that are neighbors in another list too."""

_CHUNK = 1 << 20
"""Numbers in the stacked matrices that are worked on together: few enough to stay in the processor's cache."""


def apply_stencil(stencil: Float[ndarray, "9 h w"], x: Float[ndarray, "h w"]) -> Float[ndarray, "h w"]:
    """Return the left sides of the equations: for each pixel, the sum of coefficients times neighbors."""
    height, width = x.shape
    padded = np.pad(x, 1)
    result = np.zeros_like(x)
    for coefficients, (row, column) in zip(stencil, NEIGHBORS, strict=True):
        result += coefficients * padded[1 + row : 1 + row + height, 1 + column : 1 + column + width]
    return result


class StencilSolver:
    """The factors of a grid of equations (in the order of `NEIGHBORS`, 0 out of the image), ready for right sides."""

    def __init__(self, stencil: Float[ndarray, "9 h w"], dtype: torch.dtype = torch.float32) -> None:
        self._leaves = _Leaves(stencil, dtype)
        fronts = self._leaves.fronts()
        cell, outline = self._leaves.cell, _outline(*self._leaves.cell)
        self._merges: list[_Merge] = []
        while fronts.shape[0] > 1 or fronts.shape[1] > 1:
            merge = _Merge(cell, outline, fronts.shape[0], fronts.shape[1])
            fronts = merge.eliminate(fronts)
            self._merges.append(merge)
            cell, outline = merge.merged, merge.outline

    def solve(self, right: Float[ndarray, "h w"]) -> Float[ndarray, "h w"]:
        """Return the solution for a right side, as exact as ``dtype`` is."""
        values = self._leaves.forward(right)
        for merge in self._merges:
            values = merge.forward(values)
        # What is left lies around the image: nothing, or the outline of the only cell.
        values = values[..., :0] if self._merges else torch.zeros_like(values)
        for merge in reversed(self._merges):
            values = merge.backward(values)
        return self._leaves.backward(values)


def _outline(height: int, width: int) -> list[Place]:
    """Return the places of the lines around a cell; those of one line lie in a row, from left to right or down."""
    above_and_below = itertools.product((0, height), range(width + 1))
    left_and_right = ((row, column) for column in (0, width) for row in range(1, height))
    return [*above_and_below, *left_and_right]


def _runs(places: Sequence[tuple[int, int]]) -> list[Run]:
    """Group pairs of positions that go up together into pairs of slices."""
    found: list[Run] = []
    for _, group in itertools.groupby(enumerate(places), lambda item: (item[1][0] - item[0], item[1][1] - item[0])):
        run = [pair for _, pair in group]
        found.append((slice(run[0][0], run[-1][0] + 1), slice(run[0][1], run[-1][1] + 1)))
    return found


def _cells(length: int) -> tuple[int, int]:
    """Return (pixels a cell and its line, number of cells): a power of two cells, as little larger as can be."""
    sizes = [(-(-(length + 1) // 2**power), 2**power) for power in range(20)]
    fitting = [(size, count) for size, count in sizes if 5 <= size <= 9] or [(length + 1, 1)]
    return min(fitting, key=lambda cell: (cell[0] * cell[1], cell))


class _Leaves:
    """The smallest cells; pixel by pixel, the same place in all cells at once, what lies inside is eliminated."""

    def __init__(self, stencil: Float[ndarray, "9 h w"], dtype: torch.dtype) -> None:
        self.size = (stencil.shape[1], stencil.shape[2])
        (cell_h, self.rows), (cell_w, self.columns) = _cells(self.size[0]), _cells(self.size[1])
        self.cell = (cell_h, cell_w)
        self.places = list(itertools.product(range(cell_h + 1), range(cell_w + 1)))
        self.nothing = torch.zeros(self.rows, self.columns, dtype=dtype)
        planes = [self._plane(coefficients, float(k == 4)) for k, coefficients in enumerate(stencil)]
        # An equation between two places of a line belongs to one of the two cells beside it: that above or left.
        self._left: dict[tuple[Place, Place], Tensor] = {}
        for row, column in self.places:
            for plane, (down, right) in zip(planes, NEIGHBORS, strict=True):
                other = (row + down, column + right)
                inside = 0 <= other[0] <= cell_h and 0 <= other[1] <= cell_w
                if inside and (row or other[0]) and (column or other[1]):
                    self._left[(row, column), other] = self._at(plane, (row, column)).clone()
        self._steps = [self._eliminate(place) for place in _dissected(1, cell_h, 1, cell_w)]

    def _plane(self, values: Float[ndarray, "h w"], outside: float) -> Tensor:
        """Return values as (row in cell, column in cell, cell row, cell column); pixels outside stand alone."""
        (cell_h, cell_w), (height, width) = self.cell, self.size
        sides = ((self.rows + 1) * cell_h, (self.columns + 1) * cell_w)
        padded = torch.full(sides, outside, dtype=self.nothing.dtype)
        padded[1 : height + 1, 1 : width + 1] = torch.from_numpy(values)
        return padded.view(self.rows + 1, cell_h, self.columns + 1, cell_w).permute(1, 3, 0, 2).contiguous()

    def _at(self, plane: Tensor, place: Place) -> Tensor:
        """Return the values of one place in all cells."""
        (row, i), (column, j) = divmod(place[0], self.cell[0]), divmod(place[1], self.cell[1])
        return plane[i, j, row : row + self.rows, column : column + self.columns]

    def _eliminate(self, pivot: Place) -> tuple[Place, Tensor, dict[Place, Tensor], dict[Place, Tensor]]:
        left = self._left
        others = sorted(b for a, b in left if a == pivot and b != pivot)
        inverse = left.pop((pivot, pivot)).reciprocal_()
        upper = {other: left.pop((pivot, other)).mul_(inverse) for other in others}
        lower = {other: left.pop((other, pivot)) for other in others}
        for a, b in itertools.product(others, others):
            if (a, b) in left:
                left[a, b].addcmul_(lower[a], upper[b], value=-1)
            else:
                left[a, b] = (lower[a] * upper[b]).neg_()
        return pivot, inverse, lower, upper

    def fronts(self) -> Tensor:
        """Return what is left between the places of each cell's outline: cell rows x cell columns x n x n."""
        outline = _outline(*self.cell)
        stacked = [torch.stack([self._left.get((a, b), self.nothing) for b in outline], -1) for a in outline]
        self._left.clear()
        return torch.stack(stacked, -2)

    def forward(self, right: Float[ndarray, "h w"]) -> Tensor:
        """Eliminate in a right side; returns what is left for each outline."""
        plane = self._plane(right, 0.0)
        values = {place: (self._at(plane, place) if all(place) else self.nothing).clone() for place in self.places}
        for pivot, inverse, lower, _ in self._steps:
            values[pivot].mul_(inverse)
            for other, coefficient in lower.items():
                values[other].addcmul_(coefficient, values[pivot], value=-1)
        self._inside = {pivot: values[pivot] for pivot, *_ in self._steps}
        return torch.stack([values[place] for place in _outline(*self.cell)], -1)

    def backward(self, values: Tensor) -> Float[ndarray, "h w"]:
        """Return the solution, given that on the outlines."""
        known = {place: values[..., i].contiguous() for i, place in enumerate(_outline(*self.cell))}
        for pivot, _, _, upper in reversed(self._steps):
            known[pivot] = self._inside[pivot]
            for other, coefficient in upper.items():
                known[pivot].addcmul_(coefficient, known[other], value=-1)
        plane = values.new_empty(*self.cell, self.rows + 1, self.columns + 1)
        for place, value in known.items():
            if all(place):
                self._at(plane, place).copy_(value)
        full = plane.permute(2, 0, 3, 1).reshape((self.rows + 1) * self.cell[0], (self.columns + 1) * self.cell[1])
        return np.asarray(full[1 : self.size[0] + 1, 1 : self.size[1] + 1].numpy())


def _dissected(top: int, bottom: int, left: int, right: int) -> list[Place]:
    """Return the places of a rectangle so that the line which halves it comes last, and so on inside the halves."""
    height, width = bottom - top, right - left
    if height <= 0 or width <= 0:
        return []
    if height >= width:
        middle = (top + bottom) // 2
        line = [(middle, column) for column in range(left, right)]
        return _dissected(top, middle, left, right) + _dissected(middle + 1, bottom, left, right) + line
    middle = (left + right) // 2
    line = [(row, middle) for row in range(top, bottom)]
    return _dissected(top, bottom, left, middle) + _dissected(top, bottom, middle + 1, right) + line


class _Merge:
    """One level: cells become one with their right or lower neighbor, and the line between is eliminated."""

    def __init__(self, cell: tuple[int, int], outline: list[Place], rows: int, columns: int) -> None:
        height, width = cell
        self.down = rows > 1 and (height <= width or columns == 1)
        step = (height, 0) if self.down else (0, width)
        self.before = (rows, columns, len(outline))
        self.rows, self.columns = (rows // 2, columns) if self.down else (rows, columns // 2)
        self.merged = (height + step[0], width + step[1])
        # Lines at the border of the image lie outside it and take no part once a cell spans the image.
        self.outline = [
            (row, column)
            for row, column in _outline(*self.merged)
            if (self.rows > 1 or 0 < row < self.merged[0]) and (self.columns > 1 or 0 < column < self.merged[1])
        ]
        line = [(height, c) for c in range(1, width)] if self.down else [(r, width) for r in range(1, height)]
        self.inner = len(line)
        position = {place: i for i, place in enumerate([*line, *self.outline])}
        self._runs = [
            _runs([(i, position[p]) for i, (r, c) in enumerate(outline) if (p := (r + dy, c + dx)) in position])
            for dy, dx in ((0, 0), step)
        ]
        self._size = len(position)

    def _halves(self, stack: Tensor) -> tuple[Tensor, Tensor]:
        return (stack[0::2], stack[1::2]) if self.down else (stack[:, 0::2], stack[:, 1::2])

    def eliminate(self, fronts: Tensor) -> Tensor:
        """Merge and eliminate; returns what is left between the places of each merged cell's outline."""
        n, m = self._size, self.inner
        r = n - m
        self._inverse, self._upper, self._lower, left = results = [
            fronts.new_empty(self.rows, self.columns, *sides) for sides in ((m, m), (m, r), (r, m), (r, r))
        ]
        halves = self._halves(fronts)
        step = max(1, _CHUNK // (n * n * self.columns))
        for start in range(0, self.rows, step):
            rows = slice(start, min(start + step, self.rows))
            front = fronts.new_zeros(rows.stop - rows.start, self.columns, n, n)
            for half, runs in zip(halves, self._runs, strict=True):
                for (from_a, to_a), (from_b, to_b) in itertools.product(runs, runs):
                    front[:, :, to_a, to_b] += half[rows, :, from_a, from_b]
            flat = front.view(-1, n, n)
            inverse = torch.linalg.inv(flat[:, :m, :m])
            lower = flat[:, m:, :m].contiguous()
            upper = inverse @ flat[:, :m, m:]
            rest = torch.baddbmm(flat[:, m:, m:], lower, upper, alpha=-1)
            for whole, part in zip(results, (inverse, upper, lower, rest), strict=True):
                whole[rows] = part.view(whole[rows].shape)
        return left

    def forward(self, values: Tensor) -> Tensor:
        """Eliminate in a right side; returns what is left for each outline."""
        joined = values.new_zeros(self.rows, self.columns, self._size)
        for half, runs in zip(self._halves(values), self._runs, strict=True):
            for source, target in runs:
                joined[..., target] += half[..., source]
        self._inside = (self._inverse @ joined[..., : self.inner, None])[..., 0]
        return joined[..., self.inner :] - (self._lower @ self._inside[..., None])[..., 0]

    def backward(self, values: Tensor) -> Tensor:
        """Return the solution on the outlines before the merge, given that on those after it."""
        inside = self._inside - (self._upper @ values[..., None])[..., 0]
        joined = torch.cat([inside, values], -1)
        before = values.new_zeros(self.before)
        for half, runs in zip(self._halves(before), self._runs, strict=True):
            for source, target in runs:
                half[..., source] = joined[..., target]
        return before
