"""Protocols on real LiDAR frames: true depth times known factors gives errors known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from saunet.metrics.functional import A1, A2, ABS_REL, RMSE_LOG
from saunet.metrics.protocols import evaluate_image, protocol


@pytest.fixture(params=[("frame0", "cam"), ("frame0", "vel"), ("frame10", "cam"), ("frame10", "vel")])
def scan(request, reference):
    """A real sparse depth map and the protocol that belongs to it."""
    frame, kind = request.param
    data = reference("lidar_depth")
    truth = torch.zeros(*data[f"{frame}_shape"].tolist())
    rows, columns, values = (data[f"{frame}_{kind}_{part}"] for part in ("rows", "cols", "values"))
    truth[torch.from_numpy(rows.astype(np.int64)), torch.from_numpy(columns.astype(np.int64))] = torch.from_numpy(
        values
    )
    return truth, protocol("eigen_camera_z" if kind == "cam" else "eigen_lidar_x")


def test_one_factor_is_removed_by_median_scaling(scan):
    truth, rules = scan
    disparity = torch.where(truth > 0, 1 / (2.7 * truth), 0.1)
    image = evaluate_image(disparity, truth, rules)
    assert image.pixels == rules.mask(truth).sum() > 5000
    assert image.ratio.item() == pytest.approx(1 / 2.7, rel=1e-6)
    assert image.errors[:4].max() < 1e-4
    assert image.errors[4:].tolist() == [1, 1, 1]


def test_two_factors_without_scaling(scan):
    """1.1 on even columns, 1.3 on odd ones; nothing deeper than 60 m, so that the cap does not bite."""
    truth, _ = scan
    truth = torch.where(truth < 60, truth, 0.0)
    odd = (torch.arange(truth.shape[1]) % 2).bool().expand_as(truth)
    factor = torch.where(odd, 1.3, 1.1)
    rules = protocol("metric")
    image = evaluate_image(torch.where(truth > 0, 1 / (factor * truth), 0.1), truth, rules)
    share = odd[rules.mask(truth)].double().mean().item()
    assert image.errors[ABS_REL].item() == pytest.approx(0.3 * share + 0.1 * (1 - share), rel=1e-5)
    squares = math.log(1.3) ** 2 * share + math.log(1.1) ** 2 * (1 - share)
    assert image.errors[RMSE_LOG].item() == pytest.approx(math.sqrt(squares), rel=1e-5)
    assert image.errors[A1].item() == pytest.approx(1 - share, abs=1e-12)
    assert image.errors[A2].item() == 1.0


def test_lidar_x_and_camera_z_are_not_the_same(reference):
    data = reference("lidar_depth")
    cam, vel = (np.median(data[f"frame0_{kind}_values"]) for kind in ("cam", "vel"))
    assert 0.1 < vel - cam < 0.5
