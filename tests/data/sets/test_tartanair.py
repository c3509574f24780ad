"""TartanAir in both versions: tiny flights in its layout, written and read back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import train_on

from saunet.errors import DataError
from saunet.registry import datamodules

CAMERAS = {"V1": ("left", "right"), "V2": ("lcam_front", "rcam_front")}
SIZES = {"V1": (480, 640), "V2": (640, 640)}


def write_flight(folder, version="V1", count=6, start=0.0):
    """Write a flight north that turns east, 0.5 m a frame; images have the depth 4 + frame m, and sky above."""
    size = SIZES[version]
    for side, camera in enumerate(CAMERAS[version]):
        for kind in ("image", "depth"):
            (folder / f"{kind}_{camera}").mkdir(parents=True)
        rows = []
        for frame in range(count):
            turn = Rotation.from_euler("z", 2 * frame, degrees=True)  # about down: from north to east
            at = np.array([start + 0.5 * frame, 1, -2]) + turn.apply([0, 0.25 * side, 0])
            rows.append(" ".join(f"{value:.9f}" for value in (*at, *turn.as_quat())))
            name = f"{frame:06d}_{camera}"
            picture = np.full((*size, 3), (20 * frame, 0, 100 * side), np.uint8)
            cv2.imwrite(str(folder / f"image_{camera}" / f"{name}.png"), picture)
            depth = np.full(size, 4 + frame, np.float32)
            depth[: size[0] // 3] = 10000
            depth[0, 0] = np.inf
            if version == "V1":
                np.save(folder / f"depth_{camera}" / f"{name}_depth.npy", depth.astype(np.float16))
            else:
                cv2.imwrite(str(folder / f"depth_{camera}" / f"{name}_depth.png"), depth[..., None].view(np.uint8))
        (folder / f"pose_{camera}.txt").write_text("\n".join(rows) + "\n")


def module(root, **options):
    small = {"height": 32, "width": 64, "batch_size": 1, "workers": 0, "val_share": 0.2}
    return datamodules.build("tartanair", root=str(root), **{**small, **options})


@pytest.mark.parametrize(
    ("version", "where", "name"),
    [
        ("V1", "abandonedfactory/abandonedfactory/Easy/P001", "abandonedfactory/Easy/P001 l"),
        ("V2", "OldTown/Data_easy/P000", "OldTown/Data_easy/P000 l"),
    ],
)
def test_what_is_written_is_read(tmp_path, version, where, name):
    write_flight(tmp_path / where, version)
    data = module(tmp_path, stereo=True, with_pose=True, target_depth=True)
    data.setup()
    drive = data.datasets["train"].drives[0]
    height, width = SIZES[version]
    assert (drive.name, drive.frame_size) == (name, (height, width))
    # 90 degrees: the ray to the outer edge of the last pixel, half beyond its center, is at 45 degrees
    K = drive.intrinsics(0)
    assert (width - 0.5 - K[0, 2]) / K[0, 0] == 1
    assert K[1].tolist() == [0, 320, (height - 1) / 2]
    depth = drive.depth(3)
    assert (depth[0, 0], depth[1, 5], depth[-1, -1]) == (0, 0, 7)
    first, second = drive.pose(0), drive.pose(1)
    np.testing.assert_allclose(first, [[1, 0, 0, 1], [0, 1, 0, -2], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-8)
    np.testing.assert_allclose(second[:3, 3], [1, -2, 0.5], atol=1e-8)  # east, down, north
    np.testing.assert_allclose(second[:3, 2], [np.sin(np.radians(2)), 0, np.cos(np.radians(2))], atol=1e-8)
    T_right_left = np.linalg.inv(drive.stereo().pose(4)) @ drive.pose(4)
    np.testing.assert_allclose(drive.T_stereo_cam, T_right_left, atol=1e-8)
    assert {split: len(dataset) for split, dataset in data.datasets.items()} == {
        "train": 1, "val": 1, "test": 2, "predict": 2,
    }  # fmt: skip
    assert "2 between training and validation" in data.summary("train")
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    train_on(batch)
    assert batch["target_depth"].max() == 5
    np.testing.assert_allclose(batch["T_src_tgt"][0, :, :3, 3].norm(dim=-1), [0.5, 0.5, 0.25], atol=1e-6)


def test_flights_are_held_out_by_name_and_the_right_camera_on_demand(tmp_path):
    for number in range(3):
        write_flight(tmp_path / "ocean" / "ocean" / "Hard" / f"P00{number}", count=3)
    data = module(tmp_path, right=True, val_drives=["*/P001 ?"], test_drives=["*/P002 l"])
    data.setup()
    names = {split: [drive.name for drive in each.drives] for split, each in data.datasets.items()}
    assert names["train"] == ["ocean/Hard/P000 l", "ocean/Hard/P000 r", "ocean/Hard/P002 r"]
    assert names["val"] == ["ocean/Hard/P001 l", "ocean/Hard/P001 r"]
    assert names["test"] == ["ocean/Hard/P002 l"]


def test_what_is_missing_or_broken_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"no folder image_left or image_lcam_front .*unpack image_left\.zip"):
        module(tmp_path).setup("fit")
    folder = tmp_path / "P000"
    write_flight(folder)
    (folder / "pose_left.txt").write_text("0 0 0 0 0 0 1\n" * 4)
    with pytest.raises(DataError, match=r"pose_left\.txt has 4 poses but the images go up to number 5"):
        module(tmp_path).setup("fit")
    (folder / "pose_left.txt").unlink()
    with pytest.raises(DataError, match=r"without pose"):
        module(tmp_path, with_pose=True).setup("fit")
    np.save(folder / "depth_left" / "000005_left_depth.npy", np.zeros((480, 640, 3), np.float32))
    data = module(tmp_path)
    data.setup("test")
    with pytest.raises(DataError, match=r"000005_left_depth\.npy contains float32 of shape \(480, 640, 3\)"):
        list(data.test_dataloader())
