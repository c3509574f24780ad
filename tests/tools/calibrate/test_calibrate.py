from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest
from board_views import SIZE, K, views

from saunet.data.video.camera import read_camera, write_camera
from saunet.errors import ConfigError, DataError
from saunet.tools.calibrate.solve import Board, check_picture, solve


def save(folder, pictures):
    folder.mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number:03d}.png"), picture)
    return folder


def test_the_camera_of_a_synthetic_chessboard_is_recovered(tmp_path):
    result = solve(save(tmp_path / "pictures", views(Board(), 14)), Board())
    np.testing.assert_allclose(result.camera.K[[0, 1], [0, 1]], K[[0, 1], [0, 1]], rtol=0.005)
    np.testing.assert_allclose(result.camera.K[:2, 2], K[:2, 2], rtol=0.005)
    assert result.camera.image_size == SIZE
    assert result.error < 0.2
    assert result.uncertainty < 0.005
    assert np.abs(result.camera.distortion[0]) < 0.02
    picture = check_picture(result)
    assert picture.shape == (SIZE[0], 2 * SIZE[1], 3)
    write_camera(tmp_path / "camera.yaml", result.camera, "a note")
    again = read_camera(tmp_path / "camera.yaml")
    np.testing.assert_allclose(again.K, result.camera.K, rtol=1e-6)
    np.testing.assert_allclose(again.distortion, result.camera.distortion, rtol=1e-6)
    assert again.image_size == SIZE
    assert again.reprojection_error == pytest.approx(result.error, abs=1e-4)


def test_charuco_in_a_video_and_distortion(tmp_path):
    board = Board("charuco", columns=8, rows=6)
    distortion = [-0.25, 0.08, 0.0, 0.0, 0.0]
    writer = cv2.VideoWriter(str(tmp_path / "board.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 5, SIZE[::-1])
    for picture in views(board, 12, distortion):
        writer.write(picture)
    writer.release()
    result = solve(tmp_path / "board.avi", board)
    np.testing.assert_allclose(result.camera.K[[0, 1], [0, 1]], K[[0, 1], [0, 1]], rtol=0.01)
    assert result.camera.distortion[0] == pytest.approx(-0.25, abs=0.05)
    assert result.camera.fps is None  # that of this video; other recordings of the camera have their own


def test_a_fisheye_is_calibrated_on_the_command_line(tmp_path):
    distortion = [-0.25, 0.05, 0.0, 0.0]
    pictures = views(Board(), 12, distortion, tilt=0.45, undistort=cv2.fisheye.undistortPoints)
    save(tmp_path / "pictures", pictures)

    def calibrated(*overrides):
        command = [sys.executable, "-m", "saunet", "calibrate", "input=pictures", *overrides]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False)

    done = calibrated("lens=fisheye")
    assert done.returncode == 0, done.stderr
    assert "reprojection error 0." in done.stdout
    assert "nan" not in done.stdout
    camera = read_camera(tmp_path / "camera.yaml")
    assert camera.model == "fisheye"
    np.testing.assert_allclose(camera.K[[0, 1], [0, 1]], K[[0, 1], [0, 1]], rtol=0.01)
    angle = np.array([0.2, 0.4, 0.5])  # radians off the axis; the coefficients alone are only known together
    powers = 1 + np.stack([angle**2, angle**4, angle**6, angle**8], 1) @ np.stack([camera.distortion, distortion], 1)
    np.testing.assert_allclose(powers[:, 0], powers[:, 1], atol=0.01)
    assert "lens is 'fishye'; did you mean 'fisheye'?" in calibrated("lens=fishye", "output=b.yaml").stderr


def test_what_cannot_be_trusted_is_refused(tmp_path):
    pictures = views(Board(), 12)
    few = save(tmp_path / "few", [*pictures[:3], np.full_like(pictures[0], 99)])
    with pytest.raises(DataError, match=r"found in 3 of 4 pictures.*at least 8.*columns and rows"):
        solve(few, Board())
    alike = save(tmp_path / "alike", views(Board(), 9, tilt=0.0))
    with pytest.raises(DataError, match=r"alike is not to be trusted: a focal length of .* too alike: tilt the board"):
        solve(alike, Board())
    bent = save(tmp_path / "bent", [_bent(picture) for picture in pictures])
    with pytest.raises(DataError, match=r"the reprojection error is .* pixels and at most 0.5 is accepted"):
        solve(bent, Board(), max_error=0.5)
    mixed = save(tmp_path / "mixed", [pictures[0], pictures[1][:400]])
    with pytest.raises(DataError, match=r"mixes pictures of 640x480 and 640x400"):
        solve(mixed, Board())
    (tmp_path / "none").mkdir()
    with pytest.raises(DataError, match=r"no images in .*none"):
        solve(tmp_path / "none", Board())


def _bent(picture):
    """A board that is no plane: waves that no lens makes."""
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]].astype(np.float32)
    return cv2.remap(picture, u + 3 * np.sin(v / 37), v + 3 * np.sin(u / 41), cv2.INTER_LINEAR)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "checkerboard"}, "board is 'checkerboard'; did you mean 'chessboard'"),
        ({"columns": 3}, "the board has 3x7 squares"),
        (
            {"kind": "charuco", "dictionary": "DICT_4X4_5"},
            "unknown dictionary 'DICT_4X4_5'; did you mean 'DICT_4X4_50'",
        ),
        (
            {"kind": "charuco", "dictionary": "DICT_4X4_50", "columns": 20},
            "has 50 markers and the board needs 70; .* DICT_4X4_100",
        ),
        ({"kind": "charuco", "columns": 20, "rows": 20}, "has 100 markers and the board needs 200; .* DICT_4X4_250"),
        ({"kind": "charuco", "columns": 30, "rows": 20}, "has 100 markers and the board needs 300; .* DICT_4X4_1000"),
        ({"kind": "charuco", "columns": 50, "rows": 50}, "has 100 markers and the board needs 1250; use fewer squares"),
        ({"kind": "charuco", "marker": 1.5}, "marker is 1.5"),
        ({"square": 0.0}, "square is 0.0"),
    ],
)
def test_boards_that_cannot_be(options, message):
    with pytest.raises(ConfigError, match=message):
        Board(**options)
