"""The quick look at clips decides as the exact measurement does, and keeps what it measured."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from clip_tree import texture

from saunet.data.video.clips import frame_paths
from saunet.data.video.motion import QUICK, cuts, measure
from saunet.errors import DataError
from saunet.io.images import quick_look, read_image, read_jpeg


def write(folder, pictures, suffix=".jpg", quality=90):
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{number:04d}{suffix}"), picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return frame_paths(folder)


def view(world, x, size=(192, 640)):
    """Return what a camera sees that has moved by a part of a pixel."""
    return cv2.warpAffine(world, np.array([[1, 0, -x], [0, 1, -8]], np.float32), size[::-1], flags=cv2.INTER_CUBIC)


def decisions(motion):
    return motion.doubled().tolist(), motion.static().tolist(), cuts(motion.change).tolist(), motion.unreadable


def worlds():
    rng = np.random.default_rng(3)
    for scale in (3, 20, 60):
        yield cv2.resize(rng.integers(0, 255, (300 // scale, 1600 // scale, 3), dtype=np.uint8), (1600, 300))


def drive(noise, gain, seed):
    """Yield a drive with a start, slow and fast parts, stops, doubled pictures and cuts, in noise and in the dark."""
    rng, x = np.random.default_rng(seed), 30.0
    scenes = list(worlds())
    steps = [
        0.2,
        0.6,
        1.0,
        1.4,
        2.0,
        3,
        6,
        9,
        9,
        9,
        9,
        9,
        0,
        0,
        0,
        4,
        "doubled",
        5,
        6,
        "cut",
        5,
        6,
        7,
        5,
        0.9,
        1.1,
        0.7,
    ]
    scene, last = 0, None
    for number, step in enumerate(steps):
        scene += step == "cut"
        x += step if isinstance(step, int | float) else 0
        if step != "doubled":
            last = view(scenes[scene], x).astype(np.float64)
            other = view(scenes[scene], x + 9 * number)
            last[60:130, 100:350] = other[60:130, 100:350]  # a part moves by itself
            last = (last * gain + rng.normal(0, noise, last.shape)).clip(0, 255).astype(np.uint8)
        yield last


@pytest.mark.parametrize(("noise", "gain"), list(itertools.product((0, 4), (1.0, 0.15))))
def test_the_quick_look_decides_as_the_exact_measurement(tmp_path, noise, gain):
    for seed in range(3):
        paths = write(tmp_path / str(seed), drive(noise, gain, seed), quality=(60, 90, 97)[seed])
        exact = measure(paths, (0, 0, 0, 0))
        quick = measure(paths, (0, 0, 0, 0), exact=False)
        assert decisions(quick) == decisions(exact)
        assert exact.static().sum() >= 4
        assert exact.doubled().sum() >= 1
        assert (quick.flow[1:] != exact.flow[1:]).any()


def test_real_frames_are_chosen_alike(tmp_path, kitti_mini):
    for folder in sorted(kitti_mini.rglob("image_02/data")):
        pictures = [cv2.imread(str(path)) for path in sorted(folder.glob("*.png"))]
        pictures[5:5] = pictures[5:6] * 3
        pictures += pictures[::6]  # and cuts
        paths = write(tmp_path / folder.parent.parent.name, pictures)
        for crop in ((0, 0, 0, 0), (0.1, 0.2, 0.05, 0)):
            quick, exact = (measure(paths, crop, exact=kind) for kind in (False, True))
            assert decisions(quick) == decisions(exact)
            assert exact.doubled().sum() == 3
        assert (quick.flow != exact.flow).sum() > len(paths) / 2  # it was quick


def test_frames_that_cannot_be_read_are_the_same(tmp_path):
    paths = write(tmp_path / "c", drive(2, 1.0, 0))
    whole = paths[9].read_bytes()
    paths[9].write_bytes(whole[: len(whole) // 2])
    paths[10].write_bytes(b"")
    paths[0].write_bytes(b"\xff\xd8 no picture \xff\xd9")
    quick, exact = (measure(paths, (0, 0, 0, 0), exact=kind, skip_unreadable=True) for kind in (False, True))
    assert decisions(quick) == decisions(exact)
    assert quick.unreadable == (0, 9, 10)
    assert np.isnan(quick.flow[[0, 1, 9, 10]]).all()
    assert np.isfinite(quick.flow[[2, 11]]).all()
    for kind in (False, True):
        with pytest.raises(DataError, match=r"0000\.jpg"):
            measure(paths, (0, 0, 0, 0), exact=kind)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_blocks_and_threads_change_nothing(tmp_path, monkeypatch, suffix):
    paths = write(tmp_path / "c", drive(1, 1.0, 1), suffix)
    paths[8].write_bytes(b"")  # the last of a block
    whole = measure(paths, (0, 0, 0, 0), exact=False, skip_unreadable=True)
    monkeypatch.setattr("saunet.data.video.motion._BLOCK", 3)
    monkeypatch.setattr("saunet.data.video.motion.available_cores", lambda: 3)
    parts = measure(paths, (0, 0, 0, 0), exact=False, skip_unreadable=True)
    np.testing.assert_array_equal(parts.flow, whole.flow)
    np.testing.assert_array_equal(parts.change, whole.change)


def test_kept_measurements_are_those_that_were_made(tmp_path):
    paths = write(tmp_path / "c", drive(2, 1.0, 2))
    quick = measure(paths, (0, 0, 0, 0), exact=False, cache=tmp_path / "kept")
    exact = measure(paths, (0, 0, 0, 0), cache=tmp_path / "kept")  # distances need it
    for motion in (quick, exact):
        assert np.isnan(motion.flow[0])
    again = measure(paths, (0, 0, 0, 0), exact=False, cache=tmp_path / "kept")
    np.testing.assert_array_equal(again.flow, exact.flow)  # the better one serves both
    assert len(list((tmp_path / "kept").iterdir())) == 2
    for file in (tmp_path / "kept").iterdir():
        file.write_bytes(file.read_bytes()[:100])
    anew = measure(paths, (0, 0, 0, 0), exact=False, cache=tmp_path / "kept")
    np.testing.assert_array_equal(anew.flow, quick.flow)


def test_frames_of_another_size_are_no_neighbors(tmp_path):
    pictures = [view(texture(), 4 * number) for number in range(6)]
    pictures[3] = pictures[3][:180]
    quick, exact = (measure(write(tmp_path / "c", pictures), (0, 0, 0, 0), exact=kind) for kind in (False, True))
    np.testing.assert_array_equal(np.isnan(quick.flow), np.isnan(exact.flow))
    assert np.flatnonzero(np.isnan(quick.flow)).tolist() == [0, 3, 4]


def test_a_quick_look_is_the_picture_made_smaller(tmp_path):
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), view(texture(), 7))
    jpeg, size = read_jpeg(path)
    assert jpeg == path.read_bytes()
    assert size == b"\x00\xc0\x02\x80"
    full = cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY)
    for width in (320, 160):
        small = quick_look(jpeg, 640, width)
        assert small.shape == (width * 3 // 10, width)
        expected = cv2.resize(full, small.shape[::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(int) - expected).mean() < 1.5
    assert quick_look(jpeg, 640, 321) is None  # narrower than twice that
    cv2.imwrite(str(tmp_path / "a.png"), view(texture(), 7))
    for other in ("a.png", "none.jpg"):
        assert read_jpeg(tmp_path / other) == (b"", b"")
    assert min(flow for _, _, flow in QUICK.values()) >= 1.0
