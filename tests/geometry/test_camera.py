"""Intrinsics follow resize, crop and flip: checked by projecting 3-D points before and after."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from saunet.geometry.camera import crop_intrinsics, flip_intrinsics, scale_intrinsics

number = st.floats(-1.0, 1.0, allow_nan=False)
intrinsics = st.builds(
    lambda fx, fy, skew, cx, cy: torch.tensor([[fx, skew, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
    st.floats(50, 900),
    st.floats(50, 900),
    st.floats(-5, 5),
    st.floats(-20, 700),
    st.floats(-20, 300),
)
points = st.builds(
    lambda x, y, z: torch.tensor([x, y, z], dtype=torch.float64), st.floats(-9, 9), st.floats(-9, 9), st.floats(0.5, 80)
)
quick = settings(max_examples=40, deadline=None)


def pixel(K: Tensor, point: Tensor) -> Tensor:
    seen = K @ point
    return seen[:2] / seen[2]


@quick
@given(intrinsics, points, st.floats(0.1, 4), st.floats(0.1, 4))
def test_resize_moves_pixel_centers(K: Tensor, point: Tensor, sx: float, sy: float) -> None:
    scale = torch.tensor([sx, sy], dtype=torch.float64)
    expected = (pixel(K, point) + 0.5) * scale - 0.5
    torch.testing.assert_close(pixel(scale_intrinsics(K, sx, sy), point), expected, rtol=1e-9, atol=1e-6)


@quick
@given(intrinsics, points, st.integers(-50, 200), st.integers(-50, 200))
def test_crop_shifts_pixels(K: Tensor, point: Tensor, left: int, top: int) -> None:
    expected = pixel(K, point) - torch.tensor([left, top], dtype=torch.float64)
    torch.testing.assert_close(pixel(crop_intrinsics(K, left, top), point), expected, rtol=1e-9, atol=1e-6)


@quick
@given(intrinsics, points, st.integers(2, 1400))
def test_flip_shows_the_mirrored_world(K: Tensor, point: Tensor, width: int) -> None:
    u, v = pixel(K, point)
    mirrored = point * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    expected = torch.stack((width - 1 - u, v))
    torch.testing.assert_close(pixel(flip_intrinsics(K, width), mirrored), expected, rtol=1e-9, atol=1e-6)


@quick
@given(intrinsics, st.integers(2, 1400), st.floats(0.1, 4))
def test_flip_undoes_itself_and_commutes_with_resize(K: Tensor, width: int, scale: float) -> None:
    torch.testing.assert_close(flip_intrinsics(flip_intrinsics(K, width), width), K)
    one = scale_intrinsics(flip_intrinsics(K, width), scale, scale)
    other = flip_intrinsics(scale_intrinsics(K, scale, scale), width * scale)
    torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-6)


def test_one_number_per_item() -> None:
    K = torch.tensor([[100.0, 0, 50], [0, 90, 20], [0, 0, 1]]).expand(2, 3, 3)
    scales, cuts, widths = torch.tensor([1.0, 0.5]), torch.tensor([0.0, 8.0]), torch.tensor([101.0, 64.0])
    for i in range(2):
        torch.testing.assert_close(
            scale_intrinsics(K, scales, 2 * scales)[i], scale_intrinsics(K[i], float(scales[i]), 2 * float(scales[i]))
        )
        torch.testing.assert_close(
            crop_intrinsics(K, cuts, cuts)[i], crop_intrinsics(K[i], float(cuts[i]), float(cuts[i]))
        )
        torch.testing.assert_close(flip_intrinsics(K, widths)[i], flip_intrinsics(K[i], float(widths[i])))


def test_half_precision_arrives_as_float32() -> None:
    K = torch.tensor([[100.0, 0, 50], [0, 90, 20], [0, 0, 1]], dtype=torch.bfloat16)
    assert flip_intrinsics(K, 9).dtype == torch.float32


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_any_batch_shape(batch: tuple[int, ...]) -> None:
    K = torch.eye(3).expand(*batch, 3, 3)
    for moved in (scale_intrinsics(K, 2, 2), crop_intrinsics(K, 1, 1), flip_intrinsics(K, 9)):
        assert moved.shape == K.shape
