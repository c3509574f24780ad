from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from prepare_tree import name

from saunet.data.loading.stored import DepthMaps
from saunet.errors import ConfigError, DataError
from saunet.prediction.foreign import ForeignOptions
from saunet.prediction.prediction import ImagePredictor
from saunet.tools.prepare.targets import FileTeacher, ModelTeacher, teach
from saunet.tools.prepare.tool import PrepareOptions, kitti_recordings, prepare


class Mean(torch.nn.Module):
    def forward(self, x):
        return x.mean(1)


class Brightness(ImagePredictor):
    """Nearer where it is brighter; depth of an unusual magnitude."""

    def __init__(self, gain=50.0):
        super().__init__(10, 30)
        self.gain = gain

    def disparity(self, images):
        return (self.gain * (0.1 + images.mean(1))).astype(np.float32)

    @property
    def fingerprint(self):
        return f"brightness {self.gain}"


def test_a_models_depth_comes_back_whatever_its_magnitude(tree):
    recordings = kitti_recordings(tree, ["left"])
    model = Brightness()
    assert teach(recordings, ModelTeacher(model)).made == 10
    drive = recordings[0][0]
    expected = model.predict(drive.image(2)).depth
    assert expected.max() < 0.3
    stored = DepthMaps("teacher").read(drive, 2)
    assert np.abs(stored / expected - 1).max() < 1e-3
    again = teach(recordings, ModelTeacher(model))
    assert (again.made, again.before) == (0, 10)
    with pytest.raises(DataError, match=r"made with different settings \(model"):
        teach(recordings, ModelTeacher(Brightness(40)))


def test_files_of_other_systems(tree, tmp_path):
    recordings = kitti_recordings(tree, ["left"], ["0002_sync"])
    drive = recordings[0][0]
    depth = np.random.default_rng(0).uniform(2, 50, (20, 60)).astype(np.float32)
    flat, nested, single = tmp_path / "flat", tmp_path / "nested", tmp_path / "single"
    for folder in (flat, single, nested / name(2) / "image_02" / "data"):
        folder.mkdir(parents=True)
    for frame in range(4):
        np.save(flat / f"{name(2).replace('/', '_')}_{frame:010d}_l.npy", 3 / depth[None])
        stored = np.round(depth * 256).astype(np.uint16)
        cv2.imwrite(str(nested / name(2) / "image_02" / "data" / f"{frame:010d}_depth.png"), stored)
        np.save(single / f"{frame:010d}_disp.npy", 3 / depth)
    for folder, values, factor in ((flat, "disparity", 3), (nested, "depth", 1), (single, "disparity", 3)):
        out = tmp_path / f"maps_{folder.name}"
        assert teach(recordings, FileTeacher(folder, values), str(out)).made == 4
        assert np.abs(DepthMaps("teacher", out).read(drive, 1) * factor / depth - 1).max() < 5e-3


def test_unknown_pixels_stay_unknown(tree, tmp_path):
    values = np.full((20, 60), 0.5, np.float32)
    values[0], values[1], values[2] = 0, np.nan, -1
    (tmp_path / "files").mkdir()
    for frame in range(4):
        np.save(tmp_path / "files" / f"{frame:010d}.npy", values)
    recordings = kitti_recordings(tree, ["left"], ["0002_sync"])
    teach(recordings, FileTeacher(tmp_path / "files", "disparity"), str(tmp_path / "maps"))
    stored = DepthMaps("teacher", tmp_path / "maps").read(recordings[0][0], 0)
    assert (stored[:3] == 0).all()
    assert np.allclose(stored[3:], 2.0)


def test_what_cannot_work_is_one_sentence(tree, tmp_path):
    recordings = kitti_recordings(tree, ["left"])
    with pytest.raises(DataError, match=r"no \.npy or \.png files below"):
        FileTeacher(tmp_path / "nowhere")
    (tmp_path / "one").mkdir()
    np.save(tmp_path / "one" / "0000000000.npy", np.ones((20, 60, 2)))
    with pytest.raises(DataError, match=r"0000000000.npy holds float64 of shape \(20, 60, 2\)"):
        teach(recordings, FileTeacher(tmp_path / "one"))
    np.save(tmp_path / "one" / "0000000000.npy", np.ones((20, 60)))
    with pytest.raises(DataError, match=r"has no depth for .*0000000001.png; expected"):
        teach(recordings, FileTeacher(tmp_path / "one"))


def test_models_of_other_systems_teach_depth_but_not_disparity_of_unknown_shift(tree, tmp_path):
    path = tmp_path / "mean.ts"
    torch.jit.trace(Mean(), torch.rand(1, 3, 16, 48)).save(str(path))
    about = {"height": 16, "width": 48, "run_code": True}
    shared = {"job": "teacher", "root": str(tree), "cameras": ("left",), "checkpoint": str(path), "device": "cpu"}
    said = prepare(PrepareOptions(**shared, foreign=ForeignOptions(output="depth", factor=20.0, **about)))
    assert said.made == 10
    drive = kitti_recordings(tree, ["left"])[0][0]
    small = cv2.resize(drive.image(2), (48, 16), interpolation=cv2.INTER_AREA) / 255
    stored = DepthMaps("teacher").read(drive, 2)
    assert stored.mean() == pytest.approx(20 * small.mean(), rel=0.05)
    with pytest.raises(ConfigError, match="unknown shift"):
        prepare(PrepareOptions(**shared, foreign=ForeignOptions(output="affine_disparity", **about)))
