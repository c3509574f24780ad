"""A tiny depth network that costs nothing, and pictures to feed it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from saunet.models.depth import DepthNet
from saunet.prediction.predictor import Predictor
from saunet.types import FeatureSpec


class TinyEncoder(nn.Module):
    """The image itself, at half size."""

    features = (FeatureSpec(3, 2),)
    size_divisor = 8

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        return (nn.functional.avg_pool2d(image, 2),)


class TinyDecoder(nn.Module):
    """Nearer where the picture is brighter and lower; not symmetric, so that a flip shows."""

    def __init__(self, features: tuple[FeatureSpec, ...]) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(0.5))

    def forward(self, features: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        gray = nn.functional.interpolate(features[0].mean(1, keepdim=True), scale_factor=2.0, mode="bilinear")
        rows = torch.linspace(0, 1, gray.shape[-2]).view(1, 1, -1, 1)
        columns = torch.linspace(0, 0.1, gray.shape[-1]).view(1, 1, 1, -1)
        return (((gray + rows + columns) * 0.4 * self.gain + 0.05).clamp(0.01, 0.99),)


@pytest.fixture
def network() -> DepthNet:
    return DepthNet(TinyEncoder(), TinyDecoder)


@pytest.fixture
def predictor(network: DepthNet) -> Predictor:
    return Predictor(network, 32, 64)


@pytest.fixture(scope="session")
def picture() -> NDArray[np.uint8]:
    """A smooth color picture, 40 x 90, with different corners."""
    y, x = np.mgrid[0:40, 0:90]
    return np.stack([x * 255 // 89, y * 255 // 39, 255 - x * 255 // 89], axis=-1).astype(np.uint8)


@pytest.fixture
def folder(tmp_path: Path, picture: NDArray[np.uint8]) -> Path:
    """Three pictures, one of them deeper down."""
    for index, name in enumerate(("a.png", "b.jpg", "deep/c.png")):
        path = tmp_path / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.roll(picture, index * 20, axis=1)[:, :, ::-1])
    return tmp_path / "in"
