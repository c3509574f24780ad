"""Cityscapes: snippets around annotated frames, disparity to depth, the crop without the bonnet."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import set_trees

from saunet.errors import DataError
from saunet.metrics.protocols import protocol
from saunet.registry import datamodules

CAMERA = [[2262.52, 0, 1096.98], [0, 2265.3017905988554, 513.137], [0, 0, 1]]
PUBLISHED = {"train": 2975, "val": 500, "test": 1525}
"""Annotated frames of each split (Cordts et al., CVPR 2016, Section 2.2), each the 20th of a snippet of 30."""


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return set_trees.cityscapes(tmp_path_factory.mktemp("cityscapes"), right=True)


def module(root, **options):
    return datamodules.build("cityscapes", root=str(root), **{"height": 48, "width": 128, "workers": 0, **options})


def test_splits_windows_and_times(root):
    data = module(root)
    data.setup()
    (drive,) = data.datasets["train"].drives
    assert drive.name == "train/aachen_000000_000164 l"
    assert list(drive.indices) == list(range(161, 168))
    assert [frame for _, frame in data.datasets["train"].windows] == list(range(162, 167))
    assert "23 missing" in data.summary("train")  # of the 30 frames of a snippet
    for split in ("val", "test", "predict"):
        assert [frame for _, frame in data.datasets[split].windows] == [164]
    assert drive.fps == pytest.approx(17)
    assert drive.camera_height == 1.22
    assert protocol(data.protocol).accepts(data.ground_truth)


def test_a_snippet_has_thirty_frames_of_which_the_twentieth_is_annotated(root):
    data = module(root)
    data.setup("fit")
    wanted = data.datasets["train"].drives[0].wanted
    assert len(wanted) == 30
    assert wanted[19] == 164
    assert sum(PUBLISHED.values()) == 5000


def test_images_and_intrinsics_lose_the_lower_quarter(root):
    data = module(root)
    data.setup("fit")
    drive = data.datasets["train"].drives[0]
    assert drive.image(162).shape == (48, 128, 3)
    assert drive.image(162)[0, 0].tolist() == [162, 0, 0]
    K = np.array(CAMERA) / [[16], [16], [1]]
    K[:2, 2] = (np.array(CAMERA)[:2, 2] + 0.5) / 16 - 0.5  # scaled as a whole, about the corner of the first pixel
    np.testing.assert_allclose(drive.intrinsics(162), K)
    whole = module(root, crop="none", height=64)
    whole.setup("fit")
    np.testing.assert_allclose(whole.datasets["train"].drives[0].intrinsics(162), K)  # the top left stays
    assert whole.datasets["train"].drives[0].image(162).shape == (64, 128, 3)
    assert whole.datasets["train"].drives[0].origin != drive.origin


def test_disparity_becomes_depth(root):
    data = module(root)
    data.setup("test")
    drive = data.datasets["test"].drives[0]
    depth = drive.depth(164)
    assert depth.shape == (768, 2048)
    assert drive.depth(163) is None
    meters = set_trees.CITYSCAPES_FX * set_trees.CITYSCAPES_BASELINE
    assert depth[700, 100:103] == pytest.approx([0, 256 * meters, meters / 50])  # (p - 1) / 256 pixels
    assert depth[0, 0] == 0
    assert depth[500, 500] == pytest.approx(256 * meters / 6000)
    assert data.batches("test", "cpu").__next__()["depth"].shape == (1, 1, 768, 2048)


def test_the_right_camera_stands_a_baseline_to_the_right(root):
    data = module(root, stereo=True)
    data.setup("fit")
    sample = data.datasets["train"][0]
    assert sample["frames"].shape[0] == 4
    assert sample["T_stereo_tgt"][:3, 3].tolist() == pytest.approx([-set_trees.CITYSCAPES_BASELINE, 0, 0])


def test_what_is_missing_is_said(root, tmp_path):
    with pytest.raises(DataError, match=r"no data root at .*leftImg8bit_sequence"):
        module(tmp_path / "gone").setup()
    shutil.copytree(root / "camera", tmp_path / "camera")
    with pytest.raises(DataError, match=r"no 'leftImg8bit\*' at"):
        module(tmp_path).setup()
    shutil.copytree(root / "leftImg8bit_sequence", tmp_path / "leftImg8bit")
    with pytest.raises(DataError, match=r"no leftImg8bit_sequence.* 1 annotated .*unpack leftImg8bit_sequence_train"):
        module(tmp_path).setup()
    with pytest.raises(DataError, match=r"'test' has no usable frame .*1 without ground truth"):
        module(tmp_path).setup("test")
    shutil.copytree(root / "disparity", tmp_path / "disparity")
    module(tmp_path).setup("test")
    shutil.rmtree(tmp_path / "camera" / "test")
    with pytest.raises(DataError, match=r"no camera files at .*camera/test; unpack camera_trainvaltest.zip"):
        module(tmp_path).setup("test")


def test_a_camera_file_without_numbers_is_named(tmp_path):
    root = set_trees.cityscapes(tmp_path)
    next(root.glob("camera/train/*/*.json")).write_text('{"intrinsic": {"fx": 1}}')
    with pytest.raises(DataError, match=r"aachen_000000_000164_camera.json is not a camera file .*'fy'"):
        module(root).setup("fit")
