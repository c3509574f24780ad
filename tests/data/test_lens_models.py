"""Lens models against COLMAP's and OpenCV's own projection, and the straight picture that each gives."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from saunet.data.video.camera import CameraFile, Lens, read_camera
from saunet.data.video.lens_models import fold, pixels, project, seen_rays, straight_intrinsics, straightening_maps
from saunet.errors import DataError

RAYS = np.array([[0, 0, 1], [0.3, -0.2, 1], [-0.5, 0.4, 1], [0.9, 0.6, 1], [2.0, -0.5, 1.0]])
# pycolmap 4.2.1: pycolmap.Camera(model=MODEL, width=640, height=480, params=PARAMS).img_from_cam(ray) for each of RAYS
COLMAP = {
    "SIMPLE_PINHOLE 500 320 240.5": "320 240.5 470 140.5 70 440.5 770 540.5 1320 -9.5",
    "PINHOLE 500 510 320 240.5": "320 240.5 470 138.5 70 444.5 770 546.5 1320 -14.5",
    "SIMPLE_RADIAL 500 320 240.5 -0.1": "320 240.5 468.05 141.8 80.25 432.3 717.35 505.4 895 96.75",
    "RADIAL 500 320 240.5 -0.1 0.02": ("320 240.5 468.1007 141.7662 79.4095 432.9724 729.6701 513.6134 1256.25 6.4375"),
    "OPENCV 500 510 320 240.5 -0.1 0.02 0.001 -0.002": (
        "320 240.5 467.7307 140.021024 78.2995 437.602148 727.4201 518.937968 1243 6.21875"
    ),
    "OPENCV_FISHEYE 300 305 320 240.5 0.05 -0.01 0.004 -0.001": (
        "320 240.5 406.883909 181.612017 184.540189 350.67398 532.096118 384.254036 662.771618 153.37888"
    ),
    "FULL_OPENCV 500 510 320 240.5 0.3 0.05 0.001 -0.002 0.01 0.35 0.08 0.02": (
        "320 240.5 468.622884 139.414339 74.551662 440.660384 734.2162 523.559316 1028.387995 60.944811"
    ),
    "FOV 400 405 320 240.5 0.9": (
        "320 240.5 443.953902 156.831116 127.735268 396.234433 618.577835 442.040039 796.654977 119.846709"
    ),
    "SIMPLE_RADIAL_FISHEYE 300 320 240.5 0.05": (
        "320 240.5 406.89572 182.56952 184.416547 348.966763 532.832986 382.388657 666.123141 153.969215"
    ),
    "RADIAL_FISHEYE 300 320 240.5 0.05 -0.01": (
        "320 240.5 406.883334 182.577778 184.556925 348.85446 531.881262 381.754175 661.013113 155.246722"
    ),
    "THIN_PRISM_FISHEYE 300 305 320 240.5 0.05 -0.01 0.001 -0.002 0.004 -0.001 0.003 -0.002": (
        "320 240.5 406.787189 181.665397 184.305218 350.845303 531.923508 383.791388 661.555931 153.401352"
    ),
    "SIMPLE_DIVISION 400 320 240.5 -0.3": (
        "320 240.5 435.65293 163.398047 139.939416 384.548467 602.299382 428.699588 781.119312 125.220172"
    ),
    "DIVISION 400 405 320 240.5 -0.3": (
        "320 240.5 435.65293 162.434272 139.939416 386.349073 602.299382 431.052083 781.119312 123.779174"
    ),
    "SIMPLE_FISHEYE 300 320 240.5": (
        "320 240.5 406.378535 182.91431 186.580412 347.235671 525.83481 377.723207 645.724244 159.068939"
    ),
    "FISHEYE 300 305 320 240.5": (
        "320 240.5 406.378535 181.954548 186.580412 349.014598 525.83481 380.01026 645.724244 157.711755"
    ),
    "EUCM 400 405 320 240.5 0.6 1.1": (
        "320 240.5 435.222078 162.725097 141.865124 384.78925 595.362023 426.369366 757.317264 129.804068"
    ),
}


@pytest.mark.parametrize("line", COLMAP)
def test_a_ray_is_seen_where_colmap_sees_it_half_a_pixel_earlier(tmp_path, line):
    name, parameters = line.split(" ", 1)
    (tmp_path / "cameras.txt").write_text(f"# a comment\n7 {name} 640 480 {parameters}\n")
    camera = read_camera(tmp_path / "cameras.txt")
    expected = np.array(COLMAP[line].split(), float).reshape(-1, 2)
    assert camera.K[:2, 2].tolist() == [319.5, 240.0]
    seen = pixels(camera.model, camera.distortion, camera.K, RAYS)
    np.testing.assert_allclose(seen + 0.5, expected, atol=2e-6)


@pytest.mark.parametrize(
    "numbers",
    [
        [-0.3, 0.1, 0.001, -0.002, 0.01],
        [0.3, 0.05, 0.001, -0.002, 0.01, 0.35, 0.08, 0.02],
        [-0.3, 0.1, 0.001, -0.002, 0.01, 0.02, 0.01, 0.0, 0.003, 0.001, -0.002, 0.004],  # thin prism
    ],
)
def test_the_straight_picture_of_a_pinhole_lens_is_that_of_opencv(numbers):
    K = np.array([[500.0, 0, 322], [0, 510, 241], [0, 0, 1]])
    lens = Lens(CameraFile(Path("camera.yaml"), K, (480, 640), tuple(numbers)), 480, 640)
    picture = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    np.testing.assert_array_equal(lens(picture), cv2.undistort(picture, K, np.array(numbers), None, lens.K))


KITTI360 = {"xi": 2.2134, "k1": 0.016798, "k2": 1.6548, "gamma1": 1336.3, "gamma2": 1335.8, "u0": 716.94, "v0": 705.76}


def test_an_omni_lens_sees_a_ray_where_kitti360_sees_it():
    # kitti360Scripts 1.0.0, helpers/project.py, CameraFisheye.cam2image of these rays; it leaves out p1 and p2
    xi, k1, k2, gamma1, gamma2, u0, v0 = KITTI360.values()
    rays = np.array([[0, 0, 1], [1, -0.5, 1], [3, 2, 0.5], [-1, 0.2, -0.3]])
    expected = [[716.94, 705.76], [1028.905704, 549.835512], [1211.275065, 1035.1934], [-2.29842, 849.553861]]
    K = np.array([[gamma1, 0, u0], [0, gamma2, v0], [0, 0, 1]])
    np.testing.assert_allclose(pixels("omni", [xi, k1, k2, 0.0, 0.0], K, rays), expected, atol=1e-6)


def test_models_that_are_the_same_lens_in_other_words_agree():
    """The unified model is eucm with beta 1, double_sphere with xi 0, and omni in other units."""
    angle = np.linspace(0, 1.9, 40)  # also rays from behind
    rays = np.stack([np.sin(angle) * 0.6, np.sin(angle) * 0.8, np.cos(angle)], 1)
    unified = project("eucm", [0.55, 1.0], rays)
    assert np.isfinite(unified).all()
    np.testing.assert_allclose(project("double_sphere", [0.0, 0.55], rays), unified, atol=1e-12)
    np.testing.assert_allclose(project("omni", [0.55 / 0.45, 0.0, 0.0, 0.0, 0.0], rays) / 0.45, unified, atol=1e-12)
    assert np.isnan(project("eucm", [0.0, 1.0], rays[-1:])).all()  # no pinhole sees a ray from behind


def lens(model, numbers, focal, size, fov=None):
    height, width = size
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Lens(CameraFile(Path("camera.yaml"), K, size, tuple(numbers), model, fov=fov), height, width)


def test_the_radius_of_a_fold_is_that_of_the_formula_and_the_lens_is_refused():
    # r (1 - 0.35 r^2) is greatest at r = 1 / sqrt(1.05), where it is two thirds of that
    K = np.array([[560.0, 0, 639.5], [0, 560, 359.5], [0, 0, 1]])
    angle, radius = fold("pinhole", [-0.35, 0.0, 0.0, 0.0], K, 720, 1280)
    assert radius == pytest.approx(560 * 2 / 3 / np.sqrt(1.05), abs=0.01)
    assert angle == pytest.approx(np.arctan(1 / np.sqrt(1.05)), abs=1e-3)
    assert fold("pinhole", [-0.35, 0.0, 0.0, 0.0], K + np.diag([700, 700, 0]), 720, 1280) == (np.inf, np.inf)
    with pytest.raises(DataError, match=r"folds back 364 pixels from the center.*set fov to at most (\d+) degrees"):
        lens("pinhole", [-0.35, 0.0, 0.0, 0.0], 560.0, (720, 1280))
    middle = lens("pinhole", [-0.35, 0.0, 0.0, 0.0], 560.0, (720, 1280), fov=60.0)
    assert middle.K[0, 0] == pytest.approx(640 / np.tan(np.radians(30)))
    with pytest.raises(DataError, match=r"fov is 100, but the undistorted picture of this lens is at most \d+ degrees"):
        lens("pinhole", [-0.35, 0.0, 0.0, 0.0], 560.0, (720, 1280), fov=100.0)


def test_a_fisheye_that_folds_within_the_straight_picture_is_refused():
    with pytest.raises(DataError, match=r"folds back \d+ pixels from the center"):  # OpenCV's issue 23961
        lens("fisheye", [-0.991, -0.1205, 0.3686, -1.0656], 1200.0, (1200, 1900))


@pytest.mark.parametrize("numbers", [(), (0.0,), (0.0, 0.0, 0.0, 0.0)])
def test_a_fisheye_with_few_or_no_coefficients_is_straightened(numbers):
    straight = lens("fisheye", numbers, 600.0, (960, 1280))
    np.testing.assert_allclose(straight.K[:2, 2], [639.5, 479.5])
    # without blank pixels: the middle of the upper edge comes from the recorded one, 479.5 / 600 radians off the axis
    assert straight.K[0, 0] == pytest.approx(479.5 / np.tan(479.5 / 600), rel=0.01)
    x, y = 0.4, -0.3  # a dot in this direction
    theta = np.arctan(0.5)
    u, v = 639.5 + 600 * theta * 0.8, 479.5 - 600 * theta * 0.6
    rows, columns = np.mgrid[:960, :1280]
    dot = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 18)
    seen = straight(np.repeat(np.round(255 * dot)[..., None], 3, 2).astype(np.uint8))[..., 0].astype(float)
    peak = [(seen * columns).sum() / seen.sum(), (seen * rows).sum() / seen.sum()]
    np.testing.assert_allclose(peak, (straight.K @ [x, y, 1])[:2], atol=0.2)


def test_lenses_from_180_degrees_on_give_a_centered_picture_of_120_degrees_or_as_wished():
    circle = 500 / np.radians(100)  # 200 degrees in a circle of 1000 pixels
    straight = lens("fisheye", [], circle, (1000, 1000))
    np.testing.assert_allclose(
        straight.K, [[500 / np.tan(np.radians(60)), 0, 499.5], [0, 288.675, 499.5], [0, 0, 1]], 1e-5
    )
    assert lens("fisheye", [], circle, (1000, 1000), fov=90.0).K[0, 0] == pytest.approx(500)
    xi, k1, k2, gamma, *_ = KITTI360.values()
    assert lens("omni", [xi, k1, k2, 4e-4, 4e-4], gamma, (1400, 1400)).K[0, 0] == pytest.approx(700 / np.sqrt(3))


def test_fov_is_checked(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("image_size: [640, 480]\nK: [300, 300, 319.5, 239.5]\nmodel: fisheye\nfov: 150\n")
    with pytest.raises(DataError, match=r"fov is 150 degrees.*at most 120"):
        read_camera(path)


def test_skew_is_straightened_too():
    K = np.array([[900.0, 20, 639.5], [0, 900, 359.5], [0, 0, 1]])
    straight = straight_intrinsics("pinhole", [-0.2, 0.05, 0.0, 0.0], K, 720, 1280, None, "camera.yaml")
    whole, fraction = straightening_maps("pinhole", [-0.2, 0.05, 0.0, 0.0], K, straight, 720, 1280)
    for u, v in ((100, 50), (1200, 700)):
        ray = np.linalg.solve(straight, [u, v, 1])
        r = ray[0] ** 2 + ray[1] ** 2
        expected = (K @ [*(ray[:2] * (1 - 0.2 * r + 0.05 * r**2)), 1])[:2]
        got = whole[v, u] + np.array([fraction[v, u] & 31, fraction[v, u] >> 5]) / 32
        np.testing.assert_allclose(got, expected, atol=0.05)


def test_a_strongly_bent_lens_is_not_cut_to_its_middle():
    """OpenCV's own choice for this lens, that of its ChArUco tutorial, has 36 degrees of the 59 that fit."""
    K = np.array([[452.51072, 0, 317.70297], [0, 456.76708, 277.75156], [0, 0, 1]])
    numbers = [0.121369256, -1.0854664, 1.178684e-4, -4.62406860e-4, 2.95425894]
    straight = straight_intrinsics("pinhole", numbers, K, 480, 640, None, "camera.yaml")
    corners = np.array([[(u - straight[0, 2]) / straight[0, 0], (v - straight[1, 2]) / straight[1, 1], 1]
                        for u in (0, 639) for v in (0, 479)])  # fmt: skip
    recorded = pixels("pinhole", numbers, K, corners)
    assert (recorded > -1).all()
    assert (recorded < [640, 480]).all()
    assert straight[0, 0] < 600


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("pinhole", ()),
        ("pinhole", (-0.1, 0.02, 0.001, -0.002)),
        ("pinhole", (0.3, 0.05, 0.001, -0.002, 0.01, 0.35, 0.08, 0.02)),
        ("fisheye", (0.05, -0.01, 0.004, -0.001)),
        ("omni", (2.2, 0.01, 0.02, 0.001, 0.0005)),
        ("division", (-0.2,)),
        ("fov", (0.9,)),
        ("double_sphere", (-0.2, 0.6)),
    ],
)
def test_the_rays_of_pixels_are_those_that_the_lens_shows_there(model: str, coefficients: tuple[float, ...]) -> None:
    K = np.array([[500, 2.0, 321], [0, 510, 239], [0, 0, 1]])
    rays = np.stack([*np.meshgrid(np.linspace(-0.9, 0.9, 13), np.linspace(-0.7, 0.7, 9)), np.ones((9, 13))], -1)
    found = seen_rays(model, coefficients, K, pixels(model, coefficients, K, rays))
    np.testing.assert_allclose(found, rays, atol=2e-5)
    assert seen_rays(model, coefficients, K, np.empty((0, 12, 2))).shape == (0, 12, 3)


def test_pixels_beyond_a_fold_have_no_ray() -> None:
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    fold_at = np.sqrt(1 / 3 / 0.35)  # of r (1 - 0.35 r^2)
    radius = 500 * fold_at * (1 - 0.35 * fold_at**2)
    at = np.array([[320 + radius - 1, 240], [320 + radius + 1, 240], [320, 240]], np.float64)
    rays = seen_rays("pinhole", (-0.35, 0.0, 0.0, 0.0), K, at)
    assert rays[0, 0] == pytest.approx(fold_at, rel=0.1)
    assert np.isnan(rays[1]).all()
    np.testing.assert_allclose(rays[2], [0, 0, 1], atol=1e-9)
