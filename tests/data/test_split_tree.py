"""The named splits on a tree of KITTI's full size, whose images are only listed."""

from __future__ import annotations

from pathlib import Path

import pytest
from kitti_tree import CALIBRATION, SCANNER
from published_splits import PUBLISHED

from saunet.data.kitti import raw, splits
from saunet.data.loading.windows import fingerprint
from saunet.registry import datamodules


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """All 61 drives as folders, with the ground truth of test frames as empty files."""
    root = tmp_path_factory.mktemp("kitti")
    for rows in splits.eigen_table().values():
        for row in rows:
            folder = root / row.drive
            folder.mkdir(parents=True)
            (folder.parent / "calib_cam_to_cam.txt").write_text(CALIBRATION)
            (folder.parent / "calib_velo_to_cam.txt").write_text(SCANNER)
    for frame in splits.eigen_test():
        _touch(root / frame.drive / "velodyne_points" / "data" / f"{frame.number:010d}.bin")
    for frame in splits.eigen_benchmark_test():
        _touch(root / frame.drive / "proj_depth" / "groundtruth" / "image_02" / f"{frame.number:010d}.png")
    return root


@pytest.fixture
def full_tree(written, monkeypatch):
    """The drives, whose images appear in listings."""
    frames = {row.drive: row.frames for rows in splits.eigen_table().values() for row in rows}

    def listed(folder: Path) -> dict[int, str]:
        drive = folder.parents[1]
        return {number: f"{number:010d}.png" for number in range(frames[f"{drive.parent.name}/{drive.name}"])}

    monkeypatch.setattr(raw, "frame_files", listed)
    return written


def _touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()


def module(root, **options):
    return datamodules.build("kitti", root=str(root), height=32, width=64, batch_size=1, workers=0, **options)


def names(data, *wanted):
    return [data.datasets[split].name(index) for split in wanted for index in range(len(data.datasets[split]))]


@pytest.mark.parametrize(
    ("split", "published", "offsets"),
    [
        ("eigen_full", "eigen_full", []),
        ("eigen_zhou_by_drive", "eigen_zhou", [-1, 1]),
        ("eigen_zhou_random", "eigen_zhou", [-1, 1]),
    ],
)
def test_training_splits_are_the_published_frames(full_tree, split, published, offsets):
    data = module(full_tree, split=split, offsets=offsets)
    data.setup("fit")
    found = names(data, "train", "val")
    assert len(found) == PUBLISHED[published][0]
    assert fingerprint(found) == PUBLISHED[published][1]
    assert data.fingerprints()["train"][:16] in data.summary("train")  # which is printed


def test_test_splits_are_the_published_frames(full_tree):
    for split, depth in (("eigen_test", "camera_z"), ("eigen_benchmark_test", "improved")):
        data = module(full_tree, test_split=split, depth=depth)
        data.setup("test")
        assert (len(names(data, "test")), data.fingerprints()["test"]) == PUBLISHED[split]


def test_frames_without_improved_truth_are_left_out_and_counted(full_tree):
    data = module(full_tree, test_split="eigen_test", depth="improved")
    data.setup("test")
    assert (len(names(data, "test")), data.fingerprints()["test"]) == PUBLISHED["eigen_benchmark_test"]
    assert "left out: 45 without ground truth" in data.summary("test")


def test_a_missing_side_and_missing_drives_are_counted(full_tree, monkeypatch, request):
    whole = raw.frame_files
    monkeypatch.setattr(raw, "frame_files", lambda folder: {} if "image_03" in str(folder) else whole(folder))
    gone = full_tree / "2011_09_26/2011_09_26_drive_0001_sync"
    gone.rmdir()
    request.addfinalizer(gone.mkdir)  # the tree is everybody's
    data = module(full_tree)
    data.setup("fit")
    zhou = splits.eigen_zhou()
    left = sum(frame.side == "l" for frame in zhou)
    assert len(names(data, "train", "val")) == left == 44234 // 2
    train = splits.training_split("eigen_zhou_by_drive")[0]
    assert f"{sum(frame.side == 'r' for frame in train)} missing" in data.summary("train")
