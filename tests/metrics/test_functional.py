"""Error functions against NumPy, closed forms and an established implementation."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from saunet.metrics import functional as F


def numpy_errors(d, t):
    d, t = np.asarray(d, np.float64), np.asarray(t, np.float64)
    thresh = np.maximum(d / t, t / d)
    return [
        np.mean(np.abs(d - t) / t),
        np.mean((d - t) ** 2 / t),
        np.sqrt(np.mean((d - t) ** 2)),
        np.sqrt(np.mean((np.log(d) - np.log(t)) ** 2)),
        *(np.mean(thresh < 1.25**p) for p in (1, 2, 3)),
    ]


def image_errors(prediction, target, mask):
    """The seven errors of each image over its masked pixels, b x 7."""
    triples = zip(prediction, target, mask, strict=True)
    return torch.stack([F.root_terms(F.error_terms(p[m], t[m]).mean(-1)) for p, t, m in triples])


def random_pair(b=3, h=7, w=11):
    target = torch.rand(b, 1, h, w) * 70 + 1
    prediction = target * (torch.rand(b, 1, h, w) * 1.5 + 0.3)
    mask = torch.rand(b, 1, h, w) > 0.4
    return prediction, target, mask


def test_matches_numpy_image_by_image():
    prediction, target, mask = random_pair()
    errors = image_errors(prediction, target, mask)
    assert errors.dtype == torch.float64
    for row, d, t, m in zip(errors, prediction, target, mask, strict=True):
        np.testing.assert_allclose(row.numpy(), numpy_errors(d[m].numpy(), t[m].numpy()), rtol=1e-12)


@pytest.mark.parametrize("k", [0.5, 0.81, 1.0, 1.2, 1.3, 1.6, 1.9, 2.5])
def test_prediction_k_times_truth_has_closed_form(k):
    target = torch.rand(1, 1, 9, 8, dtype=torch.float64) * 50 + 2
    errors = image_errors(k * target, target, torch.ones_like(target, dtype=torch.bool))[0]
    expected = {
        F.ABS_REL: abs(k - 1),
        F.SQ_REL: (k - 1) ** 2 * target.mean().item(),
        F.RMSE: abs(k - 1) * target.square().mean().sqrt().item(),
        F.RMSE_LOG: abs(np.log(k)),
        F.A1: float(max(k, 1 / k) < 1.25),
        F.A2: float(max(k, 1 / k) < 1.25**2),
        F.A3: float(max(k, 1 / k) < 1.25**3),
    }
    for position, value in expected.items():
        assert errors[position].item() == pytest.approx(value, abs=1e-12), F.ERROR_NAMES[position]


def test_empty_image_is_nan_and_leaves_the_others():
    prediction, target, mask = random_pair()
    mask[1] = False
    errors = image_errors(prediction, target, mask)
    assert errors[1].isnan().all()
    assert errors[[0, 2]].isfinite().all()


def test_reference_plain(reference):
    data = reference("metrics")
    assert tuple(data["metric_names"]) == F.ERROR_NAMES
    target, prediction = (torch.from_numpy(data[key]) for key in ("plain_gt", "plain_prediction"))
    mask = target > 0
    assert mask.flatten(1).sum(1).tolist() == data["plain_count"].tolist()
    errors = image_errors(prediction, target, mask)
    np.testing.assert_allclose(errors[:, :4], data["plain_metrics"][:, :4], rtol=1e-5)
    np.testing.assert_allclose(errors[:, 4:], data["plain_metrics"][:, 4:], atol=3e-4)
    ratio = torch.stack([F.median(t[m]) / F.median(p[m]) for t, p, m in zip(target, prediction, mask, strict=True)])
    np.testing.assert_allclose(ratio, data["plain_median_ratio"], rtol=1e-6)
    scaled = image_errors(prediction * ratio[:, None, None], target, mask)
    np.testing.assert_allclose(scaled[:, :4], data["plain_metrics_median_scaled"][:, :4], rtol=1e-5)
    np.testing.assert_allclose(scaled[:, 4:], data["plain_metrics_median_scaled"][:, 4:], atol=3e-4)


@pytest.mark.parametrize("values", [[3.0], [4.0, 1.0], [1.0, 2.0, 3.0, 4.0], [5.0, 1.0, 2.0]])
def test_median_is_the_true_one(values):
    assert F.median(torch.tensor(values)).item() == np.median(values)


def test_median_of_nothing_is_nan():
    assert F.median(torch.zeros(0)).isnan()


def test_garg_crop_truncates_in_double_precision(test_data):
    facts = json.loads((test_data / "reference" / "facts.json").read_text())["garg_crop"]
    assert facts
    for size, bounds in facts.items():
        height, width = map(int, size.split("x"))
        expected = tuple(bounds[key] for key in ("row_start", "row_end_exclusive", "col_start", "col_end_exclusive"))
        assert F.crop_window("garg", height, width) == expected
    assert F.crop_window("garg", 370, 1226)[1] == 366


def test_flip_blend_reference(reference):
    data = reference("metrics")
    direct, flipped = (
        torch.from_numpy(data[key])[:, None] for key in ("eigen_disparity", "eigen_disparity_of_flipped_input")
    )
    blended = F.flip_blend(direct, flipped)
    assert blended.dtype == direct.dtype
    np.testing.assert_allclose(blended[:, 0], data["eigen_blended_disparity"], atol=1e-6)


@pytest.mark.parametrize("width", [640, 1024, 1242])
def test_flip_blend_weights(test_data, width):
    facts = json.loads((test_data / "reference" / "facts.json").read_text())["flip_post_process"][str(width)]
    direct, flipped = torch.ones(1, 1, 1, width, dtype=torch.float64), torch.zeros(1, 1, 1, width, dtype=torch.float64)
    weight = F.flip_blend(direct, flipped)[0, 0, 0]
    np.testing.assert_allclose(weight[:70], facts["weight_of_unflipped_first_70"], atol=1e-12)
    assert (weight == 0).sum() == facts["columns_left_edge_using_only_flipped"]
    assert (weight == 1).sum() == facts["columns_right_edge_using_only_unflipped"]


def test_flip_blend_of_consistent_predictions_changes_nothing():
    disparity = torch.rand(2, 1, 4, 50)
    torch.testing.assert_close(F.flip_blend(disparity, disparity.flip(-1)), disparity)
