"""The focal length from a drive: exact on made points, within 3 % on rendered turns, refused where nothing says it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rendered import Winding
from videos import write_video

import saunet
from saunet.data.drive import LensModel
from saunet.data.video.camera import read_camera
from saunet.data.video.focal import WINDOW, FocalEstimate, WindowFocal, combined, solve_window, with_lens
from saunet.data.video.focal_check import settled
from saunet.errors import ConfigError, DataError
from saunet.io.images import write_image
from saunet.synthetic.world import turn
from saunet.tools.calibrate.tool import CalibrateOptions, calibrate
from saunet.tools.doctor.findings import diagnose
from saunet.tools.doctor.survey import survey

SIZE = (188, 620)  # height, width


def made(
    focal: float, degrees: float, seed: int = 0, k1: float = 0.0, right: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Points seen from a car that turns by so many degrees a frame; 0.2 px of noise, and a tenth of them move."""
    rng = np.random.default_rng(seed)
    height, width = SIZE
    ends = np.stack([rng.uniform(0, width, 300), rng.uniform(0, height, 300)], axis=1)
    depth = 1 / rng.uniform(1 / 50, 1 / 5, 300)
    f = focal * width
    center = np.array([(width - 1) / 2 + right * width, (height - 1) / 2])
    points = np.concatenate([(ends - center) / f, np.ones((300, 1))], axis=1) * depth[:, None]
    pixels, T = [], np.eye(4)
    back = np.eye(4)
    back[:3, :3], back[2, 3] = turn(np.radians(degrees)), 0.8  # the camera a frame earlier is behind
    for _ in range(WINDOW):
        seen = points @ T[:3, :3].T + T[:3, 3]
        flat = seen[:, :2] / seen[:, 2:]
        pixels.append(f * flat * (1 + k1 * (flat**2).sum(1, keepdims=True)) + center)
        T = back @ T
    found = np.stack(pixels, axis=1) + rng.normal(0, 0.2, (300, WINDOW, 2))
    found[:30] += np.arange(WINDOW)[None, :, None] * rng.normal(0, 1.5, (30, 1, 2))  # other cars
    known = np.logical_and.accumulate((found > 0).all(2) & (found < np.array(SIZE[::-1])).all(2), axis=1)
    return found, known


@pytest.mark.parametrize("focal", [0.4, 0.58, 1.2])
def test_turns_tell_the_focal_length_and_straights_say_that_they_do_not(focal: float) -> None:
    curve = solve_window(*made(focal, 2.0), SIZE)
    assert curve is not None
    assert curve.focal == pytest.approx(focal, rel=max(4 * curve.uncertainty, 0.005))
    assert curve.uncertainty < 0.012
    assert 0.1 < curve.error < 0.4
    straight = solve_window(*made(focal, 0.0), SIZE)
    assert straight is None or straight.uncertainty > 0.03


def drive_with(k1: float, right: float = 0.0) -> tuple[WindowFocal, FocalEstimate]:
    turns = (2, 2.5, -2) if right else (2, 2.5, -2, 3)  # as few as will do: a free center takes most of the time
    solvers = [partial(solve_window, *made(0.58, turn, seed, k1, right), SIZE) for seed, turn in enumerate(turns)]
    straight = [found for solver in solvers if (found := solver())]
    estimate = with_lens(solvers, straight, free_center=right != 0)
    assert estimate is not None
    return straight[0], estimate


@pytest.mark.parametrize(("k1", "longer"), [(-0.05, 1.04), (-0.1, 1.15)])
def test_the_bend_of_a_lens_is_found_with_the_focal_length(k1: float, longer: float) -> None:
    """Where it is not looked for, the focal length is too long, and hardly a residual says so."""
    straight, found = drive_with(k1)
    assert straight.focal > longer * 0.58
    assert straight.error < 0.4
    assert found.focal == pytest.approx(0.58, rel=0.04)
    assert found.distortion == pytest.approx(k1, abs=0.02)
    assert re.match(r"distortion -0\.\d{3} in the division model; center in the middle", found.assumed)
    assert found.uncertainty < 0.03


def test_a_center_aside_is_found_and_not_taken_for_a_bend() -> None:
    straight, found = drive_with(0.0, right=0.04)
    assert abs(straight.focal / 0.58 - 1) > 0.015
    assert found.focal == pytest.approx(0.58, rel=0.01)
    assert found.right == pytest.approx(0.04, abs=0.003)
    assert (found.bend, found.down) == (0, 0)
    K = found.intrinsics(*SIZE, SIZE[1])
    assert K[0, 2] == pytest.approx((0.5 + 0.04) * SIZE[1] - 0.5, abs=2)
    assert "of the width to the right" in found.assumed


def lens(*curvatures: float) -> FocalEstimate:
    """Windows of a lens whose bend is -0.16, each with the curvature of its squared residuals in the bend."""

    def solver(curvature: float, bend: float = 0.0, right: float = 0.0, down: float = 0.0) -> WindowFocal:
        squares = 0.09 * (1 + curvature * (bend + 0.16) ** 2 + 9 * (right**2 + down**2))
        return WindowFocal(0.8 * math.exp(1.3 * (bend + 0.16)), 0.002, math.sqrt(squares))

    solvers = [partial(solver, curvature) for curvature in curvatures]
    estimate = with_lens(solvers, [solver() for solver in solvers])
    assert estimate is not None
    return estimate


def test_a_window_that_says_nothing_of_the_bend_does_not_silence_the_others() -> None:
    found = lens(5, 6, 4, -0.5, 5, 0.2)
    assert found.bend == pytest.approx(-0.16, abs=0.01)
    assert found.focal == pytest.approx(0.8, rel=0.01)
    assert found.is_known


@pytest.mark.parametrize("curvatures", [(-0.5, -0.2, -0.4, -0.1), (0.4, -0.4, 0.1, -0.05)])
def test_a_focal_length_is_not_known_where_the_bend_is_not(curvatures: tuple[float, ...]) -> None:
    """It is 23 % too long without the bend, however sure the windows are."""
    assert not lens(*curvatures).is_known


def test_what_time_did_not_allow_to_look_for_is_said() -> None:
    assert "was not checked" in replace(lens(5, 5, 5), bend=None).assumed


def test_a_straight_lens_stays_straight() -> None:
    _, found = drive_with(0.0)
    assert found.bend == 0
    assert found.focal == pytest.approx(0.58, rel=0.01)
    assert "no distortion found" in found.assumed


@pytest.mark.parametrize(
    ("factor", "named", "degrees"),
    [(1.0, False, 2), (1.2, True, 2), (0.8, True, 2), (1.0, False, 0), (1.2, False, 0)],
)
def test_a_focal_length_is_checked_through_the_lens_that_is_given(factor: float, named: bool, degrees: float) -> None:
    """A wrong one straightens wrongly, and what bend it leaves must not hide it; a straight road tells nothing."""
    turns = (degrees, 1.25 * degrees, -degrees)
    tracked = [(*made(0.58, turn, seed, k1=-0.1), SIZE) for seed, turn in enumerate(turns)]
    f, (height, width) = 0.58 * factor * 1240, SIZE
    K = np.array([[f, 0, width - 0.5], [0, f, height - 0.5], [0, 0, 1]])  # of pictures twice as large
    found = settled(tracked, LensModel("pinhole", (-0.1, 0.0, 0.0, 0.0), K), 1240)
    assert (found is not None and found.contradicts(0.58 * factor)) == named
    assert (found is not None and found.tells) == (degrees > 0)
    if degrees and found is not None:
        assert found.focal == pytest.approx(0.58, rel=0.03)


def test_pixels_that_are_not_square_are_checked_as_such() -> None:
    tracked = []
    for seed, degrees in enumerate((2, 2.5, -2)):
        found, known = made(0.58, degrees, seed)
        tracked.append((found * (1, 0.8) - (0, 0.1), known, SIZE))
    f, width = 0.58 * SIZE[1], SIZE[1]
    said = settled(tracked, LensModel("pinhole", (), np.array([[f, 0, 309.5], [0, 0.8 * f, 74.7], [0, 0, 1]])), width)
    assert said is not None
    assert said.focal == pytest.approx(0.58, rel=0.01)
    assert said.bend == 0


def test_windows_are_weighted_and_a_wrong_one_is_left_out() -> None:
    said = [WindowFocal(0.58, 0.01, 0.2), WindowFocal(0.585, 0.01, 0.2), WindowFocal(0.578, 0.02, 0.2)]
    both = combined([*said, WindowFocal(2.0, 3.0, 0.2), WindowFocal(0.9, 0.01, 0.2)])
    assert both is not None
    assert both.focal == pytest.approx(0.582, abs=0.002)
    assert both.is_known
    assert both.contradicts(0.582 * 1.2)
    assert both.contradicts(0.582 / 1.2)
    assert not both.contradicts(0.582 * 1.03)
    vague = combined([WindowFocal(0.58, 0.1, 0.2)] * 5)
    assert vague is not None
    assert not vague.contradicts(2.0)
    assert combined([]) is None


def test_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="set one of input and video"):
        CalibrateOptions(input="a.mp4", video="b.mp4")
    drive = write_video(tmp_path / "drive.mp4", 30)  # a picture that only shifts
    with pytest.raises(DataError, match=r"cannot be estimated from .*film a minute with turns"):
        calibrate(CalibrateOptions(video=str(drive), output=str(tmp_path / "camera.yaml")))
    assert not (tmp_path / "camera.yaml").exists()


def test_the_result_names_the_lens_model_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for index in range(WINDOW + 1):
        write_image(tmp_path / "a" / f"{index}.png", np.zeros((60, 160, 3), np.uint8))

    def estimate(windows: Iterable[object]) -> FocalEstimate:
        assert len(list(windows)) == 1
        return FocalEstimate(0.9, 0.005, 5, bend=-0.12)

    monkeypatch.setattr("saunet.tools.calibrate.tool.estimate_focal", estimate)
    said = str(calibrate(CalibrateOptions(video=str(tmp_path / "a"), output=str(tmp_path / "camera.yaml"))))
    assert "distortion -0.097 in the division model; center in the middle: fx 144.00, fy 144.00" in said
    assert said.count("division") == 1


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "focal", "frames"), [(3, 0.58, 60), (5, 0.9, 80)])
def test_rendered_turns(seed: int, focal: float, frames: int, tmp_path: Path) -> None:
    """Within 3 %; the doctor names a K that is 20 % off in either direction, and never the right one."""
    drive = Winding(seed=seed, frames=frames, height=180, width=480, focal=focal)
    for index in drive.indices:
        write_image(tmp_path / "clips" / "a" / f"{index:06d}.png", drive.image(index))
    output = tmp_path / "camera.yaml"
    said = calibrate(CalibrateOptions(video=str(tmp_path / "clips" / "a"), output=str(output)))
    found = read_camera(output).K[0, 0] / 480
    print(said, f"true {focal * 480:.1f}")
    assert "no distortion" in str(said)
    assert found == pytest.approx(focal, rel=0.03)
    (tmp_path / "clips" / "camera.yaml").write_text("camera: unknown\nfps: 10\n")
    data = saunet.build(
        "data", "video", root=str(tmp_path / "clips"), fps=None, workers=0, frames_cache=str(tmp_path / "cache")
    )
    data.setup("fit")
    assert data.datasets["train"].drives[0].intrinsics(0)[0, 0] / 480 == pytest.approx(focal, rel=0.03)
    for factor, named in ((1.0, False), (1.2, True), (1 / 1.2, True)):
        f = focal * 480 * factor
        text = f"image_size: [480, 180]\nK: [{f}, {f}, 239.5, {0.46 * 179}]\nfps: 10\n"
        (tmp_path / "clips" / "camera.yaml").write_text(text)
        data = saunet.build(
            "data", "video", root=str(tmp_path / "clips"), fps=None, workers=0, frames_cache=str(tmp_path / "cache")
        )
        findings = diagnose(survey(data, ("train",), 3000))
        assert any("K's focal length is" in each.text for each in findings) == named, findings


@pytest.mark.slow
def test_rendered_turns_through_a_bent_lens(tmp_path: Path) -> None:
    """The doctor names a K that is 20 % off in either direction, and not the right one."""
    (height, width), k1 = (180, 480), -0.1
    drive = Winding(seed=7, frames=70, height=232, width=592, focal=0.7 * width / 592)
    K, center = drive.intrinsics(0), np.array([(width - 1) / 2, (height - 1) / 2])
    seen = (np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1) - center) / K[0, 0]
    flat = seen
    for _ in range(50):  # from where the lens shows it to where it is
        flat = seen / (1 + k1 * (flat**2).sum(-1, keepdims=True))
    maps = (flat * K[0, 0] + K[:2, 2]).astype(np.float32)
    for index in drive.indices:
        bent = cv2.remap(drive.image(index), maps[..., 0], maps[..., 1], cv2.INTER_CUBIC)
        write_image(tmp_path / "clips" / "a" / f"{index:06d}.png", np.asarray(bent))
    for factor, named in ((1.0, False), (1.2, True), (0.8, True)):
        f = K[0, 0] * factor
        text = f"image_size: [480, 180]\nK: [{f}, {f}, 239.5, 89.5]\ndistortion: [{k1}, 0, 0, 0]\nfps: 10\n"
        (tmp_path / "clips" / "camera.yaml").write_text(text)
        data = saunet.build(
            "data", "video", root=str(tmp_path / "clips"), fps=None, workers=0, frames_cache=str(tmp_path / "cache")
        )
        found = survey(data, ("train",), 3000)
        said = [each.text for each in diagnose(found) if "focal length" in each.text or "K was not" in each.text]
        print(factor, said)
        wrong = "too long" if factor > 1 else "too short"
        assert any("K's focal length is" in each and f"% {wrong}:" in each for each in said) == named, said
        assert any("turns of 1 of 1 drives; K agrees with it there" in each for each in said) != named, said


@pytest.mark.data
@pytest.mark.parametrize("factor", [1.0, 1.2, 0.8])
def test_no_focal_length_is_named_on_real_straight_drives(factor: float, kitti_mini: Path, tmp_path: Path) -> None:
    """They do not tell a right one from a wrong one, and the doctor says that K was not checked."""
    images = kitti_mini / "raw/2011_09_26/2011_09_26_drive_9005_sync/image_02/data"
    f = 721.5377 * factor
    (tmp_path / "camera.yaml").write_text(f"image_size: [1242, 375]\nK: [{f}, {f}, 608.56, 171.854]\nfps: 10\n")
    data = saunet.build(
        "data",
        "video",
        root=str(images),
        camera=str(tmp_path / "camera.yaml"),
        fps=None,
        workers=0,
        frames_cache=str(tmp_path),
    )
    said = [each.text for each in diagnose(survey(data, ("train",)))]
    assert not any("contradicts" in each for each in said)
    assert any("K was not checked, because the focal length cannot be estimated" in each for each in said)


@pytest.mark.data
def test_real_straight_drives_are_refused(kitti_mini: Path, tmp_path: Path) -> None:
    """KITTI's mini drives have no turns: nothing is claimed about their focal length."""
    for folder in ("raw/2011_09_26/2011_09_26_drive_9005_sync/image_02/data", "odometry/sequences/06/image_0"):
        with pytest.raises(DataError, match=r"only to within"):
            calibrate(CalibrateOptions(video=str(kitti_mini / folder), output=str(tmp_path / "camera.yaml")))
