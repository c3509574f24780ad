"""Filtered materials: right on average at every footprint, and steady."""

from __future__ import annotations

import numpy as np
import pytest

from saunet.synthetic.materials import INDEX, MATERIALS, SIZE, colored_noise, coverage, grain, sample
from saunet.synthetic.shade import _dashed


def _grid(count: int) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid((np.arange(count) + 0.5) / count, (np.arange(count) + 0.5) / count)
    return u.ravel().astype(np.float32), v.ravel().astype(np.float32)


def _luminance(name: str, u: np.ndarray, v: np.ndarray, du: float, dv: float) -> np.ndarray:
    full = np.full(u.size, INDEX[name], np.float32)
    return sample(full, u, v, np.full_like(u, du), np.full_like(u, dv))[0]


@pytest.mark.parametrize("name", MATERIALS)
def test_a_large_footprint_sees_the_mean(name: str) -> None:
    u, v = _grid(64)
    fine = _luminance(name, u, v, 1 / SIZE, 1 / SIZE)
    coarse = _luminance(name, u, v, 0.99, 0.99)
    np.testing.assert_allclose(coarse, fine.mean(), atol=0.06)
    assert 0.2 < fine.mean() < 1.6


@pytest.mark.parametrize("name", ["asphalt", "brick", "foliage"])
def test_detail_fades_as_the_footprint_grows(name: str) -> None:
    u, v = _grid(64)
    spread = [_luminance(name, u, v, step, step).std() for step in (1 / 256, 1 / 64, 1 / 16, 1 / 4)]
    assert spread == sorted(spread, reverse=True)
    assert spread[0] > 0.08


def test_footprints_are_independent_along_and_across() -> None:
    u, v = _grid(64)
    along = _luminance("planks", u, v, 1 / SIZE, 0.9).reshape(64, 64)
    across = _luminance("planks", u, v, 0.9, 1 / SIZE).reshape(64, 64)
    assert along.std(axis=1).mean() > 5 * along.std(axis=0).mean()
    assert across.std(axis=0).mean() > 0.03
    assert across.std(axis=1).mean() < 0.01


def test_pictures_repeat_without_a_seam() -> None:
    u, v = _grid(32)
    here, there = (_luminance("grass", u + shift, v - shift, 1 / 64, 1 / 64) for shift in (0, 3))
    np.testing.assert_allclose(here, there, atol=0.03)  # positions are looked up in steps of 1/32 texel
    edge = np.array([0.0, 1.0, 2.0], np.float32)
    values = _luminance("grass", edge, edge, 1 / SIZE, 1 / SIZE)
    assert np.ptp(values) < 0.03


def test_lookup_moves_smoothly_with_position_and_footprint() -> None:
    count = 2000
    v = np.full(count, 0.3, np.float32)
    u = np.linspace(0, 0.5, count, dtype=np.float32)
    assert np.abs(np.diff(_luminance("asphalt", u, v, 1 / 128, 1 / 128))).max() < 0.08
    steps = np.geomspace(1 / 512, 1, count).astype(np.float32)
    full = np.full(count, INDEX["asphalt"], np.float32)
    fixed = np.full(count, 0.37, np.float32)
    assert np.abs(np.diff(sample(full, fixed, v, steps, steps)[0])).max() < 0.02


def test_no_samples_are_no_work() -> None:
    none = np.zeros(0, np.float32)
    assert sample(none, none, none, none, none)[0].size == 0
    assert grain(none, none, none).size == 0


def test_grain_has_mean_zero() -> None:
    u, v = _grid(128)
    noise = grain(u, v, np.full_like(u, 1 / SIZE))
    assert abs(noise.mean()) < 0.05
    assert 0.7 < noise.std() < 1.3


def test_noise_is_periodic_and_band_limited() -> None:
    noise = colored_noise(np.random.default_rng(0), 4, 16, 0.5)
    spectrum = np.abs(np.fft.fft2(noise))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(SIZE), np.fft.fftfreq(SIZE))) * SIZE
    assert spectrum[frequency > 16.01].max() < 1e-6 * spectrum.max()
    assert noise.std() == pytest.approx(1)


def test_coverage_wraps_and_keeps_the_length() -> None:
    assert coverage(0.2, 0.5).sum() / SIZE == pytest.approx(0.3)
    wrapped = coverage(0.9, 1.1)
    assert wrapped.sum() / SIZE == pytest.approx(0.2)
    assert wrapped[0] == 1
    assert wrapped[-1] == 1


def test_dashes_are_box_filtered_exactly() -> None:
    position = np.linspace(0, 20, 101).astype(np.float32)
    for pixel in (0.3, 4.0, 9.0):
        fine = position[:, None] + (np.arange(4000) + 0.5) / 4000 * pixel - pixel / 2
        brute = ((fine % 5.0) < 2.0).mean(axis=1)
        np.testing.assert_allclose(_dashed(position, 2.0, 3.0, np.full_like(position, pixel)), brute, atol=2e-3)
