"""Named protocols against an established implementation's loop, NumPy and closed forms."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np
import pytest
import torch

from saunet.errors import ConfigError
from saunet.metrics.functional import A1, ABS_REL, RMSE_LOG, crop_window, flip_blend
from saunet.metrics.protocols import PROTOCOLS, Protocol, evaluate_image, protocol, sample_image

EIGEN = protocol("eigen_camera_z")


def close_to_reference(errors, expected):
    np.testing.assert_allclose(errors[:4], expected[:4], rtol=1e-6)
    np.testing.assert_allclose(errors[4:], expected[4:], atol=1e-6)


@pytest.mark.parametrize(
    ("rules", "key"),
    [
        (EIGEN, "eigen_metrics_median_scaled"),
        (protocol("metric"), "eigen_metrics"),
        (dataclasses.replace(protocol("metric"), factor=4.3), "eigen_metrics_scaled_by_4.3"),
    ],
)
def test_eigen_reference(reference, rules, key):
    data = reference("metrics")
    for i in range(2):
        disparity, truth = (torch.from_numpy(data[k][i]) for k in ("eigen_disparity", "eigen_gt"))
        image = evaluate_image(disparity, truth, rules)
        assert image.pixels == data["eigen_count"][i]
        close_to_reference(image.errors, data[key][i])
        np.testing.assert_allclose(image.ratio * rules.factor, data["eigen_median_ratio"][i], rtol=1e-6)


def test_eigen_reference_blended(reference):
    data = reference("metrics")
    direct, flipped = (
        torch.from_numpy(data[k])[:, None] for k in ("eigen_disparity", "eigen_disparity_of_flipped_input")
    )
    blended = flip_blend(direct, flipped)
    for i in range(2):
        image = evaluate_image(blended[i, 0], torch.from_numpy(data["eigen_gt"][i]), EIGEN)
        close_to_reference(image.errors, data["eigen_metrics_blended_median_scaled"][i])


@pytest.mark.parametrize(("alignment", "key"), [("none", "loop_clamped"), ("median", "loop_clamped_median_scaled")])
def test_loop_without_crop_reference(reference, alignment, key):
    data = reference("metrics")
    rules = dataclasses.replace(protocol("eigen_improved"), alignment=alignment)
    for i in range(4):
        truth = torch.from_numpy(data["plain_gt"][i])
        image = evaluate_image(torch.from_numpy(data["loop_disparity"][i]), truth, rules)
        close_to_reference(image.errors, data[key][i])


def test_mask_is_strict_capped_and_cropped():
    truth = torch.full((40, 60), 10.0)
    top, bottom, left, right = crop_window("garg", 40, 60)
    truth[top, left], truth[top, left + 1], truth[top, left + 2], truth[top, left + 3] = 80.0, 1e-3, 0.0, 79.9
    mask = EIGEN.mask(truth)
    assert mask.sum() == (bottom - top) * (right - left) - 3
    assert mask[top, left + 3]
    assert not mask[:top].any()
    assert not mask[:, right:].any()
    assert protocol("eigen_improved").mask(truth).sum() == 40 * 60 - 1
    assert protocol("synthetic").mask(truth).sum() == 40 * 60 - 3


@pytest.mark.parametrize("name", sorted(PROTOCOLS))
def test_k_times_truth(name):
    """Each alignment removes a factor exactly; without any it shows as the closed form."""
    truth = torch.rand(40, 60, dtype=torch.float64) * 20 + 5
    image = evaluate_image(1 / (1.5 * truth), truth, protocol(name))
    assert image.ratio.item() == pytest.approx(1 / 1.5)
    scaled = protocol(name).alignment != "none"
    assert image.errors[ABS_REL].item() == pytest.approx(0.0 if scaled else 0.5, abs=1e-12)
    assert image.errors[RMSE_LOG].item() == pytest.approx(0.0 if scaled else np.log(1.5), abs=1e-12)
    assert image.errors[A1].item() == (1.0 if scaled else 0.0)


def fitted(columns, wanted):
    return np.linalg.lstsq(np.stack(columns, 1), wanted, rcond=None)[0]


@pytest.mark.parametrize("factor", [1.0, 2.5])
def test_least_squares_alignments_are_those_of_a_solver(factor):
    generator = torch.Generator().manual_seed(4)
    truth = torch.rand(30, 40, generator=generator, dtype=torch.float64) * 60 + 3
    disparity = (0.3 / truth + 0.01 * torch.rand(30, 40, generator=generator)).double()
    t, d = truth.flatten().numpy(), disparity.flatten().numpy()
    for alignment in ("least_squares", "least_squares_disparity"):
        rules = dataclasses.replace(protocol("synthetic"), alignment=alignment, factor=factor)
        sample = sample_image(disparity, truth, rules)
        if alignment == "least_squares":
            expected = fitted([factor / d], t)[0] * factor / d
        else:
            slope, shift = fitted([d, np.ones_like(d)], 1 / t)
            assert sample.shift.item() == pytest.approx(shift)
            assert sample.ratio.item() == pytest.approx(1 / slope / factor)
            expected = 1 / np.maximum(slope * d + shift, 1e-9)
        np.testing.assert_allclose(sample.prediction.numpy(), expected.clip(0.1, 80), rtol=1e-9)


def test_disparity_of_any_scale_shift_and_sign_is_aligned():
    """Affine-invariant models predict disparity whose zero means nothing; some of it is below zero."""
    truth = torch.linspace(2, 90, 600, dtype=torch.float64).view(20, 30)
    for slope, shift in ((3.0, -0.5), (-40.0, 7.0)):
        image = evaluate_image(slope / truth + shift, truth, protocol("syns"))
        assert image.errors[:4].max() < 1e-6
        assert image.ratio.item() == pytest.approx(slope)


def test_constant_disparity_can_be_aligned():
    truth = torch.linspace(2, 90, 600, dtype=torch.float64).view(20, 30)
    sample = sample_image(torch.full((4, 6), 0.37), truth, protocol("syns"))
    assert sample.prediction.numpy() == pytest.approx(1 / (1 / truth).mean().item())


def test_cityscapes_is_the_published_slice():
    """ManyDepth: of 1024x2048, rows 256 to 768 and columns 192 to 1856; here of images of an eighth of that."""
    truth = torch.rand(96, 256, dtype=torch.float64) * 100
    cut = truth[256 // 8 :, 192 // 8 : 1856 // 8]
    rules = protocol("cityscapes")
    kept = cut[(cut > 1e-3) & (cut < 80)]
    torch.testing.assert_close(sample_image(torch.rand(24, 64), truth, rules).target, kept)
    assert crop_window("cityscapes", 768, 2048) == (256, 768, 192, 1856)
    assert crop_window("nyu", 480, 640) == (45, 471, 41, 601)


@pytest.mark.parametrize(
    ("name", "limits", "crop", "alignment"),
    [
        ("kitti_360", (1e-3, 80), "none", "median"),
        ("nuscenes", (0.1, 80), "none", "median"),
        ("cityscapes", (1e-3, 80), "cityscapes", "median"),
        ("ddad", (1e-3, 200), "none", "median"),
        ("make3d", (1e-3, 70), "none", "median"),
        ("indoor", (0.1, 10), "none", "median"),
        ("nyu", (1e-3, 10), "nyu", "median"),
        ("syns", (1e-3, 100), "none", "least_squares_disparity"),
    ],
)
def test_published_rules(name, limits, crop, alignment):
    rules = protocol(name)
    assert (rules.min_depth, rules.max_depth, rules.crop, rules.alignment) == (*limits, crop, alignment)
    assert rules.ground_truth == "camera_z"


def test_another_alignment_by_name():
    rules = protocol("ddad/none")
    assert rules == dataclasses.replace(protocol("ddad"), name="ddad/none", alignment="none")
    with pytest.raises(ConfigError, match=r"alignment is 'lsq', allowed: median"):
        protocol("ddad/lsq")
    with pytest.raises(ConfigError, match="campus/median"):
        protocol("campus/median")


def test_clamps_after_scaling():
    truth = torch.full((20, 30), 50.0)
    rules = protocol("synthetic")
    disparity = torch.full((20, 30), 1.0)
    disparity[0, 0], disparity[0, 1], disparity[0, 2] = 1e-4, 1e4, -1.0
    prediction = sample_image(disparity, truth, rules).prediction.view(20, 30)
    assert prediction[0, 0] == 80
    assert prediction[0, 1] == 0.1
    assert prediction[0, 2] == 80
    assert prediction[5, 5] == pytest.approx(50)


def test_resizes_the_disparity_not_the_depth():
    disparity = torch.tensor([[1.0, 0.1]])
    sample = sample_image(disparity, torch.full((1, 4), 3.0), protocol("synthetic"))
    expected = 1 / torch.tensor([1.0, 0.775, 0.325, 0.1], dtype=torch.float64)
    expected = expected * 3.0 / expected.median().add(expected.sort().values[2]).div(2)
    torch.testing.assert_close(sample.prediction, expected, rtol=1e-6, atol=0)


def test_sample_follows_its_mask():
    truth = torch.zeros(40, 60)
    truth[20, 10:40] = torch.arange(1.0, 31.0)
    sample = sample_image(torch.rand(10, 15), truth, EIGEN)
    torch.testing.assert_close(sample.target, truth[sample.mask].double())


def test_no_valid_truth_is_zero_pixels_and_nan():
    image = evaluate_image(torch.rand(4, 5), torch.zeros(20, 30), EIGEN)
    assert image.pixels == 0
    assert image.errors.isnan().all()
    assert image.ratio.isnan()


def test_half_precision_disparity_is_widened():
    truth = torch.rand(20, 30) * 20 + 5
    image = evaluate_image(torch.rand(10, 15).half() + 0.1, truth, EIGEN)
    assert image.errors.dtype == torch.float64
    assert image.errors.isfinite().all()


def test_names_and_summaries():
    for name, rules in PROTOCOLS.items():
        assert protocol(name) is rules
        assert rules.name == name
        assert rules.summary
        assert "\n" not in rules.summary


def test_unknown_name_suggests_the_nearest():
    with pytest.raises(ConfigError, match=r"did you mean 'eigen_lidar_x'.*synthetic"):
        protocol("eigen_lidar")


def test_accepts():
    assert EIGEN.accepts("camera_z")
    assert EIGEN.accepts("exact")
    assert not EIGEN.accepts("lidar_x")
    assert not protocol("synthetic").accepts("camera_z")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_depth": 1e-4}, "max_depth is 0.0001; it must be greater than min_depth"),
        ({"min_depth": 0.0}, "min_depth is 0"),
        ({"factor": -1.0}, "factor is -1"),
    ],
)
def test_bad_values(change, message):
    with pytest.raises(ConfigError, match=message):
        dataclasses.replace(EIGEN, **change)
    assert Protocol("mine").name == "mine"


@pytest.mark.parametrize(
    ("field", "word", "message"),
    [
        ("crop", "gargs", "crop is 'gargs'; did you mean 'garg'"),
        ("alignment", "medain", "alignment is 'medain'; did you mean 'median'"),
        ("ground_truth", "velodyne", "ground_truth is 'velodyne', allowed: lidar_x"),
    ],
)
def test_unknown_words(field, word, message):
    """The type checker of the test run refuses such words first, so the check is called by itself."""
    rules = copy.copy(EIGEN)
    object.__setattr__(rules, field, word)
    with pytest.raises(ConfigError, match=message):
        rules.__post_init__()
