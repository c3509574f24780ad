"""Recordings of CARLA: tiny ones as its cameras save them, written and read back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from tiny import train_on

from saunet.data.sets.carla import COLUMNS, CarlaDrive, pose
from saunet.errors import DataError
from saunet.registry import datamodules

SIZE, FOV = (60, 80), 90.0


def unreal_matrix(x, y, z, pitch, yaw, roll):
    """The 4 x 4 matrix of a transform in Unreal's left-handed axes, as CARLA's documentation has it."""
    (cp, cy, cr), (sp, sy, sr) = (f(np.radians([pitch, yaw, roll])) for f in (np.cos, np.sin))
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
            [sp, -cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ]
    )


def write_recording(folder, frames=range(100, 124, 4), fov=FOV):
    """Write a drive of 1 m a frame along Unreal's x; images have the depth 10 + 0.5 x their place, and sky above."""
    rows = [",".join(COLUMNS)]
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for place, frame in enumerate(frames):
        cv2.imwrite(str(folder / "rgb" / f"{frame:08d}.png"), np.full((*SIZE, 3), 10 * place, np.uint8))
        stored = np.full(SIZE, round((10 + 0.5 * place) / 1000 * (2**24 - 1)), np.int64)
        stored[:20] = 2**24 - 1
        red, green, blue = stored & 255, stored >> 8 & 255, stored >> 16
        alpha = np.full(SIZE, 255)
        picture = np.stack([blue, green, red, alpha], axis=-1).astype(np.uint8)  # OpenCV's order
        cv2.imwrite(str(folder / "depth" / f"{frame:08d}.png"), picture)
        rows.append(f"{frame},{place / 10},{float(place)},3.0,1.5,0.0,0.0,0.0,{fov}")
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")


def module(root, **options):
    small = {"height": 32, "width": 64, "batch_size": 1, "workers": 0, "val_share": 0.2}
    return datamodules.build("carla", root=str(root), **{**small, **options})


def test_what_is_written_is_read(tmp_path):
    write_recording(tmp_path / "HardRainNoon" / "town03")
    data = module(tmp_path, with_pose=True, target_depth=True, camera_height=1.5)
    data.setup()
    drive = data.datasets["train"].drives[0]
    assert (drive.name, drive.condition, drive.camera_height) == ("HardRainNoon/town03", "HardRainNoon", 1.5)
    assert list(drive.indices) == [0, 1, 2, 3, 4, 5]  # of every fourth tick
    assert drive.fps == pytest.approx(10)
    np.testing.assert_allclose(drive.intrinsics(0), [[40, 0, 39.5], [0, 40, 29.5], [0, 0, 1]], atol=1e-9)
    np.testing.assert_allclose(drive.pose(2)[:3, 3], [3, -1.5, 2])  # right, down, forward
    depth = drive.depth(3)
    assert depth[0, 0] == 0
    assert depth[-1, -1] == pytest.approx(11.5, abs=1e-4)
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    train_on(batch)
    np.testing.assert_allclose(batch["T_src_tgt"][0, :, :3, 3], [[0, 0, 1], [0, 0, -1]], atol=1e-6)
    assert 10 < batch["target_depth"].max() < 13


def test_a_left_handed_turn_is_the_same_turn_in_our_axes():
    ours_of = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # forward, right, up -> ours
    for numbers in ([1, 2, 3, 0, 0, 30], [0, 0, 0, 20, 0, 0], [0, 0, 0, 0, 40, 0], [4, -5, 6, 20, -40, 170]):
        expected = ours_of @ unreal_matrix(*numbers) @ np.linalg.inv(ours_of)
        found = pose(*map(float, numbers))
        np.testing.assert_allclose(found, expected, atol=1e-12)
        assert np.linalg.det(found) == pytest.approx(1)


@pytest.mark.parametrize(
    ("rgb", "meters"), [((1, 0, 0), 1000 / 16777215), ((0, 1, 0), 0.0152588), ((0, 0, 1), 3.90625)]
)
def test_red_is_the_lowest_byte(tmp_path, rgb, meters):
    cv2.imwrite(str(tmp_path / "d.png"), np.full((2, 2, 3), rgb[::-1], np.uint8))
    assert CarlaDrive.read(tmp_path / "d.png")[0, 0] == pytest.approx(meters, rel=1e-5)


def test_what_is_missing_or_broken_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"no poses\.csv at .*docs/datasets\.md"):
        module(tmp_path).setup("fit")
    write_recording(tmp_path / "a")
    (tmp_path / "a" / "rgb" / "00000108.png").unlink()
    (tmp_path / "a" / "depth" / "00000112.png").unlink()
    data = module(tmp_path, test_drives=["a"], val_drives=[])
    with pytest.warns(UserWarning, match=r"1 of 6 images of .*poses\.csv are missing, the first 108"):
        data.setup("test")
    assert len(data.datasets["test"]) == 4
    assert "1 without ground truth" in data.summary("test")
    assert data.datasets["test"].drives[0].gaps == {1}  # nothing is a neighbor across the missing image
    cv2.imwrite(str(tmp_path / "a" / "depth" / "00000120.png"), np.zeros(SIZE, np.uint16))
    with pytest.raises(DataError, match=r"00000120\.png contains uint16 .*without a color converter"):
        list(data.test_dataloader())
    table = tmp_path / "a" / "poses.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:-1], lines[-1].replace("90.0", "100")]))
    with pytest.raises(DataError, match=r"poses\.csv has fov \[90\.0, 100\.0\]; a recording must have one"):
        module(tmp_path).setup("test")
    table.write_text("\n".join(lines[1:]))
    with pytest.raises(DataError, match=r"must start with the line frame,timestamp,x,"):
        module(tmp_path).setup("test")
