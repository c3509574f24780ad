"""TUM RGB-D: a tiny sequence in its layout, written and read back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import train_on

from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules

SIZE = (480, 640)
START = 1305031102.0


def write_sequence(root, name="rgbd_dataset_freiburg1_xyz", count=6):
    """Write a sequence: images at 10 Hz, depth 4 ms and poses 1 ms later; the depth is 1 + 0.1 x the place m."""
    folder, lists = root / name, {"rgb": ["# color images"], "depth": ["# depth maps"], "truth": ["# ground truth"]}
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for place in range(count):
        time = START + place / 10
        cv2.imwrite(str(folder / "rgb" / f"{time:.6f}.png"), np.full((*SIZE, 3), 20 * place, np.uint8))
        lists["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        depth = np.full(SIZE, 5000 + 500 * place, np.uint16)
        depth[0] = 0
        cv2.imwrite(str(folder / "depth" / f"{time + 0.004:.6f}.png"), depth)
        lists["depth"].append(f"{time + 0.004:.6f} depth/{time + 0.004:.6f}.png")
        for step in range(10):  # motion capture has 100 Hz
            q = Rotation.from_euler("y", 5 * (place + step / 10), degrees=True).as_quat()  # x y z w
            numbers = (0.2 * (place + step / 10), 1, 2, *q)
            lists["truth"].append(f"{time + 0.001 + step / 100:.4f} " + " ".join(f"{each:.9f}" for each in numbers))
    (folder / "rgb.txt").write_text("\n".join(lists["rgb"]) + "\n")
    (folder / "depth.txt").write_text("\n".join(lists["depth"]) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(lists["truth"]) + "\n")
    return folder


def module(root, **options):
    small = {"height": 32, "width": 64, "batch_size": 1, "workers": 0, "val_share": 0.2}
    return datamodules.build("tum", root=str(root), **{**small, **options})


@pytest.mark.parametrize("given", [".", "rgbd_dataset_freiburg1_xyz"])
def test_what_is_written_is_read(tmp_path, given):
    write_sequence(tmp_path)
    data = module(tmp_path / given, with_pose=True, target_depth=True)
    data.setup()
    drive = data.datasets["train"].drives[0]
    assert (drive.name, drive.fps) == ("rgbd_dataset_freiburg1_xyz", pytest.approx(10))
    assert drive.intrinsics(0).tolist() == [[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]]
    assert (drive.depth(3)[0, 0], drive.depth(3)[1, 1]) == (0, np.float32(1.3))
    np.testing.assert_allclose(drive.pose(2)[:3, 3], [0.4, 1, 2])
    np.testing.assert_allclose(drive.pose(2)[:3, 2], [np.sin(np.radians(10)), 0, np.cos(np.radians(10))], atol=1e-8)
    assert {name: len(each) for name, each in data.datasets.items()} == {"train": 1, "val": 1, "test": 2, "predict": 2}
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    train_on(batch)
    assert 1 < batch["target_depth"].max() < 1.6
    np.testing.assert_allclose(batch["T_src_tgt"][0, :, :3, 3].norm(dim=-1), 0.2, atol=1e-4)


def test_depth_and_pose_go_to_one_image_each_or_to_none(tmp_path):
    folder = write_sequence(tmp_path)
    lines = (folder / "depth.txt").read_text().splitlines()
    # 50 ms before the second image and after the first: neither is within 20 ms
    time = START + 0.05
    (folder / "depth" / f"{START + 0.104:.6f}.png").rename(folder / "depth" / f"{time:.6f}.png")
    lines[2] = f"{time:.6f} depth/{time:.6f}.png"
    (folder / "depth.txt").write_text("\n".join(lines))
    data = module(tmp_path, test_drives=["*freiburg1*"], val_drives=[])
    data.setup("test")
    drive = data.datasets["test"].drives[0]
    assert [drive.has_depth(index) for index in range(6)] == [True, False, True, True, True, True]
    assert "1 without ground truth" in data.summary("test")
    wide = module(tmp_path, max_difference=0.06, test_drives=["*freiburg1*"])
    wide.setup("test")
    both = wide.datasets["test"].drives[0]
    assert (both.depths[0], both.depths[1]) == (drive.depths[0], folder / "depth" / f"{time:.6f}.png")


def test_the_kinects_calibration_undistorts_images_and_depth_alike(tmp_path):
    folder = write_sequence(tmp_path, count=3)
    picture, depth = np.zeros((*SIZE, 3), np.uint8), np.full(SIZE, 5000, np.uint16)
    picture[95:106, 145:156], depth[95:106, 145:156] = 255, 10000
    for path in (folder / "rgb").iterdir():
        cv2.imwrite(str(path), picture)
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), depth)
    data = module(tmp_path, calibration="kinect", test_drives=["*"])
    data.setup("test")
    drive = data.datasets["test"].drives[0]
    K = drive.intrinsics(0)
    assert K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [517.3, 516.5, 318.6, 255.3]
    bend = np.array([0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    for mark in (drive.depth(1) == 2, drive.image(1)[..., 0] > 128):
        rows, columns = np.nonzero(mark)
        ray = np.linalg.inv(K) @ [columns.mean(), rows.mean(), 1]  # the lens bends it to where the mark was drawn
        bent = cv2.projectPoints(ray[None], np.zeros(3), np.zeros(3), K, bend)[0].ravel()
        np.testing.assert_allclose(bent, [150, 100], atol=0.4)
        assert np.abs([columns.mean() - 150, rows.mean() - 100]).max() > 2
    folder.rename(tmp_path / "desk")
    with pytest.raises(ConfigError, match=r"'desk' has no freiburg1, 2 or 3"):
        module(tmp_path, calibration="kinect").setup("test")


def test_what_is_missing_or_broken_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"no rgb\.txt at .*unpack the sequences' \.tgz"):
        module(tmp_path).setup("fit")
    folder = write_sequence(tmp_path)
    with pytest.raises(ConfigError, match=r"val_drives names 'x', which matches no drive; drives: rgbd_dataset"):
        module(tmp_path, val_drives=["x"]).setup("fit")
    (folder / "groundtruth.txt").write_text("1305031102.0 1 2 3 0 0 0\n")
    with pytest.raises(DataError, match=r"groundtruth\.txt, line 1: expected the numbers timestamp tx"):
        module(tmp_path).setup("fit")
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(DataError, match="without pose"):
        module(tmp_path, with_pose=True).setup("fit")
    (folder / "rgb.txt").write_text("# nothing\n1305031102.0 rgb/gone.png\n")
    with pytest.raises(DataError, match=r"rgb\.txt lists no existing file"):
        module(tmp_path).setup("fit")
    (folder / "rgb.txt").write_text("soon rgb/gone.png\n")
    with pytest.raises(DataError, match=r"rgb\.txt, line 1: expected a time and a file name, got 'soon rgb/gone\.png'"):
        module(tmp_path).setup("fit")
