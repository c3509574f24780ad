"""What preparation wrote is what the kitti data module trains on."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from prepare_tree import name

from saunet.data.loading.stored import CacheSettings, DepthMaps
from saunet.data.loading.windows import resize_depth
from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules
from saunet.tools.prepare.cache import build_cache
from saunet.tools.prepare.targets import FileTeacher, densify, teach
from saunet.tools.prepare.tool import kitti_recordings


def module(root, **options):
    small = {"height": 10, "width": 30, "batch_size": 2, "workers": 0, "split": "all", "cameras": ["left"]}
    small |= {"val_drives": ["2011_09_26_drive_0002_sync"], "test_split": "all"}
    return datamodules.build("kitti", root=str(root), **{**small, **options})


@pytest.mark.parametrize("kind", ["linear", "colorization"])
def test_dense_depth_is_the_target_in_training_and_validation(tree, tmp_path, kind):
    recordings = kitti_recordings(tree, ["left"])
    densify(recordings, [kind], str(tmp_path / "maps"))
    data = module(tree, dense=kind, maps=str(tmp_path / "maps"), crop_margin=0.0, depth="lidar_x")
    data.setup("fit")
    sample = data.datasets["train"][0]
    expected = resize_depth(DepthMaps(kind, tmp_path / "maps").read(recordings[0][0], 1), 10, 30)
    assert np.array_equal(sample["target_depth"][0].numpy(), expected)
    assert (expected > 0).mean() > 0.3
    assert "target_depth" in data.datasets["val"][0]
    train = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    assert train["target_depth"].shape == (2, 1, 10, 30)
    assert pickle.loads(pickle.dumps(data.datasets["train"]))[0]["target_depth"].max() == expected.max()


def test_a_teachers_depth_follows_crops_and_flips_beside_the_scan(tree, tmp_path):
    for number, frames in ((1, 6), (2, 4)):
        for frame in range(frames):
            ramp = np.tile(np.linspace(1, 9, 60, dtype=np.float32), (20, 1))
            target = tmp_path / "files" / name(number) / "image_02" / "data" / f"{frame:010d}.npy"
            target.parent.mkdir(parents=True, exist_ok=True)
            np.save(target, ramp)
    teach(kitti_recordings(tree, ["left"]), FileTeacher(tmp_path / "files"))
    data = module(tree, teacher=True, target_depth=True, flip_prob=1.0)
    data.setup("fit")
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    assert batch["target_teacher"].shape == batch["target_depth"].shape == (2, 1, 10, 30)
    assert (batch["target_teacher"].diff(dim=-1) < 0).all()  # mirrored, so it falls from left to right
    val = data.on_after_batch_transfer(next(iter(data.val_dataloader())), 0)
    assert (val["target_teacher"].diff(dim=-1) > 0).all()


def test_missing_maps_name_the_command(tree, tmp_path):
    with pytest.raises(DataError, match=r"6 of 6 frames have no linear depth map.*densify kinds=\[linear\] root="):
        module(tree, dense="linear").setup("fit")
    with pytest.raises(DataError, match=r"no teacher depth map.*saunet prepare teacher .* folder="):
        module(tree, teacher=True, maps=str(tmp_path / "maps")).setup("fit")
    densify(kitti_recordings(tree, ["left"]), ["linear"])
    DepthMaps("linear").path(kitti_recordings(tree, ["left"])[0][0], 3).unlink()
    with pytest.raises(DataError, match=r"1 of 6 frames have no linear depth map, such as .*0000000003.png"):
        module(tree, dense="linear").setup("fit")
    (tree / name(1) / "velodyne_points" / "data" / "0000000003.bin").unlink()
    data = module(tree, dense="linear")  # no scan, no map: an empty target
    data.setup("fit")
    assert data.datasets["train"][2]["name"].endswith("0000000003 l")
    assert data.datasets["train"][2]["target_depth"].max() == 0


def test_the_cache_is_read_in_training_and_intrinsics_follow(tree, tmp_path):
    recordings = kitti_recordings(tree, ["left"])
    build_cache(recordings, tmp_path / "cache", CacheSettings(10, 36, quality=100))
    plain, cached = module(tree, crop_margin=0.0), module(tree, crop_margin=0.0, cache=str(tmp_path / "cache"))
    for data in (plain, cached):
        data.setup()
    for split in ("train", "val"):
        first, second = plain.datasets[split][0], cached.datasets[split][0]
        assert np.allclose(first["K"], second["K"], atol=1e-4)
        pixels = np.stack([each["frames"].numpy().ravel() for each in (first, second)])
        assert np.corrcoef(pixels)[0, 1] > 0.85
        assert cached.datasets[split].fingerprint() == plain.datasets[split].fingerprint()
    drive = cached.datasets["train"].drives[0]
    assert drive.image(1).shape == (10, 36, 3)
    K = drive.intrinsics(1)
    assert K[0, 0] == pytest.approx(50 * 36 / 60)
    assert K[0, 2] == pytest.approx((29 + 0.5) * 36 / 60 - 0.5)
    assert K[1, 2] == pytest.approx((9 + 0.5) * 10 / 20 - 0.5)
    assert drive.depth(1).shape == (20, 60)
    assert cached.datasets["test"].drives[0].image(1).shape == (20, 60, 3)  # tests read the originals
    assert pickle.loads(pickle.dumps(drive)).image(1).shape == (10, 36, 3)


def test_the_other_camera_comes_from_the_cache_too(tree, tmp_path):
    import shutil

    for number in (1, 2):
        shutil.copytree(tree / name(number) / "image_02", tree / name(number) / "image_03")
    calibration = tree / "2011_09_26" / "calib_cam_to_cam.txt"
    calibration.write_text(
        calibration.read_text() + "S_rect_03: 6.0e+01 2.0e+01\nP_rect_03: 50 0 30 -25 0 50 10 0 0 0 1 0\n"
    )
    build_cache(kitti_recordings(tree), tmp_path / "cache", CacheSettings(10, 36))
    data = module(tree, stereo=True, offsets=[], cache=str(tmp_path / "cache"))
    data.setup("fit")
    sample = data.datasets["train"][0]
    assert sample["frames"].shape[0] == 2
    assert data.datasets["train"].drives[0].stereo().image(0).shape == (10, 36, 3)
    assert sample["T_stereo_tgt"][0, 3] == pytest.approx(-0.5)


def test_a_cache_smaller_than_the_training_size_is_refused_or_told(tree, tmp_path, recwarn):
    recordings, cache = kitti_recordings(tree, ["left"]), str(tmp_path / "cache")
    build_cache(recordings, cache, CacheSettings(10, 30))
    for size in ({"height": 12}, {"width": 36}, {"height": 40, "width": 120}):
        with pytest.raises(
            ConfigError, match=r"holds images of 10x30 .* loads .* although the originals are larger; make"
        ):
            module(tree, cache=cache, **size).setup("fit")
    module(tree, cache=cache, crop_margin=0.0).setup("fit")
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r"holds images of 10x30 .* training loads 12x36, .* height=12 width=36"):
        module(tree, cache=cache, crop_margin=0.2).setup("fit")
    build_cache(recordings, str(tmp_path / "full"), CacheSettings(20, 60))  # originals that are small themselves
    module(tree, cache=str(tmp_path / "full"), height=40, width=120).setup("fit")
    assert not recwarn.list


def test_a_cache_that_does_not_fit_is_one_sentence(tree, tmp_path):
    with pytest.raises(DataError, match="no cache at"):
        module(tree, cache=str(tmp_path / "nowhere"))
    recordings = kitti_recordings(tree, ["left"])
    build_cache([(recordings[0][0], [0, 1, 2])], tmp_path / "cache", CacheSettings(10, 30))
    with pytest.raises(DataError, match=r"lacks 3 frames of '.*0001_sync l', the first 0000000003; complete it"):
        module(tree, cache=str(tmp_path / "cache")).setup("fit")
    build_cache(recordings[:1], tmp_path / "cache", CacheSettings(10, 30))
    with pytest.raises(DataError, match=r"does not hold '.*0002_sync l'"):
        module(tree, cache=str(tmp_path / "cache")).setup("fit")
