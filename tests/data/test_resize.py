from __future__ import annotations

import numpy as np

from saunet.data.resize import resize_depth, resize_image


def test_resize_keeps_pixel_centres():
    ramp = np.broadcast_to(np.arange(40, dtype=np.uint8)[None, :, None] * 6, (20, 40, 3)).copy()
    halved = resize_image(ramp, 10, 20)
    # new pixel u covers old 2u and 2u + 1, whose mean stands at 2u + 0.5
    assert np.abs(halved[0, :, 0] - 6 * (2 * np.arange(20) + 0.5)).max() <= 0.5
    assert resize_image(ramp, 40, 80).shape == (40, 80, 3)
    assert resize_image(ramp, 20, 40) is ramp


def test_sparse_depth_moves_with_its_pixel_and_the_nearest_wins():
    depth = np.zeros((20, 40), np.float32)
    depth[4, 10], depth[5, 11], depth[19, 39] = 9, 7, 3
    small = resize_depth(depth, 10, 20)
    assert small[2, 5] == 7
    assert small[9, 19] == 3
    assert np.count_nonzero(small) == 2


def test_dense_depth_is_sampled_not_mixed():
    depth = np.where(np.arange(40) < 20, 2, 50).astype(np.float32)[None].repeat(20, 0)
    assert set(np.unique(resize_depth(depth, 7, 13))) == {2, 50}
