"""Rigid motions against Monodepth2's numbers, SciPy, and their own inverse; gradients at angle zero."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from saunet.geometry.pose import axisangle_to_matrix, invert_pose, pose_matrix, scaled_motion

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


def test_length_is_that_of_depth() -> None:
    T = pose_matrix(torch.randn(2, 3, 3), torch.tensor([0.0, 0.6, 0.8]).expand(2, 3, 3))
    T[0, 1, :3, 3] = 0  # stands still
    T[1, 2] = torch.nan
    depth = torch.arange(2 * 6 * 8, dtype=torch.float32).reshape(2, 1, 6, 8) + 1
    points = torch.full((2, 3, 5, 3), torch.nan)
    points[:, :, 0] = torch.tensor([2.4, 0.6, 1.0])  # column 2, row 1: depth 11 and 59
    points[:, :, 1] = torch.tensor([7.6, 5.0, 1e-3])  # outside
    points[0, 2, 2] = torch.tensor([7.0, 5.0, 48 / 11])  # the same length: depth 48
    points[0, 2, 3] = torch.tensor([0.0, 0.0, 1e-6])  # a length of a million, which counts nothing
    points[1, 0, :2] = torch.nan
    found = scaled_motion(T, points, depth.requires_grad_())
    lengths = found[..., :3, 3].norm(dim=-1)
    torch.testing.assert_close(lengths[0], torch.tensor([11.0, 0.0, 11.0]), rtol=1e-3, atol=0)
    assert lengths[1].isnan().tolist() == [True, False, True]
    torch.testing.assert_close(lengths[1, 1], torch.tensor(59.0))
    torch.testing.assert_close(found[0, :, :3, :3], T[0, :, :3, :3])
    torch.where(found.isfinite(), found.nan_to_num(), 0.0).sum().backward()
    assert depth.grad is not None
    assert depth.grad.isfinite().all()
    twice = scaled_motion(T, points, 2 * depth)[..., :3, 3]
    torch.testing.assert_close(twice, 2 * found[..., :3, 3], equal_nan=True)


def test_length_gradcheck() -> None:
    T = pose_matrix(torch.randn(2, 1, 3).double(), torch.randn(2, 1, 3).double())
    place = torch.rand(2, 1, 6, 3).double() * torch.tensor([7.0, 5.0, 0.2])
    points = place + torch.tensor([0, 0, 1.0])
    # All ratios are about the same, so that the weights, which have no gradient, hardly change.
    depth = (3 + 1e-3 * torch.rand(2, 1, 6, 8).double()).requires_grad_()
    points[..., 2] = 1
    assert torch.autograd.gradcheck(lambda given: scaled_motion(T, points, given), depth, atol=1e-3)
