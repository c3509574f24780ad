from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
import yaml
from board_views import SIZE, K, views
from processes import python

import saunet
from saunet.data.video.camera import CameraFile, read_camera, write_camera
from saunet.errors import ConfigError, DataError
from saunet.tools.calibrate import solve as solving
from saunet.tools.calibrate.solve import Board, BoardView, check_picture, solve


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
    points, pixels = [view.points for view in result.views], [view.pixels for view in result.views]
    theirs = cv2.calibrateCameraExtended(points, pixels, SIZE[::-1], None, None)  # its own standard deviations
    focal = np.ravel(theirs[5])[:2].max() / theirs[1][0, 0]
    assert result.uncertainty == pytest.approx(focal, rel=0.01)
    assert 0.1 < result.corner < 3.2
    assert np.abs(result.camera.distortion[0]) < 0.02
    picture = check_picture(result)
    assert picture.shape == (SIZE[0], 2 * SIZE[1], 3)
    root = np.sqrt(np.mean([(miss**2).sum(1).mean() for miss in result.misses]))
    assert root == pytest.approx(result.error, rel=0.01)
    photos = solve(tmp_path / "pictures" / "0*.png", Board())
    np.testing.assert_allclose(photos.camera.K, result.camera.K, rtol=1e-9)
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
    for picture in views(board, 14, distortion, spread=2.0):
        writer.write(picture)
    writer.release()
    result = solve(tmp_path / "board.avi", board)
    np.testing.assert_allclose(result.camera.K[[0, 1], [0, 1]], K[[0, 1], [0, 1]], rtol=0.01)
    assert result.camera.distortion[0] == pytest.approx(-0.25, abs=0.05)
    assert result.camera.fps is None  # that of this video; other recordings of the camera have their own


def test_an_aprilgrid_is_printed_as_kalibr_does_and_recovered(tmp_path):
    board = Board("aprilgrid", columns=6, rows=5, square=0.03)
    drawn = board.picture(40)
    step, first = 52, (20 + 12, 20 + 12 + 4 * 52)  # x, y of tag 0, at the bottom left
    for number, code in ((0, 0xD5D628584), (1, 0xD97F18B49), (6, 0x056A5D085)):  # Kalibr's t36h11
        x, y = first[0] + number % 6 * step, first[1] - number // 6 * step
        modules = drawn[y + 2 : y + 40 : 4, x + 2 : x + 40 : 4] > 127
        bits = [code >> (35 - bit) & 1 for bit in range(36)]  # from the top left; white is 1
        np.testing.assert_array_equal(modules, np.pad(np.array(bits, bool).reshape(6, 6), 2))
        np.testing.assert_array_equal(drawn[[y - 2, y - 2, y + 41, y + 41], [x - 2, x + 41, x - 2, x + 41]], 0)
    result = solve(save(tmp_path / "pictures", views(board, 14, [-0.2, 0.05, 0, 0, 0], spread=2.0)), board)
    assert len(result.views) >= 12
    assert result.error < 0.2
    np.testing.assert_allclose(result.camera.K[[0, 1], [0, 1]], K[[0, 1], [0, 1]], rtol=0.005)
    np.testing.assert_allclose(result.camera.K[:2, 2], K[:2, 2], atol=2)
    assert result.camera.distortion[0] == pytest.approx(-0.2, abs=0.03)


def test_the_cameras_of_a_rig_are_placed(tmp_path):
    """The second camera is 12 cm to the right, a little turned; the third is not there for enough pictures."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array([0.01, 0.05, -0.02]))[0], (-0.12, 0.004, 0.01)
    board = Board("aprilgrid", columns=6, rows=6, square=0.03)
    save(tmp_path / "left", views(board, 14, spread=2.0))
    save(tmp_path / "right", views(board, 14, spread=2.0, T_this_first=T))
    about = {"board": "aprilgrid", "columns": 6, "rows": 6, "square": 0.03, "output": str(tmp_path / "camera.yaml")}
    right = str(tmp_path / "right")
    said = str(saunet.calibrate(saunet.CalibrateOptions(input=str(tmp_path / "left"), rig=[right], **about)))
    print(said)
    assert "camera 1" in said
    assert "seen from camera 0: 0.12" in said
    chain = yaml.safe_load((tmp_path / "camera_rig.yaml").read_text())
    found = np.array(chain["cam1"]["T_cn_cnm1"])
    np.testing.assert_allclose(found[:3, 3], T[:3, 3], atol=1e-3)
    np.testing.assert_allclose(found[:3, :3], T[:3, :3], atol=2e-3)
    for number, file in enumerate(("camera.yaml", "camera_1.yaml")):
        named = read_camera(f"{tmp_path / 'camera_rig.yaml'}:cam{number}")
        np.testing.assert_allclose(named.K, read_camera(tmp_path / file).K, rtol=1e-6)
    for name in os.listdir(right)[:3]:
        os.unlink(os.path.join(right, name))
    with pytest.raises(DataError, match=r"has 14 pictures but .*right has 11; the cameras of a rig need equally many"):
        saunet.calibrate(saunet.CalibrateOptions(input=str(tmp_path / "left"), rig=[right], overwrite=True, **about))
    with pytest.raises(ConfigError, match=r"camera_1.yaml exists|camera_rig.yaml exists|camera.yaml exists"):
        saunet.CalibrateOptions(input="left", rig=[right], **about)


def test_a_fisheye_is_calibrated_on_the_command_line(tmp_path):
    distortion = [-0.25, 0.05, 0.0, 0.0]
    pictures = views(Board(), 18, distortion, tilt=0.45, undistort=cv2.fisheye.undistortPoints, spread=2.2)
    save(tmp_path / "pictures", pictures)

    def calibrated(*overrides):
        return python("-m", "saunet", "calibrate", "input=pictures", *overrides, cwd=tmp_path)

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
    with pytest.raises(DataError, match=r"alike cannot be trusted: a focal length of .* too similar: tilt the board"):
        solve(alike, Board())
    bent = save(tmp_path / "bent", [_bent(picture) for picture in pictures])
    with pytest.raises(DataError, match=r"the reprojection error is .* pixels and at most 0.5 is accepted"):
        solve(bent, Board(), max_error=0.5)
    mixed = save(tmp_path / "mixed", [pictures[0], pictures[1][:400]])
    with pytest.raises(DataError, match=r"mixes pictures of 640x480 and 640x400"):
        solve(mixed, Board())
    (tmp_path / "none").mkdir()
    with pytest.raises(DataError, match=r"no images in .*\*\.jpg; give a folder or a pattern"):
        solve(tmp_path / "few" / "*.jpg", Board())
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
            "has 50 markers but the board needs 70; .* DICT_4X4_100",
        ),
        ({"kind": "charuco", "columns": 20, "rows": 20}, "has 100 markers but the board needs 200; .* DICT_4X4_250"),
        ({"kind": "charuco", "columns": 30, "rows": 20}, "has 100 markers but the board needs 300; .* DICT_4X4_1000"),
        ({"kind": "charuco", "columns": 50, "rows": 50}, "has 100 markers but the board needs 1250; use fewer squares"),
        ({"kind": "charuco", "marker": 1.5}, "marker is 1.5"),
        ({"kind": "aprilgrid", "columns": 30, "rows": 20}, "has 30x20 tags; allowed are at least 2x2, and at most 587"),
        ({"kind": "aprilgrid", "spacing": 0.0}, "spacing is 0"),
        ({"square": 0.0}, "square is 0.0"),
    ],
)
def test_boards_that_cannot_be(options, message):
    with pytest.raises(ConfigError, match=message):
        Board(**options)


def seen(model, K, distortion, size, reach, noise=0.1, count=20):
    """Return a board as a lens sees it, with its center within a fraction of the half picture."""
    rng = np.random.default_rng(0)
    points = (np.mgrid[:9, :6, :1].T.reshape(-1, 3) * 0.025).astype(np.float32)
    project, views = (cv2.fisheye if model == "fisheye" else cv2).projectPoints, []
    while len(views) < count:
        R = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
        depth = rng.uniform(0.2, 0.4)
        place = [*(rng.uniform(-reach, reach, 2) * depth * size[::-1] / 2 / K[[0, 1], [0, 1]]), depth]
        at = project(
            points.reshape(-1, 1, 3).astype(float), cv2.Rodrigues(R)[0], place - R @ points.mean(0), K, distortion
        )
        pixels = np.reshape(at[0], (-1, 2)) + rng.normal(0, noise, (len(points), 2))
        if (pixels >= 0).all() and (pixels <= np.array(size[::-1]) - 1).all():
            views.append(BoardView(points, pixels.astype(np.float32)))
    return views


WIDE = np.array([[450.0, 0, 479.5], [0, 450, 269.5], [0, 0, 1]])
ROUND = np.array([[280.0, 0, 479.5], [0, 280, 269.5], [0, 0, 1]])  # 196 degrees from left to right


@pytest.mark.parametrize(
    ("model", "K", "distortion", "all_over"),
    [("pinhole", WIDE, [-0.25, 0.07, 0.0, 0.0, -0.006], 1.2), ("fisheye", ROUND, [0.03, -0.01, 0.003, -0.001], 0.75)],
)
def test_a_board_in_the_middle_only_is_refused_and_one_all_over_is_not(
    monkeypatch, tmp_path, model, K, distortion, all_over
):
    size = (540, 960)

    def solved(reach):
        pictures = seen(model, K, np.array(distortion), size, reach)
        monkeypatch.setattr(Board, "find", lambda self, image: pictures.pop())
        monkeypatch.setattr(
            solving, "_pictures", lambda source, most: ((np.zeros((*size, 3), np.uint8), 20) for _ in range(20))
        )
        return solve(tmp_path, Board(), model)

    good = solved(all_over)
    np.testing.assert_allclose(good.camera.K[[0, 1], [0, 1]], K[[0, 1], [0, 1]], rtol=0.005)
    assert good.corner < 3
    with pytest.raises(DataError, match=r"cannot be trusted: the .*corners.* film it along the edges and in all four"):
        solved(0.2)


def test_a_charuco_board_of_old_opencv_is_found_and_said(tmp_path, monkeypatch):
    old = Board("charuco", columns=8, rows=6)
    old._charuco.setLegacyPattern(True)
    save(tmp_path / "pictures", views(old, 14, spread=2.0))
    monkeypatch.chdir(tmp_path)
    options = saunet.CalibrateOptions(input="pictures", board="charuco", columns=8, rows=6, export="kalibr", fov=45.0)
    result = saunet.calibrate(options)
    assert "OpenCV before 4.6 (legacy pattern)" in str(result)
    assert "corners to" in str(result)
    assert "and camera_kalibr.yaml" in str(result)
    camera = read_camera("camera.yaml")
    theirs = read_camera("camera_kalibr.yaml")
    np.testing.assert_allclose(camera.K, K, rtol=0.01)
    assert camera.fov == 45
    assert len(camera.distortion) == 4  # Kalibr has no k3
    np.testing.assert_allclose(theirs.distortion, camera.distortion, rtol=1e-6)


def test_another_tools_file_is_converted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    K = np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]])
    write_camera("folding.yaml", CameraFile(tmp_path, K, (480, 752), (-0.45, 0.0, 0.0, 0.0)))
    options = {"input": "folding.yaml", "camera_height": 1.4, "export": "colmap"}
    with pytest.raises(DataError, match=r"folding.yaml: this lens model folds back 262 pixels.* set fov to at most"):
        saunet.calibrate(saunet.CalibrateOptions(**options))
    assert not (tmp_path / "camera.yaml").exists()
    result = saunet.calibrate(saunet.CalibrateOptions(**options, fov=50.0))
    assert "from folding.yaml: pinhole, fx 458.65" in str(result)
    camera = read_camera("camera.yaml")
    assert (camera.camera_height, camera.fov, camera.distortion) == (1.4, 50, (-0.45, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(read_camera("camera_colmap.txt:1").K, K)
    with pytest.raises(ConfigError, match=r"camera_colmap.txt exists"):
        saunet.CalibrateOptions(**options | {"output": "camera.yml"})
