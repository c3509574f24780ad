from __future__ import annotations

import numpy as np
import pytest
import torch

from saunet.tools.prepare.sparse_solver import NEIGHBORS, StencilSolver, apply_stencil


def equations(height, width, excess=1e-3, seed=0):
    """Random directed diffusion with a little loss everywhere: not symmetric, barely dominant."""
    rng = np.random.default_rng(seed)
    stencil = -(rng.random((9, height, width)) ** 6)
    for k, (row, column) in enumerate(NEIGHBORS):
        if row:
            stencil[k, 0 if row < 0 else -1] = 0
        if column:
            stencil[k, :, 0 if column < 0 else -1] = 0
    stencil[4] = 0
    stencil[4] = excess - stencil.sum(0)
    return stencil


def dense(stencil):
    _, height, width = stencil.shape
    matrix = np.zeros((height * width, height * width))
    for y in range(height):
        for x in range(width):
            for k, (row, column) in enumerate(NEIGHBORS):
                if 0 <= y + row < height and 0 <= x + column < width:
                    matrix[y * width + x, (y + row) * width + x + column] = stencil[k, y, x]
    return matrix


@pytest.mark.parametrize("size", [(2, 2), (3, 40), (40, 3), (17, 23), (9, 9), (31, 20), (1, 30), (16, 47)])
def test_equals_a_dense_solve(size):
    stencil = equations(*size)
    right = np.random.default_rng(1).normal(size=size)
    expected = np.linalg.solve(dense(stencil), right.ravel()).reshape(size)
    solver = StencilSolver(stencil, torch.float64)
    assert np.allclose(solver.solve(right), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    other = np.random.default_rng(2).normal(size=size)  # the factors are not used up
    expected = np.linalg.solve(dense(stencil), other.ravel()).reshape(size)
    assert np.allclose(solver.solve(other), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_sides_are_the_equations():
    stencil = equations(6, 7)
    x = np.random.default_rng(3).normal(size=(6, 7))
    assert np.allclose(apply_stencil(stencil, x).ravel(), dense(stencil) @ x.ravel())


def test_thirty_two_bits_are_near_enough_to_be_refined():
    stencil = equations(60, 90)
    right = np.random.default_rng(1).random((60, 90))
    solver = StencilSolver(stencil)
    x = np.zeros_like(right)
    for _ in range(4):
        x += solver.solve(right - apply_stencil(stencil, x))
    exact = StencilSolver(stencil, torch.float64).solve(right)
    assert np.abs(x - exact).max() < 1e-8 * np.abs(exact).max()
