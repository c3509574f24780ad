"""Virtual KITTI 2: a tiny tree in its layout, written and read back."""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny import train_on

from saunet.data.sets.vkitti import SCENES, VARIANTS
from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules

BASELINE = 0.532725  # meters, as in the data set's extrinsics
# images of each scene (naver labs' page of the data set): 2126 of each variant and camera, 21 260 pairs in all
FRAMES = {"Scene01": 447, "Scene02": 233, "Scene06": 270, "Scene18": 339, "Scene20": 837}


def pose(frame):
    """T_world_cam: the car drives 1 m a frame and turns by 1 degree."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", frame, degrees=True).as_matrix()
    T[:3, 3] = 2, 0.1, frame
    return T


def write_variant(root, scene="Scene01", variant="clone", frames=range(4), size=(375, 1242), cameras=(0, 1)):
    """Write a variant of a scene; images have the depth 10 + frame m, and sky above the horizon."""
    home = root / scene / variant
    lines = (
        ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"],
        ["frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"],
    )
    depth = np.zeros(size, np.uint16)
    for camera in cameras:
        rgb, maps = (home / "frames" / kind / f"Camera_{camera}" for kind in ("rgb", "depth"))
        rgb.mkdir(parents=True)
        maps.mkdir(parents=True)
        for frame in frames:
            cv2.imwrite(str(rgb / f"rgb_{frame:05d}.jpg"), np.full((*size, 3), (0, 100 * camera, 10 * frame), np.uint8))
            depth[: size[0] // 2], depth[size[0] // 2 :] = 65535, 100 * (10 + frame)
            depth[-1, -1] = 1234
            cv2.imwrite(str(maps / f"depth_{frame:05d}.png"), depth)
    for frame in frames:
        for camera in (0, 1):
            E = np.linalg.inv(pose(frame))
            E[0, 3] -= BASELINE * camera
            lines[0].append(f"{frame} {camera} 725.0087 725.0087 620.5 187")
            lines[1].append(f"{frame} {camera} " + " ".join(f"{value:.7g}" for value in E.ravel()))
    (home / "intrinsic.txt").write_text("\n".join(lines[0]) + "\n")
    (home / "extrinsic.txt").write_text("\n".join(lines[1]) + "\n")
    return home


def module(root, **options):
    small = {"height": 32, "width": 64, "batch_size": 2, "workers": 0, "variants": ["clone"]}
    return datamodules.build("vkitti", root=str(root), **{**small, **options})


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("vkitti")
    for scene in SCENES:
        write_variant(root, scene)
    write_variant(root, "Scene01", "fog")
    return root


def test_what_is_written_is_read(root):
    data = module(root, variants=["clone", "fog"], stereo=True, with_pose=True, target_depth=True)
    with pytest.warns(UserWarning, match=r"2 of 6 .* are missing, the first .*Scene06.fog; unpack .*data\.variants"):
        data.setup("fit")
    drives = {drive.name: drive for drive in data.datasets["train"].drives}
    assert list(drives) == ["Scene01/clone l", "Scene01/fog l", "Scene06/clone l", "Scene18/clone l"]
    drive = drives["Scene01/fog l"]
    assert (drive.condition, drive.fps, drive.frame_size) == ("fog", pytest.approx(10), (375, 1242))
    assert drive.intrinsics(0).tolist() == [[725.0087, 0, 620.5], [0, 725.0087, 187], [0, 0, 1]]
    np.testing.assert_allclose(drive.pose(3), pose(3), atol=1e-5)
    depth = drive.depth(2)
    assert (depth[0, 0], depth[-1, 0], depth[-1, -1]) == (0, 12, np.float32(12.34))  # the sky is unknown
    np.testing.assert_allclose(drive.T_stereo_cam[:3, 3], [-BASELINE, 0, 0], atol=1e-6)
    assert drive.stereo().name == "Scene01/fog r"
    assert drive.stereo().image(1)[0, 0, 1] > 90
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    train_on(batch)
    assert batch["sources"].shape[1] == 3
    assert 10 < batch["target_depth"].max() < 14
    np.testing.assert_allclose(batch["T_src_tgt"][:, 0, :3, 3].norm(dim=-1), 1, atol=1e-3)


def test_scenes_are_held_out_whole_with_the_published_number_of_frames(tmp_path):
    first = write_variant(tmp_path, frames=range(1), size=(8, 26), cameras=(0,))
    image = first / "frames" / "rgb" / "Camera_0" / "rgb_00000.jpg"
    depth = first / "frames" / "depth" / "Camera_0" / "depth_00000.png"
    rows = {name: (first / name).read_text().splitlines() for name in ("intrinsic.txt", "extrinsic.txt")}
    for scene, count in FRAMES.items():
        home = tmp_path / scene / "clone"
        for path in (image, depth):
            folder = home / path.parent.relative_to(first)
            folder.mkdir(parents=True, exist_ok=True)
            for frame in range(scene == "Scene01", count):
                os.link(path, folder / path.name.replace("00000", f"{frame:05d}"))
        for name, (head, *lines) in rows.items():
            more = [f"{frame}{line[1:]}" for frame in range(count) for line in lines]
            (home / name).write_text("\n".join([head, *more]))
    data = module(tmp_path)
    data.setup()
    used = {split: len(dataset) for split, dataset in data.datasets.items()}
    assert sum(FRAMES.values()) * len(VARIANTS) == 21260
    assert used == {"train": 447 + 270 + 339 - 6, "val": 233 - 2, "test": 837, "predict": 837}


@pytest.mark.parametrize("given", ["Scene01", ".", ".."])
def test_the_layout_is_found_around_the_root(tmp_path, given):
    write_variant(tmp_path / "vkitti", "Scene01")
    data = module(tmp_path / "vkitti" / given, val_scenes=[], test_scenes=["Scene01"])
    data.setup("test")
    assert len(data.datasets["test"]) == 4


def test_what_is_missing_is_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"no 'Scene\*/\*/frames/rgb' at .*unpack vkitti_2"):
        module(tmp_path).setup("fit")
    home = write_variant(tmp_path, "Scene20")
    with pytest.raises(DataError, match=r"3 of 3 scenes times variants of the train split are missing"):
        module(tmp_path).setup("fit")
    (home / "frames" / "rgb" / "Camera_0" / "rgb_00003.jpg").unlink()
    with pytest.warns(UserWarning, match="1 of 4 frames of camera 0"):
        module(tmp_path).setup("test")
    (home / "extrinsic.txt").unlink()
    with pytest.raises(DataError, match=r"cannot read .*extrinsic\.txt .*vkitti_2\.0\.3_textgt"):
        module(tmp_path).setup("test")
    (home / "extrinsic.txt").write_text("frame\n0 0 1 2 3\n")
    with pytest.raises(
        DataError, match=r"extrinsic\.txt, line 2: expected the numbers frame cameraID .*got '0 0 1 2 3'"
    ):
        module(tmp_path).setup("test")
    with pytest.raises(ConfigError, match=r"scenes is 'Scene21'.*Scene20"):
        module(tmp_path, test_scenes=["Scene21"])
