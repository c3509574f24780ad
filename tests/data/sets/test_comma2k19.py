"""comma2k19: tiny segments in its layout, written and read back."""

from __future__ import annotations

import io

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import train_on
from videos import number_of, write_video

from saunet.errors import DataError
from saunet.registry import datamodules

START, STEP = 46408.5, 1 / 20
AT = np.array([-2712087.5, -4261670.1, 3881014.5])  # meters from the center of the earth: California
EARTH_PHONE = Rotation.from_quat([-0.80302968, -0.43522125, -0.34726874, 0.21243875])  # x y z w
SILENT = {"x265-params": "log-level=error:vui-timing-info=0"}


def save(path, array):
    """Write an array as the data set does: a .npy file without the ending."""
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    np.save(buffer, array)
    path.write_bytes(buffer.getvalue())


def write_segment(folder, count=13, fps=25, options=SILENT):
    """Write a segment: 0.75 m forward a frame at 15 m/s, turning right by 1 degree; frames show their numbers."""
    folder.mkdir(parents=True)
    write_video(folder / "video.hevc", count, codec="libx265", form="hevc", options=options, fps=fps)
    turns = EARTH_PHONE * Rotation.from_euler("z", np.arange(count)[:, None], degrees=True)  # about down
    x, y, z, w = turns.as_quat().T
    forward = EARTH_PHONE.apply([1, 0, 0])
    save(folder / "global_pose" / "frame_times", START + STEP * np.arange(count))
    save(folder / "global_pose" / "frame_orientations", np.stack([w, x, y, z], axis=1))
    save(folder / "global_pose" / "frame_positions", AT + 0.75 * np.arange(count)[:, None] * forward)
    stamps = START - 0.03 + 0.01 * np.arange(100)
    save(folder / "processed_log" / "CAN" / "speed" / "t", stamps)
    save(folder / "processed_log" / "CAN" / "speed" / "value", (15 + (stamps - START))[:, None])
    return folder


def module(root, **options):
    small = {
        "height": 32,
        "width": 64,
        "batch_size": 1,
        "workers": 0,
        "val_share": 0.2,
        "frames_cache": str(root / "c"),
    }
    return datamodules.build("comma2k19", root=str(root), **{**small, **options})


@pytest.mark.parametrize("options", [SILENT, {"x265-params": "log-level=error"}], ids=["no rate", "another rate"])
def test_what_is_written_is_read(tmp_path, options):
    write_segment(tmp_path / "Chunk_1" / "b0c9d2329ad1606b|2018-08-02--08-34-47" / "40", options=options)
    data = module(tmp_path, with_pose=True, with_speed=True)
    data.prepare_data()
    data.setup()
    drive = data.datasets["train"].drives[0]
    assert drive.name == "Chunk_1/b0c9d2329ad1606b|2018-08-02--08-34-47/40"
    # every second of 20 frames a second, whatever rate the bare stream states
    assert [number_of(drive.image(index)) for index in drive.indices] == [0, 2, 4, 6, 8, 10, 12]
    assert [drive.recorded(index) for index in drive.indices] == [0, 2, 4, 6, 8, 10, 12]
    assert (drive.fps, drive.time(3)) == (20, START + 6 * STEP)
    # a pixel's center is 0: the middle of 1164 columns is 581.5
    zoom = 128 / 1164
    np.testing.assert_allclose(drive.intrinsics(0)[0], [910 * zoom, 0, (581.5 + 0.5) * zoom - 0.5])
    np.testing.assert_allclose(drive.pose(0), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(drive.pose(2)[:3, 3], [0, 0, 3], atol=1e-6)
    forward = [np.sin(np.radians(4)), 0, np.cos(np.radians(4))]
    np.testing.assert_allclose(drive.pose(2)[:3, 2], forward, atol=1e-6)
    assert drive.speed(2) == pytest.approx(15 + 4 * STEP)
    assert drive.distance(1, 3) == pytest.approx(3)
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    train_on(batch)
    np.testing.assert_allclose(batch["T_src_tgt"][0, :, :3, 3].norm(dim=-1), 1.5, atol=1e-5)
    np.testing.assert_allclose(batch["distance"][0], 1.5, atol=1e-5)
    assert (data.protocol, data.ground_truth) == ("campus", "none")


def test_what_is_missing_or_broken_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"no video\.hevc at .*unpack the chunks"):
        module(tmp_path).setup("fit")
    folder = write_segment(tmp_path / "7")
    save(folder / "global_pose" / "frame_times", START + STEP * np.arange(5))
    with pytest.raises(DataError, match=r"frame_times has 5 rows, fewer than .*video\.hevc has frames"):
        module(tmp_path).setup("fit")
    for path in (folder / "global_pose").iterdir():
        path.unlink()
    with pytest.raises(DataError, match=r"1 of 1 global_pose folders are missing, the first .*7; unpack the chunk"):
        module(tmp_path, with_pose=True).setup("fit")
    data = module(tmp_path)
    data.setup("fit")
    assert data.datasets["train"].drives[0].time(2) == 4 * STEP  # of the video
