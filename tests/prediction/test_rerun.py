"""``outputs=[rrd]``: a file that is read back with Rerun's own reader, and what happens without it or without space."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from predicting import run
from torch import nn

from saunet.errors import ConfigError, DataError
from saunet.prediction.odometer import Odometer
from saunet.prediction.pointcloud import Camera, point_cloud
from saunet.prediction.predictor import Predictor

installed = pytest.mark.skipif(find_spec("rerun") is None, reason="rerun-sdk, the extra 'rerun', is not installed")
K = np.array([[70.0, 0, 43.5], [0, 75.0, 19.0], [0, 0, 1]])


class Ahead(nn.Module):
    """One unit ahead between neighbors: points come nearer, so ``T_next_cam`` moves by -1 in z."""

    offsets = (1,)

    def forward(self, target: torch.Tensor, sources: torch.Tensor) -> torch.Tensor:
        pose = torch.eye(4).repeat(len(target), 1, 1, 1)
        pose[..., 2, 3] = -1.0
        return pose


def rows(path: Path) -> dict[str, list[Mapping[str, Any]]]:
    """Return what a recording holds: entity -> its rows by component, oldest first."""
    reader = importlib.import_module("rerun.chunk").RrdReader(str(path))
    found: dict[str, list[Mapping[str, Any]]] = {}
    for chunk in reader.store().stream().to_chunks():
        if not chunk.entity_path.startswith("/__"):  # Rerun's own
            found.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return {name: sorted(given, key=lambda row: row.get("frame") or 0) for name, given in found.items()}


@installed
def test_image_depth_camera_points_and_path_are_read_back(
    predictor: Predictor, picture: NDArray[np.uint8], tmp_path: Path
) -> None:
    pictures = [np.roll(picture, 9 * index, axis=1) for index in range(3)]
    camera, odometer = Camera(K, 40, 90), Odometer(Ahead(), 32, 64)
    done = run(predictor, pictures, tmp_path, ["rrd", "trajectory"], odometer=odometer, camera=camera)
    path = tmp_path / "frames_rerun.rrd"
    assert path in done.clips
    found = rows(path)
    expected = [predictor.predict(each) for each in pictures]
    for index, (depth, image, view, points, pose) in enumerate(
        zip(
            *(found[f"/world/camera{part}"] for part in ("/view/depth", "/view/image", "/view", "/points", "")),
            strict=True,
        )
    ):
        assert {row["frame"] for row in (depth, image, view, points, pose)} == {index}
        values = np.frombuffer(bytes(depth["DepthImage:buffer"][0]), np.float32).reshape(40, 90)
        assert np.array_equal(values, expected[index].depth)
        assert depth["DepthImage:meter"] == [1.0]
        assert bytes(image["EncodedImage:blob"][0])[:3] == b"\xff\xd8\xff"
        by_columns = np.array(view["Pinhole:image_from_camera"][0]).reshape(3, 3)
        assert np.allclose(by_columns.T, K)
        assert view["Pinhole:resolution"] == [[90.0, 40.0]]
        cloud = point_cloud(expected[index], camera)
        assert np.allclose(points["Points3D:positions"], cloud.points)
        assert np.allclose(pose["Transform3D:translation"], [[0, 0, index]])
    line = found["/world/path"][0]["LineStrips3D:strips"][0]
    assert np.allclose(line, [[0, 0, 0], [0, 0, 1], [0, 0, 2]])
    assert "relative" in str(found["/unit"][0])


@installed
def test_without_camera_there_are_image_and_depth(predictor: Predictor, folder: Path, tmp_path: Path) -> None:
    done = run(predictor, folder, tmp_path / "out", ["rrd"])
    assert [path.name for path in done.clips] == ["in_rerun.rrd"]
    found = rows(done.clips[0])
    assert len(found["/world/camera/view/depth"]) == 3
    assert not {"/world/camera/view", "/world/camera/points", "/world/path"} & set(found)


@installed
def test_a_recording_that_cannot_be_completed_is_an_error(
    predictor: Predictor, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk: Rerun's writer says so in its log alone, and leaves what it has."""
    stream = importlib.import_module("rerun").RecordingStream

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setattr(stream, "flush", refuse)
    with pytest.raises(DataError, match=r"rerun\.rrd.*disk full"):
        run(predictor, folder, tmp_path / "out", ["rrd"])
    assert not list((tmp_path / "out").glob("*rrd*"))


def test_a_missing_package_is_named(
    predictor: Predictor, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"saunet\[rerun\]"):
        run(predictor, folder, tmp_path / "out", ["rrd"])
    assert not (tmp_path / "out").exists()
