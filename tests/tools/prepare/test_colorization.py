from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from saunet.errors import DataError
from saunet.tools.prepare.colorization import affinity, colorize


def naive(gray, depth):
    """The toolbox's loop over pixels and a general sparse solver, written from the paper's description."""
    height, width = gray.shape
    rows, columns, values = [], [], []
    for y in range(height):
        for x in range(width):
            neighbors = [
                (y + dy, x + dx)
                for dy in (-1, 0, 1)
                for dx in (-1, 0, 1)
                if (dy or dx) and 0 <= y + dy < height and 0 <= x + dx < width
            ]
            around = np.array([gray[place] for place in neighbors])
            variance = np.append(around, gray[y, x]).var()
            differences = (around - gray[y, x]) ** 2
            spread = max(0.6 * variance, -differences.min() / np.log(0.01), 2e-6)
            weights = np.exp(-differences / spread)
            for place, weight in zip(neighbors, weights / weights.sum(), strict=True):
                rows.append(y * width + x)
                columns.append(place[0] * width + place[1])
                values.append(-weight)
            rows.append(y * width + x)
            columns.append(y * width + x)
            values.append(1.0 + (depth[y, x] > 0))
    matrix = scipy.sparse.csc_matrix((values, (rows, columns)), shape=(gray.size, gray.size))
    top = depth.max()
    solved = scipy.sparse.linalg.spsolve(matrix, depth.astype(np.float64).ravel() / top).reshape(gray.shape) * top
    return np.where(depth > 0, depth, solved)


def scene(height, width, share, seed=0):
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3), np.uint8)
    image[:, width // 2 :] = 150
    image[height // 2 :] += 60
    image += rng.integers(0, 8, image.shape, dtype=np.uint8)
    truth = np.linspace(40, 4, height)[:, None] + np.where(np.arange(width) < width // 2, 0, 10)
    depth = np.where(rng.random((height, width)) < share, truth, 0).astype(np.float32)
    depth[height - 1, 1] = 4.0
    return image, depth


def gray_of(image):
    return image @ (np.array([0.299, 0.587, 0.114]) / 255)


@pytest.mark.parametrize(("size", "share"), [((24, 37), 0.05), ((40, 11), 0.3), ((2, 5), 0.5), ((30, 50), 0.002)])
def test_equals_loops_and_a_sparse_solver(size, share):
    image, depth = scene(*size, share)
    expected = naive(gray_of(image), depth)
    assert np.abs(colorize(image, depth) / expected - 1).max() < 2e-5


def test_measured_values_stay_and_edges_stop_depth():
    image, depth = scene(30, 40, 0.0)
    depth[:] = 0
    depth[15:, 3], depth[15:, 36] = 5.0, 50.0
    image[:] = 20
    image[:, 20:] = 220
    dense = colorize(image, depth)
    assert (dense[depth > 0] == depth[depth > 0]).all()
    assert np.abs(dense[:, :19] - 5).max() < 1
    assert np.abs(dense[:, 21:] - 50).max() < 5


def test_weights_of_a_pixel_sum_to_one_and_stay_inside():
    weights = affinity(np.random.default_rng(0).random((7, 9)))
    assert np.allclose(weights.sum(0), 1)
    assert (weights[4] == 0).all()
    assert (weights[:3, 0] == 0).all()
    assert (weights[2::3, :, -1] == 0).all()
    assert np.allclose(affinity(np.full((5, 5), 0.4))[:, 2, 2], np.array([1, 1, 1, 1, 0, 1, 1, 1, 1]) / 8)


def test_a_constant_image_and_one_measurement_fill_the_picture():
    depth = np.zeros((12, 20), np.float32)
    depth[6, 6] = 7.0
    assert np.allclose(colorize(np.full((12, 20, 3), 99, np.uint8), depth), 7.0, rtol=1e-4)


def test_what_cannot_work_is_one_sentence():
    with pytest.raises(DataError, match="no known pixel"):
        colorize(np.zeros((5, 5, 3), np.uint8), np.zeros((5, 5), np.float32))
    with pytest.raises(DataError, match="does not belong to an image"):
        colorize(np.zeros((5, 6, 3), np.uint8), np.ones((5, 5), np.float32))


@pytest.mark.slow
def test_a_real_scan_equals_a_sparse_solver(kitti_mini):
    from saunet.data.kitti.raw import KittiRaw
    from saunet.tools.prepare.colorization import NEIGHBORS

    drive = KittiRaw(kitti_mini / "raw").drive("2011_09_26/2011_09_26_drive_9015_sync")
    image, depth = drive.image(10), drive.depth(10)
    weights = affinity(gray_of(image))
    size = depth.size
    place = np.pad(np.arange(size).reshape(depth.shape), 1, constant_values=-1)
    height, width = depth.shape
    rows, columns, values = [], [], []
    for weight, (dy, dx) in zip(weights, NEIGHBORS, strict=True):
        to = place[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        rows.append(place[1:-1, 1:-1][to >= 0])
        columns.append(to[to >= 0])
        values.append(-weight[to >= 0])
    matrix = scipy.sparse.csc_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))))
    matrix += scipy.sparse.diags(1.0 + (depth > 0).ravel())
    options = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    solved = scipy.sparse.linalg.splu(matrix.tocsc(), **options).solve(depth.astype(np.float64).ravel())
    expected = np.where(depth > 0, depth, solved.reshape(depth.shape))
    assert np.abs(colorize(image, depth) / expected - 1).max() < 1e-4
