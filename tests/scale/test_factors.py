"""Each way to measure the scale, on drives whose true depth is known up to a factor."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from saunet.geometry.pose import pose_matrix
from saunet.scale.estimate import height_factors, speed_factors, stereo_factors
from saunet.synthetic import SyntheticDrive

UNKNOWN = 0.042  # what the true depth is multiplied by before anything looks at it


@pytest.fixture(scope="module")
def street() -> SyntheticDrive:
    return SyntheticDrive(seed=11, frames=3, height=96, width=288)


def images(drive: SyntheticDrive, index: int) -> Tensor:
    return torch.from_numpy(drive.image(index)).permute(2, 0, 1)[None] / 255


def depth_of(drive: SyntheticDrive, index: int) -> Tensor:
    depth = torch.from_numpy(drive.depth(index))[None, None]
    return UNKNOWN * torch.where(depth > 0, depth, 1000.0)  # a network has an answer for the sky too


def K_of(drive: SyntheticDrive) -> Tensor:
    return torch.from_numpy(drive.intrinsics()).float()[None]


def test_camera_height_within_three_percent(street: SyntheticDrive) -> None:
    factors = torch.cat([height_factors(depth_of(street, i), K_of(street), 1.65) for i in range(3)])
    torch.testing.assert_close(factors, torch.full((3,), 1 / UNKNOWN), rtol=0.03, atol=0)


def test_camera_height_of_a_scene_without_road_is_unknown(street: SyntheticDrive) -> None:
    assert height_factors(torch.full((1, 1, 96, 288), 3.0), K_of(street), 1.65).isnan().all()
    rough = torch.rand(1, 1, 96, 288, generator=torch.Generator().manual_seed(0)) * 5 + 1
    assert height_factors(rough, K_of(street), 1.65).isnan().all()


@pytest.mark.parametrize("side", ["left", "right"])
def test_stereo_within_five_percent_from_either_camera(street: SyntheticDrive, side: str) -> None:
    drive = street if side == "left" else street.stereo()
    T = torch.from_numpy(drive.T_stereo_cam).float()[None]
    factor = stereo_factors(depth_of(drive, 1), images(drive, 1), images(drive.stereo(), 1), K_of(drive), T)
    torch.testing.assert_close(factor, torch.tensor([1 / UNKNOWN]), rtol=0.05, atol=0)


def test_stereo_of_images_that_do_not_match_is_unknown(street: SyntheticDrive) -> None:
    T = torch.from_numpy(street.T_stereo_cam).float()[None]
    gray = torch.full((1, 3, 96, 288), 0.5)
    assert stereo_factors(depth_of(street, 1), gray, gray, K_of(street), T).isnan().all()


def test_speed_is_way_over_predicted_way() -> None:
    translation = torch.tensor([[[0.3, 0.0, 0.4], [0.0, 0.0, -0.5]], [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]])
    poses = pose_matrix(torch.zeros(2, 2, 3), translation)
    distance = torch.tensor([[2.0, 3.0], [math.nan, 4.0]])
    torch.testing.assert_close(speed_factors(poses, distance), torch.tensor([5.0, 4.0]))


@pytest.mark.parametrize("distance", [math.nan, 0.0, 0.05])
def test_unknown_speed_and_a_standing_car_say_nothing(distance: float) -> None:
    poses = pose_matrix(torch.zeros(1, 1, 3), torch.ones(1, 1, 3))
    assert speed_factors(poses, torch.tensor([[distance]])).isnan().all()


def test_speed_of_a_model_that_predicts_no_motion_is_unknown() -> None:
    assert speed_factors(torch.eye(4)[None, None], torch.ones(1, 1)).isnan().all()


def test_inputs_are_left_alone(street: SyntheticDrive) -> None:
    depth, picture = depth_of(street, 1), images(street, 1)
    copies: list[Any] = [depth.clone(), picture.clone()]
    height_factors(depth, K_of(street), 1.0)
    stereo_factors(depth, picture, picture, K_of(street), torch.from_numpy(street.T_stereo_cam).float()[None])
    assert torch.equal(depth, copies[0])
    assert torch.equal(picture, copies[1])
    assert np.isfinite(street.depth(1)).all()
