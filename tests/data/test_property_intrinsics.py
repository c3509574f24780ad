"""K is right after any resize, crop, translation and flip: a 3-D point is seen where its picture went."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from drives import NumberDrive
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from saunet.data.kitti.files import read_calibration
from saunet.data.loading.transforms import Augment, Prepare
from saunet.data.loading.windows import Item, WindowDataset, collate

unit = st.floats(0, 0.999)


class PointDrive(NumberDrive):
    """Sees one 3-D point as a soft white blob, at exactly where K projects it."""

    def __init__(self, point, K, size):
        super().__init__(size=size, indices=range(3))
        self.K, self.u = K, (K @ point)[:2] / point[2]
        rows, columns = np.mgrid[: size[0], : size[1]]
        self.radius = max(size) / 40
        blob = np.exp(-((columns - self.u[0]) ** 2 + (rows - self.u[1]) ** 2) / (2 * self.radius**2))
        self.picture = np.round(255 * blob).astype(np.uint8)[..., None].repeat(3, -1)
        self.truth_map = np.zeros(size, np.float32)
        inside = (self.u >= 0).all() and self.u[0] <= size[1] - 1 and self.u[1] <= size[0] - 1
        if inside:
            self.truth_map[round(self.u[1]), round(self.u[0])] = point[2]

    def image(self, index):
        return self.picture

    def intrinsics(self, index):
        return self.K

    def depth(self, index):
        return self.truth_map


def check(point, K, size, height, width, translate, draws, flip):
    drive = PointDrive(point, K, size)
    margin = (round(height * translate), round(width * translate))
    data = WindowDataset(
        [drive], [(0, 1)], offsets=(-1, 1), height=height, width=width, margin=margin, with_target_depth=True
    )
    batch = collate([data[Item(0, 0)]])
    batch["draws"] = torch.tensor([[*draws, 0, 0.5, 0.5, 0.5, 0.5, 0.5]])
    batch["draws"][0, 2] = 0.0 if flip else 0.9
    out = Augment(height, width, flip_prob=0.5, color_jitter_prob=0.0)(batch)
    moved = np.array([-point[0], point[1], point[2]]) if flip else point
    expected = (out["K"][0].double().numpy() @ moved)[:2] / moved[2]
    # the whole blob must be in the window, else its center of mass is not its center
    reach = 4 * drive.radius * np.array([(width + margin[1]) / size[1], (height + margin[0]) / size[0]]) + 1.5
    assume((expected > reach).all() and (expected < np.array([width, height]) - 1 - reach).all())
    for image in (out["target"][0, 0], out["loss_sources"][0, 1, 2]):
        mass = image.double().numpy()
        rows, columns = np.mgrid[:height, :width]
        center = np.array([(mass * columns).sum(), (mass * rows).sum()]) / mass.sum()
        assert np.abs(center - expected).max() < 0.06, (center, expected)
    ((row, column),) = np.argwhere(out["target_depth"][0, 0].numpy() > 0)
    scale = max(1.0, (width + margin[1]) / size[1], (height + margin[0]) / size[0])
    assert np.abs(np.array([column, row]) - expected).max() < 0.6 + 0.5 * scale
    assert out["target_depth"].max() == pytest.approx(point[2])


@settings(max_examples=60, deadline=None)
@given(
    size=st.tuples(st.integers(60, 120), st.integers(80, 200)),
    target=st.tuples(st.integers(40, 100), st.integers(50, 160)),
    seen_at=st.tuples(st.floats(0.3, 0.7), st.floats(0.3, 0.7)),
    focal=st.floats(0.5, 1.5),
    center=st.tuples(st.floats(0.35, 0.65), st.floats(0.35, 0.65)),
    depth=st.floats(1, 80),
    translate=st.floats(0, 0.3),
    draws=st.tuples(unit, unit),
    flip=st.booleans(),
)
def test_a_point_is_seen_where_its_picture_went(size, target, seen_at, focal, center, depth, translate, draws, flip):
    rows, columns = size
    K = np.array([[focal * columns, 0, center[0] * columns], [0, focal * columns, center[1] * rows], [0, 0, 1]])
    pixel = np.array([seen_at[0] * columns, seen_at[1] * rows, 1])
    check(depth * np.linalg.solve(K, pixel), K, size, *target, translate, draws, flip)


@settings(max_examples=8, deadline=None)
@given(
    seen_at=st.tuples(st.floats(0.35, 0.65), st.floats(0.35, 0.65)),
    target=st.sampled_from([(192, 640), (96, 320), (128, 416), (101, 331), (400, 1300)]),
    translate=st.floats(0, 0.2),
    draws=st.tuples(unit, unit),
    flip=st.booleans(),
)
def test_with_the_real_calibration(kitti_mini, seen_at, target, translate, draws, flip):
    K = read_calibration(kitti_mini / "raw" / "2011_09_26").intrinsics(2)
    pixel = np.array([seen_at[0] * 1242, seen_at[1] * 375, 1])
    drive_like = 12.5 * np.linalg.solve(K, pixel)
    check(drive_like, K, (375, 1242), *target, translate, draws, flip)


@settings(max_examples=20, deadline=None)
@given(
    margin=st.tuples(st.integers(0, 9), st.integers(0, 9)), seen_at=st.tuples(st.floats(0.4, 0.6), st.floats(0.4, 0.6))
)
def test_in_the_middle_window_of_evaluation(margin, seen_at):
    K = np.array([[80.0, 0, 50], [0, 80, 40], [0, 0, 1]])
    drive = PointDrive(np.linalg.solve(K, [seen_at[0] * 100, seen_at[1] * 80, 1]), K, (80, 100))
    batch = collate([WindowDataset([drive], [(0, 1)], offsets=(), height=40, width=60, margin=margin)[0]])
    out = Prepare(40, 60)(batch)
    mass = out["target"][0, 0].double().numpy()
    rows, columns = np.mgrid[:40, :60]
    center = np.array([(mass * columns).sum(), (mass * rows).sum()]) / mass.sum()
    point = np.linalg.solve(K, [seen_at[0] * 100, seen_at[1] * 80, 1])
    assert (out["K"][0].double().numpy() @ point)[:2] == pytest.approx(center, abs=0.06)
