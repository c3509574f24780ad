"""Smaller copies of recordings of any data module, and training on them."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from saunet.cli import app
from saunet.data.loading.stored import CacheSettings, ImageCache
from saunet.errors import DataError
from saunet.registry import datamodules
from saunet.tools.prepare.cache import build_cache
from saunet.tools.prepare.tool import module_recordings

CAMERA = (
    "image_size: [320, 200]\nK: [250, 252, 158.0, 101.0]\nfps: 10\ndistortion: [-0.1, 0, 0, 0]\ncrop: [0, 0.1, 0, 0]\n"
)


def write_frames(folder, count, size, step=4):
    """Write frames in which a texture slides by."""
    noise = np.random.default_rng(0).integers(0, 255, (30, 200, 3), dtype=np.uint8)
    world = cv2.GaussianBlur(cv2.resize(noise, (1600, 240), interpolation=cv2.INTER_CUBIC), (0, 0), 1.5)
    folder.mkdir(parents=True)
    for frame in range(count):
        place = step * frame
        cv2.imwrite(str(folder / f"{frame:06d}.png"), world[: size[0], place : place + size[1]])


@pytest.fixture
def clips(tmp_path):
    """Two clips of one camera."""
    for name in ("a", "b"):
        write_frames(tmp_path / "clips" / name, 12, (200, 320))
    (tmp_path / "clips" / "camera.yaml").write_text(CAMERA)
    return tmp_path / "clips"


@pytest.fixture
def sequences(tmp_path):
    """A sequence of four cameras."""
    root = tmp_path / "odometry"
    for camera in range(4):
        write_frames(root / "sequences" / "00" / f"image_{camera}", 10, (20, 60), 1)
    rows = (f"P{camera}: 50 0 30 {-25 * (camera % 2)} 0 50 10 0 0 0 1 0" for camera in range(4))
    (root / "sequences" / "00" / "calib.txt").write_text("\n".join(rows))
    return root


def campus(clips, **options):
    small = {"height": 32, "width": 64, "batch_size": 2, "workers": 0, "val_share": 0.2}
    small |= {"frames_cache": str(clips.parent / "cache")}
    return datamodules.build("video", root=str(clips), **{**small, **options})


def odometry(root, **options):
    small = {"height": 10, "width": 30, "batch_size": 2, "workers": 0, "train_sequences": ["00"], "crop_margin": 0.0}
    small |= {"val_share": 0.3}
    return datamodules.build("kitti_odometry", root=str(root), **{**small, **options})


def same_samples(plain, cached, split):
    """Check that two data modules yield the same windows with nearly the same pixels and K."""
    assert cached.datasets[split].fingerprint() == plain.datasets[split].fingerprint()
    first, second = plain.datasets[split][0], cached.datasets[split][0]
    assert np.allclose(first["K"], second["K"], atol=1e-4)
    pixels = np.stack([each["frames"].numpy().ravel() for each in (first, second)])
    assert np.corrcoef(pixels)[0, 1] > 0.9


def test_campus_clips_through_the_command_line(clips, tmp_path, monkeypatch, capsys):
    words = ["cache", "data=video", f"data.root={clips}", f"data.frames_cache={tmp_path / 'cache'}", "data.fps=5"]
    words += [f"folder={tmp_path / 'small'}", "height=40", "width=80", "workers=0"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["saunet"])
    app.main(["prepare", *words])
    assert capsys.readouterr().out.startswith("12 copies made")
    plain, cached = campus(clips, fps=5.0), campus(clips, fps=5.0, cache=str(tmp_path / "small"))
    for data in (plain, cached):
        data.setup()
    same_samples(plain, cached, "train")
    same_samples(plain, cached, "val")
    drive = cached.datasets["train"].drives[0]
    assert drive.image(0).shape == (40, 80, 3)
    assert (drive.camera_height, drive.fps) == (None, 10)
    assert cached.datasets["test"].drives[0].image(1).shape == (180, 320, 3)  # tests read the originals


@pytest.mark.parametrize("change", [{"fps": 5.0}, {"parallax": 6.0}, {"crop": (0.0, 0.2, 0.0, 0.0)}, "camera", "file"])
def test_clips_whose_frames_are_others_now_are_refused(clips, tmp_path, change):
    settings = CacheSettings(40, 80)
    recordings = module_recordings(campus(clips, fps=10.0))
    build_cache(recordings, tmp_path / "small", settings)
    campus(clips, fps=10.0, cache=str(tmp_path / "small")).setup("fit")
    if change == "camera":
        (clips / "camera.yaml").write_text(CAMERA.replace("250, 252", "240, 242"))
    elif change == "file":
        (clips / "a" / "000003.png").unlink()
    options = {"fps": 10.0, **(change if isinstance(change, dict) else {})}
    with pytest.raises(DataError, match=r"the copies of 'a' in the cache (were made from|come from).*; .*delete"):
        campus(clips, **options, cache=str(tmp_path / "small")).setup("fit")
    with pytest.raises(DataError, match=r"the copies of 'a' in the cache .* complete the cache: saunet prepare cache"):
        build_cache(module_recordings(campus(clips, **options)), tmp_path / "small", settings)


def test_a_broken_frame_of_a_clip_stops_or_is_skipped(clips, tmp_path):
    (clips / "b" / "000005.png").write_bytes(b"")
    with pytest.raises(DataError, match=r"000005\.png is empty"):
        module_recordings(campus(clips))
    recordings = module_recordings(campus(clips, static="keep"))
    report = build_cache(recordings, tmp_path / "small", CacheSettings(40, 80), on_error="skip")
    assert (report.made, len(report.failures)) == (23, 1)


def test_odometry_sequences_with_both_cameras(sequences, tmp_path):
    recordings = module_recordings(odometry(sequences, stereo=True))
    assert [drive.name for drive, _ in recordings] == ["odometry/00 l", "odometry/00 r"]
    build_cache(recordings, tmp_path / "small", CacheSettings(10, 30))
    cache = str(tmp_path / "small")
    plain, cached = odometry(sequences, stereo=True), odometry(sequences, stereo=True, cache=cache)
    for data in (plain, cached):
        data.setup("fit")
    same_samples(plain, cached, "train")
    sample = cached.datasets["train"][0]
    assert sample["frames"].shape == (4, 3, 10, 30)
    assert sample["T_stereo_tgt"][0, 3] == pytest.approx(-0.5)
    with pytest.raises(DataError, match=r"the copies of 'odometry/00 l' in the cache were made from other files"):
        odometry(sequences, camera="gray_left", cache=cache).setup("fit")
    assert ImageCache(Path(cache)).frames(recordings[0][0])["origin"] == "color_left"


def test_kitti_with_the_settings_of_a_training(tree):
    data = datamodules.build(
        "kitti",
        root=str(tree),
        split="all",
        val_drives=["2011_09_26_drive_0002_sync"],
        cameras=["left"],
        height=10,
        width=30,
    )
    assert {drive.name[-15:]: len(frames) for drive, frames in module_recordings(data)} == {
        "ive_0001_sync l": 6,
        "ive_0002_sync l": 4,
    }
