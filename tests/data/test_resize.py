from __future__ import annotations

import numpy as np

from saunet.data.loading.windows import resize_depth


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
