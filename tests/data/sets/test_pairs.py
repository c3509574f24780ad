"""Images with depth maps in several layouts, written and read back; what predict writes is one of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from tiny import train_on

from saunet.data.sets.pairs import VIEW, read_pair_depth
from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules

SIZE = (24, 40)


def write_image(path, value=0, size=SIZE):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((*size, 3), value, np.uint8))


def write_depth(path, meters, steps=1000, size=SIZE):
    """Write depth of so many meters, unknown in the first row, where an array has 0, less and no number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    depth = np.full(size, meters, np.float32)
    if path.suffix == ".npy":
        depth[0, :3] = 0, -1, np.nan
        np.save(path, depth)
    else:
        depth[0, :3] = 0
        cv2.imwrite(str(path), np.round(depth * steps).astype(np.uint16))


LAYOUTS = {  # image and depth map of a split and a number
    "ultralytics": ("images/{split}/{number:06d}.jpg", "depth/{split}/{number:06d}.npy"),
    "ultralytics, 16 bits": ("images/{split}/{number:06d}.jpg", "depth/{split}/{number:06d}.png"),
    "by split": ("{split}/rgb/{number}.png", "{split}/depth/{number}.png"),
    "NYU, as BTS has it": (
        "{split}/bathroom_0001/rgb_{number:05d}.jpg",
        "{split}/bathroom_0001/sync_depth_{number:05d}.png",
    ),
    "NYU, as toolboxes have it": ("{split}/{number:04d}_colors.png", "{split}/{number:04d}_depth.png"),
}


def write_set(root, layout, splits=("train", "val"), count=4, steps=1000):
    for split in splits:
        for number in range(count):
            image, depth = (root / each.format(split=split, number=number) for each in LAYOUTS[layout])
            write_image(image, 10 * number)
            write_depth(depth, 2 + number, steps)


def module(root, **options):
    small = {"height": 32, "width": 64, "batch_size": 2, "workers": 0}
    return datamodules.build("pairs", root=str(root), **{**small, **options})


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_are_found_with_their_splits(tmp_path, layout):
    write_set(tmp_path / "set", layout)
    (tmp_path / "set" / "camera.yaml").write_text("image_size: [80, 48]\nK: [60, 60, 39.5, 23.5]\nfps: 10\n")
    data = module(tmp_path / "set", target_depth=True)
    data.setup()
    assert {name: len(each) for name, each in data.datasets.items()} == {"train": 2, "val": 2, "test": 4, "predict": 4}
    (drive,) = data.datasets["train"].drives
    assert "train" in drive.name
    assert drive.intrinsics(0).tolist() == [[30, 0, 19.5], [0, 30, 11.5], [0, 0, 1]]
    depth = drive.depth(3)
    assert depth[0, :3].tolist() == [0, 0, 0]
    assert (depth[1:] == 5).all()
    batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
    train_on(batch)
    assert batch["target_depth"].max() in (3, 4)


def test_png_stores_what_depth_scale_says(tmp_path):
    write_set(tmp_path, "by split", steps=256)
    data = module(tmp_path, depth_scale=256.0)
    with pytest.warns(UserWarning, match=r"2 of 2 folders have no camera\.yaml.*60 degrees is assumed"):
        data.setup("test")
    drive = data.datasets["test"].drives[0]
    assert drive.depth(1)[1, 1] == 3
    K = drive.intrinsics(0)
    assert 2 * np.degrees(np.arctan(20 / K[0, 0])) == pytest.approx(VIEW)
    assert K[1].tolist() == [0, K[0, 0], 11.5]


@pytest.mark.filterwarnings("ignore:.*folders have no camera")
def test_without_splits_the_end_is_held_out_and_sizes_may_differ(tmp_path):
    for number in range(10):
        size = (24 + number, 40)
        write_image(tmp_path / "images" / f"frame_{number}.png", size=size)
        if number != 9:
            write_depth(tmp_path / "depth" / f"frame_{number}.npy", 1 + number, size=size)
    data = module(tmp_path, val_share=0.3)
    data.setup("test")
    assert len(data.datasets["test"]) == 2  # 7 and 8; 9 has no depth
    assert "1 without ground truth" in data.summary("test")
    assert next(data.batches("test", "cpu"))["depth_size"].tolist() == [[31, 40], [32, 40]]
    with pytest.raises(ConfigError, match="val_drives names 'night', which matches no drive"):
        module(tmp_path, val_drives=["night"]).setup("test")


@pytest.mark.filterwarnings("ignore:.*folders have no camera")
def test_numbers_that_names_skip_are_no_neighbors(tmp_path):
    for number in (1, 2, 3, 7, 8):
        write_image(tmp_path / "images" / f"{number}.png")
        write_depth(tmp_path / "depth" / f"{number}.npy", 1)
    data = module(tmp_path, val_share=0.0)
    data.setup("fit")
    assert data.datasets["train"].windows == [(0, 2)]


def test_what_is_missing_or_broken_is_one_sentence(tmp_path):
    write_image(tmp_path / "images" / "a.png")
    write_depth(tmp_path / "depth" / "b.npy", 1)
    with pytest.raises(
        DataError, match=r"1 images and 1 depth maps below .* no image matches a depth map; expected images/"
    ):
        module(tmp_path).setup("fit")
    with pytest.raises(DataError, match=r"no data root at .*gone"):
        module(tmp_path / "gone").setup("fit")
    write_image(tmp_path / "rgb" / "a.jpg")
    with pytest.raises(DataError, match=r"would share one depth map; remove one"):
        module(tmp_path).setup("fit")
    np.save(tmp_path / "whole.npy", np.ones(SIZE, np.int64))
    with pytest.raises(DataError, match=r"whole\.npy contains int64 of shape \(24, 40\)"):
        read_pair_depth(tmp_path / "whole.npy", 1000.0)
    cv2.imwrite(str(tmp_path / "d.png"), np.zeros(SIZE, np.uint8))
    with pytest.raises(DataError, match=r"d\.png holds uint8"):
        read_pair_depth(tmp_path / "d.png", 1000.0)
    with pytest.raises(ConfigError, match="depth_scale is 0"):
        module(tmp_path, depth_scale=0.0)
    (tmp_path / "rgb" / "a.jpg").unlink()
    write_image(tmp_path / "images" / "b.png")
    (tmp_path / "camera.yaml").write_text("image_size: [40, 24]\nK: [30, 30, 19.5, 11.5]\ndistortion: [0.1, 0, 0, 0]\n")
    with pytest.raises(DataError, match=r"camera\.yaml describes images with distortion"):
        module(tmp_path).setup("fit")
