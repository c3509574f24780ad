"""Points in space from depth and true intrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from saunet.errors import ConfigError
from saunet.prediction.pointcloud import Camera, PointCloud, point_cloud
from saunet.prediction.prediction import Prediction
from saunet.runs.record import Scale


def ground(height: int = 60, width: int = 80) -> tuple[Prediction, Camera]:
    """A camera 1.5 above a flat road, looking straight ahead; sky above the horizon."""
    camera = Camera.from_numbers((70.0, 65.0, 40.3, 20.0), height, width)
    rows = np.arange(height, dtype=np.float32)[:, None] - 20.0
    depth = np.where(rows > 0, 65.0 * 1.5 / np.maximum(rows, 1e-3), 1000.0) * np.ones((1, width))
    image = np.zeros((height, width, 3), np.uint8)
    image[:, :, 0] = np.arange(height)[:, None]
    depth = depth.astype(np.float32)
    return Prediction(depth, 1 / depth, image, Scale(1.0, "construction")), camera


def read_ply(path: Path) -> tuple[list[str], NDArray[np.float32], NDArray[np.uint8]]:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    vertices = np.frombuffer(body, dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    return header.decode().splitlines(), vertices["xyz"], vertices["rgb"]


def test_a_flat_road_is_flat_and_colored() -> None:
    prediction, camera = ground()
    cloud = point_cloud(prediction, camera, max_depth=100.0, edge=0.0)
    assert len(cloud.points) == 39 * 80
    assert np.allclose(cloud.points[:, 1], 1.5, atol=1e-4)
    row = np.round(65.0 * 1.5 / cloud.points[:, 2] + 20)
    assert np.array_equal(cloud.colors[:, 0], row.astype(np.uint8))
    u = cloud.points[:, 0] / cloud.points[:, 2] * 70 + 40.3
    assert np.allclose(u, np.round(u), atol=1e-3)


def test_intrinsics_of_another_size_are_scaled() -> None:
    prediction, camera = ground()
    double = camera.resized(120, 160)
    assert double.K[0, 2] == pytest.approx((40.3 + 0.5) * 2 - 0.5)
    assert np.allclose(double.resized(60, 80).K, camera.K)
    there = point_cloud(prediction, double, max_depth=100.0)
    assert np.allclose(there.points, point_cloud(prediction, camera, max_depth=100.0).points, atol=1e-4)


def test_stride() -> None:
    prediction, camera = ground()
    assert len(point_cloud(prediction, camera, stride=4, edge=0.0).points) == 15 * 20


def missing(*nearness: float, edge: float = 0.1) -> list[int]:
    """Return which columns of a picture of 320 pixels have no points, given the disparity of nine of them."""
    row = np.full(320, nearness[0], np.float32)
    row[100:109], row[109:] = nearness, nearness[-1]
    disparity = np.tile(row, (60, 1))
    prediction = Prediction(1 / disparity, disparity, np.zeros((60, 320, 3), np.uint8))
    camera = Camera.from_numbers((300.0, 300.0, 159.5, 29.5), 60, 320)
    points = point_cloud(prediction, camera, edge=edge).points
    return sorted({*range(320)} - {*np.round(points[:, 0] / points[:, 2] * 300 + 159.5).astype(int).tolist()})


def test_what_floats_between_two_surfaces_is_left_out() -> None:
    ramp = (0.05, 0.05, 0.05, 0.08, 0.125, 0.17, 0.2, 0.2, 0.2)
    assert missing(*ramp) == [103, 104, 105]
    assert missing(*ramp, edge=0.0) == []
    assert missing(*reversed(ramp)) == [103, 104, 105]


def test_both_sides_of_a_sharp_edge_are_kept() -> None:
    assert missing(0.05, 0.05, 0.05, 0.05, 0.05, 0.2, 0.2, 0.2, 0.2) == []


def test_a_thin_near_post_is_kept() -> None:
    assert missing(0.05, 0.05, 0.05, 0.1, 0.2, 0.1, 0.05, 0.05, 0.05) == [103, 105]


def test_a_road_far_away_is_kept() -> None:
    """Its depth changes by a tenth and more from row to row, and it is no edge."""
    rows = np.maximum(np.arange(120, dtype=np.float32) - 40.0, 5.0)
    disparity = np.tile(rows[:, None] / 500, (1, 320))
    prediction = Prediction(1 / disparity, disparity, np.zeros((120, 320, 3), np.uint8))
    cloud = point_cloud(prediction, Camera.from_numbers((300.0, 300.0, 159.5, 39.5), 120, 320))
    assert len(cloud.points) == 120 * 320
    assert len(prediction.point_cloud(90, edge=0).points) == 120 * 320


def test_ply_round_trip(tmp_path: Path) -> None:
    prediction, camera = ground()
    cloud = point_cloud(prediction, camera)
    cloud.save(tmp_path / "x.ply")
    header, points, colors = read_ply(tmp_path / "x.ply")
    assert f"element vertex {len(cloud.points)}" in header
    assert "comment unit: meters (scale from construction)" in header
    assert np.array_equal(points, cloud.points)
    assert np.array_equal(colors, cloud.colors)


def test_empty_cloud(tmp_path: Path) -> None:
    prediction, camera = ground()
    cloud = point_cloud(prediction, camera, max_depth=0.001)
    cloud.save(tmp_path / "x.ply")
    assert "element vertex 0" in read_ply(tmp_path / "x.ply")[0]


def test_field_of_view() -> None:
    camera = Camera.from_numbers([90.0], 50, 100)
    assert camera.K[0, 0] == pytest.approx(50)
    assert camera.K[0, 2] == 49.5


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((1, 2, 3), "have 3 numbers"),
        ((0, 100, 50, 50), "cannot belong to 100x100 pixels"),
        ((100, 100, 620, 50), "cannot belong to 100x100 pixels"),
        ((100, 100, float("nan"), 50), "cannot belong to"),
        ((1, 0, 5, 0, 1, 5, 0, 0, 2), "cannot belong to"),
    ],
)
def test_impossible_intrinsics(numbers: tuple[float, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        Camera.from_numbers(numbers, 100, 100)
    assert "\n" not in str(error.value)


def test_refused(tmp_path: Path) -> None:
    prediction, camera = ground()
    with pytest.raises(ConfigError, match=r"must end in \.ply"):
        PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), "x").save(tmp_path / "x.obj")
    for settings in ({"stride": 0}, {"max_depth": -1.0}, {"edge": -0.5}):
        with pytest.raises(ConfigError, match=next(iter(settings))):
            point_cloud(prediction, camera, **settings)  # type: ignore[arg-type]
