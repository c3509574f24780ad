from __future__ import annotations

import numpy as np
import pytest
from kitti_tree import CALIBRATION, SCANNER

from saunet.data.kitti.files import read_calibration
from saunet.errors import DataError


def write(folder, cameras=CALIBRATION, scanner=SCANNER):
    (folder / "calib_cam_to_cam.txt").write_text(cameras)
    if scanner is not None:
        (folder / "calib_velo_to_cam.txt").write_text(scanner)
    return folder


def test_each_camera_has_its_own_intrinsics(tmp_path):
    calibration = read_calibration(write(tmp_path))
    assert calibration.intrinsics(2).tolist() == [[50, 0, 29], [0, 50, 9], [0, 0, 1]]  # from zero
    assert calibration.intrinsics(3)[0].tolist() == [55, 0, 30]
    assert calibration.projections[2].tolist() == [[50, 0, 30, 3], [0, 50, 10, 0], [0, 0, 1, 0]]
    assert calibration.sizes[2] == (20, 60)
    assert calibration.T_cam_velo[:3, :3].tolist() == [[0, -1, 0], [0, 0, -1], [1, 0, 0]]


def test_real_intrinsics(kitti_mini):
    calibration = read_calibration(kitti_mini / "raw" / "2011_09_26")
    assert calibration.intrinsics(2) == pytest.approx(
        np.array([[721.5377, 0, 608.5593], [0, 721.5377, 171.854], [0, 0, 1]])
    )
    assert calibration.sizes == dict.fromkeys(range(4), (375, 1242))
    assert calibration.T_cam_velo[:3, 3] == pytest.approx([-4.069766e-03, -7.631618e-02, -2.717806e-01])


def test_no_scanner_calibration_is_no_error(tmp_path):
    assert read_calibration(write(tmp_path, scanner=None)).T_cam_velo is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("50 0 30 3 0 50", "50 0 30 3 0", r"calib_cam_to_cam.txt, line 7 \(P_rect_02\): expected 12 numbers, got 11"),
        ("50 0 30 3 0 50", "50 0 x 3 0 50", r"line 7 \(P_rect_02\): expected 12 finite numbers, got 'x' among them"),
        ("50 0 30 3 0 50", "50 0 nan 3 0 50", r"line 7 \(P_rect_02\): expected 12 finite numbers"),
        ("corner_dist:", "corner_dist", r"line 2: expected 'key: numbers', got 'corner_dist 9.95"),
        ("R_rect_00:", "R_rect_xx:", r"lacks R_rect_00"),
        ("P_rect", "Q_rect", r"lacks P_rect_00 to P_rect_03"),
    ],
)
def test_malformed_lines_are_named(tmp_path, old, new, message):
    with pytest.raises(DataError, match=message):
        read_calibration(write(tmp_path, CALIBRATION.replace(old, new)))


def test_a_scanner_without_its_position_is_named(tmp_path):
    with pytest.raises(DataError, match=r"calib_velo_to_cam.txt lacks T; expected a line 'T: ' with 3 numbers"):
        read_calibration(write(tmp_path, scanner="R: 0 -1 0 0 0 -1 1 0 0"))


def test_intrinsics_that_cannot_be_right_are_refused(tmp_path):
    calibration = read_calibration(write(tmp_path, CALIBRATION.replace("50 0 30 3", "50 0 61 3")))
    with pytest.raises(DataError, match=r"P_rect_02 has focal lengths 50, 50 and center 61, 10 for an image of 20x60"):
        calibration.intrinsics(2)
    with pytest.raises(DataError, match=r"has no P_rect_01; cameras in it: 00, 02, 03"):
        calibration.intrinsics(1)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ("0 0 0 0 0 0 0 0 0 0 0 0", r"P_rect_02 has K .*; expected \[\[fx, skew, cx\]"),
        ("-50 0 30 3 0 50 10 0 0 0 1 0", "the lengths must be positive"),
        ("1e-3 0 30 3 0 50 10 0 0 0 1 0", "a focal length is about 0.3 to 3 image widths"),
        ("100 0 60 3 0 100 20 0 0 0 1 0", "the center must lie inside"),  # of images twice as large
        ("25 0 15 3 0 25 5 0 0 0 1 0", "a center near a corner belongs to images of another size"),  # half as large
    ],
)
def test_a_k_that_cannot_belong_to_the_images_is_refused_before_it_is_solved(tmp_path, numbers, message):
    calibration = read_calibration(write(tmp_path, CALIBRATION.replace("50 0 30 3 0 50 10 0 0 0 1 0", numbers)))
    for use in (lambda: calibration.intrinsics(2), lambda: calibration.T_cam_cam(3, 2)):
        with pytest.raises(DataError, match=message) as caught:
            use()
        assert str(tmp_path / "calib_cam_to_cam.txt") in str(caught.value)


def test_an_image_without_size_is_named(tmp_path):
    text = CALIBRATION.replace("S_rect_02: 6.000000e+01 2.0", "S_rect_02: 0 0.0")
    with pytest.raises(DataError, match=r"S_rect_02 is 0 0; expected width and height"):
        read_calibration(write(tmp_path, text))


def test_a_missing_calibration_is_named(tmp_path):
    with pytest.raises(DataError, match=r"no calibration at .*calib_cam_to_cam.txt"):
        read_calibration(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("R: 0 -1 0 0 0 -1 1 0 0", "R: 0 0 0 0 0 0 0 0 0", r"calib_velo_to_cam\.txt, line 2 \(R\).*not a rotation"),
        ("R: 0 -1 0 0 0 -1 1 0 0", "R: 0 -3 0 0 0 -3 3 0 0", r"calib_velo_to_cam\.txt, line 2 \(R\).*not a rotation"),
        ("R: 0 -1 0 0 0 -1 1 0 0", "R: 0 1 0 0 0 -1 1 0 0", r"calib_velo_to_cam\.txt, line 2 \(R\).*reflection"),
        (
            "R_rect_00: 1 0 0 0 1 0 0 0 1",
            "R_rect_00: 2 0 0 0 2 0 0 0 2",
            r"calib_cam_to_cam\.txt, line 4.*not a rotation",
        ),
        ("T: 0 0 0", "T: 0 0 0\nT: 1 0 0", r"calib_velo_to_cam\.txt, line 4 \(T\): this key appears twice"),
    ],
)
def test_rotations_that_are_none_and_keys_given_twice_are_refused(tmp_path, old, new, message):
    write(tmp_path, CALIBRATION.replace(old, new), SCANNER.replace(old, new))
    with pytest.raises(DataError, match=message):
        read_calibration(tmp_path)
