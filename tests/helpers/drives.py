"""A recording made of numbers: every frame is known in advance."""

from __future__ import annotations

import numpy as np

from saunet.data.drive import Drive


class NumberDrive(Drive):
    """Frames whose pixels are the frame number; K, depth and poses to match."""

    def __init__(self, name="day/drive l", indices=range(8), size=(20, 30), truth=True, truth_size=None):
        self._name = name
        self._indices = list(indices)
        self.size = size
        self.truth = truth
        self.truth_size = truth_size or size

    @property
    def name(self):
        return self._name

    @property
    def indices(self):
        return self._indices

    def image(self, index):
        return np.full((*self.size, 3), index, np.uint8)

    def intrinsics(self, index):
        height, width = self.size
        return np.array([[width, 0, 0.45 * width], [0, width, 0.55 * height], [0, 0, 1]], np.float64)

    def depth(self, index):
        return np.full(self.truth_size, 1.0 + index, np.float32) if self.truth else None

    def pose(self, index):
        pose = np.eye(4)
        pose[:3, 3] = 0.1 * index, 0, index
        return pose if self.truth else None
