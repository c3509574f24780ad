"""Make3D: a tiny test set in its layout, written and read back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import scipy.io

from saunet.data.sets.make3d import COUNT
from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules


def write_test_set(root, names=("math7-p-282t0", "op1-p-015t000"), size=(2272, 1704)):
    """Write images whose rows say where they were, and distances 10 + row m."""
    images, grids = root / "Test134", root / "Gridlaserdata"
    images.mkdir(parents=True)
    grids.mkdir()
    for name in names:
        picture = np.repeat((np.arange(size[0]) * 250 // size[0]).astype(np.uint8)[:, None], size[1], axis=1)
        cv2.imwrite(str(images / f"img-{name}.jpg"), picture)
        grid = np.zeros((55, 305, 4))
        grid[..., 2], grid[..., 3] = 1, 10 + np.arange(55)[:, None]
        scipy.io.savemat(grids / f"depth_sph_corr-{name}.mat", {"Position3DGrid": grid})
    return root


def module(root, **options):
    return datamodules.build("make3d", root=str(root), height=32, width=64, batch_size=2, workers=0, **options)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_test_set(tmp_path_factory.mktemp("make3d"))


@pytest.mark.filterwarnings("ignore:132 of 134 test images")
def test_the_central_part_is_tested_against_its_rows_of_depth(root):
    data = module(root)
    data.setup("test")
    drive = data.datasets["test"].drives[0]
    assert (data.protocol, drive.frame_size, drive.image(0).shape) == ("make3d", (852, 1704), (852, 1704, 3))
    np.testing.assert_allclose(
        drive.intrinsics(0)[[0, 1, 0, 1], [0, 1, 2, 2]], [2407.33, 2400.21, 833.72, 400.71], atol=0.01
    )
    depth = drive.depth(1)
    assert depth.shape == (21, 305)
    assert (depth[0, 0], depth[-1, 0]) == (10 + 17, 10 + 37)  # the fourth number of each point, of the middle rows
    # rows of both are the same part of the picture: the middle of the middle 21 of 55, and of 2272 rows
    assert np.median(drive.image(0)) == pytest.approx(125, abs=3)
    batch = next(data.batches("test", "cpu"))
    assert batch["depth"].shape == (2, 1, 21, 305)
    whole = module(root, crop=False)
    whole.setup("test")
    assert (whole.datasets["test"].drives[0].image(0).shape, whole.datasets["test"].drives[0].depth(0).shape) == (
        (2272, 1704, 3),
        (55, 305),
    )


def test_what_is_missing_is_counted_and_training_is_refused(root, tmp_path):
    assert COUNT == 134  # images of Test134
    with pytest.warns(UserWarning, match=r"132 of 134 test images are missing at .*Test134\.tar\.gz"):
        module(root / "Test134").setup("test")
    with pytest.raises(ConfigError, match="make3d has only single test images"):
        module(root).setup("fit")
    with pytest.raises(DataError, match=r"no 'img-\*\.jpg' at .*unpack Test134\.tar\.gz"):
        module(tmp_path).setup("test")
    write_test_set(tmp_path, ("a", "b"), (40, 30))
    maps = sorted((tmp_path / "Gridlaserdata").iterdir())
    maps[0].unlink()
    data = module(tmp_path)
    with pytest.warns(UserWarning, match=r"1 of 2 depth maps of images are missing, the first .*img-a\.jpg"):
        data.setup("test")
    assert "1 without ground truth" in data.summary("test")
    maps[1].write_bytes(b"not MATLAB")
    with pytest.raises(DataError, match=r"depth_sph_corr-b\.mat is not a readable MATLAB file with a Position3DGrid"):
        next(data.batches("test", "cpu"))
