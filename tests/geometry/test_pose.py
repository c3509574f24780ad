"""Rigid motions against Monodepth2's numbers, SciPy, and their own inverse; gradients at angle zero."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from saunet.geometry.pose import axisangle_to_matrix, invert_pose, pose_matrix

ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.05, 0.0999, 0.1001, 0.5, 3.1, np.pi, 4.0]


def test_reference(reference: Callable[[str], Mapping[str, Any]]) -> None:
    data = {key: torch.from_numpy(value) for key, value in reference("pose").items()}
    plain = pose_matrix(data["axisangle"], data["translation"])
    inverse = pose_matrix(data["axisangle"], data["translation"], invert=True)
    torch.testing.assert_close(plain, data["matrix"], rtol=0, atol=1e-6)
    torch.testing.assert_close(inverse, data["matrix_inverted"], rtol=0, atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_against_scipy(angle: float) -> None:
    axis = np.array([0.48, -0.6, 0.64])
    expected = Rotation.from_rotvec(axis * angle).as_matrix()
    exact = axisangle_to_matrix(torch.from_numpy(axis * angle)).numpy()
    np.testing.assert_allclose(exact, expected, rtol=0, atol=1e-14)
    single = axisangle_to_matrix(torch.from_numpy(axis * angle).float()).numpy()
    np.testing.assert_allclose(single, expected, rtol=0, atol=5e-7)


@pytest.mark.parametrize("angle", ANGLES)
def test_gradcheck(angle: float) -> None:
    axisangle = (torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64) * angle).requires_grad_()
    assert torch.autograd.gradcheck(axisangle_to_matrix, axisangle, eps=1e-7)


def test_gradient_at_zero_is_the_generator() -> None:
    jacobian = torch.autograd.functional.jacobian(axisangle_to_matrix, torch.zeros(3))
    expected = torch.zeros(3, 3, 3)
    for axis, (row, column) in enumerate([(2, 1), (0, 2), (1, 0)]):
        expected[row, column, axis], expected[column, row, axis] = 1, -1
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=0)


def test_second_derivative_is_finite_at_zero() -> None:
    axisangle = torch.zeros(3, requires_grad=True)
    (first,) = torch.autograd.grad(axisangle_to_matrix(axisangle).trace(), axisangle, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), axisangle)
    torch.testing.assert_close(second, torch.full((3,), -2.0))


def test_inverse_undoes_the_motion() -> None:
    pose = pose_matrix(torch.randn(2, 5, 3), torch.randn(2, 5, 3))
    torch.testing.assert_close(invert_pose(pose) @ pose, torch.eye(4).expand(2, 5, 4, 4), rtol=0, atol=1e-5)
    torch.testing.assert_close(invert_pose(invert_pose(pose)), pose, rtol=0, atol=1e-5)


def test_pose_gradcheck() -> None:
    axisangle = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
    translation = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, t: pose_matrix(a, t, invert=True), (axisangle, translation))


def test_full_precision_inside_autocast() -> None:
    axisangle, translation = torch.randn(4, 3), torch.randn(4, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = pose_matrix(axisangle, translation, invert=True)
    assert inside.dtype == torch.float32
    torch.testing.assert_close(inside, pose_matrix(axisangle, translation, invert=True), rtol=0, atol=0)
