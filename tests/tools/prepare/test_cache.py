from __future__ import annotations

import hashlib
import itertools
import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from drives import NumberDrive
from prepare_tree import name

from saunet.data.loading.stored import CacheSettings, ImageCache
from saunet.errors import ConfigError, DataError
from saunet.io.atomic import partial_name
from saunet.io.images import read_image, resize
from saunet.tools.prepare.cache import build_cache
from saunet.tools.prepare.tool import kitti_recordings

SMALL = CacheSettings(height=10, width=32)


def content(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_copies_are_small_and_listed_and_originals_untouched(tree, tmp_path):
    before = {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in tree.rglob("*")}
    recordings = kitti_recordings(tree, ["left"])
    report = build_cache(recordings, tmp_path / "cache", SMALL)
    assert (report.made, report.verified, report.replaced) == (10, 0, 0)
    assert {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in tree.rglob("*")} == before
    home = tmp_path / "cache" / name(1) / "l"
    listed = json.loads((home / "frames.json").read_text())
    assert listed["native"] == [20, 60]
    for number in range(6):
        data = (home / f"{number:010d}.jpg").read_bytes()
        assert listed["frames"][f"{number:010d}"] == [len(data), hashlib.sha256(data).hexdigest()]
    copy = read_image(home / "0000000003.jpg")
    assert copy.shape == (10, 32, 3)
    assert np.abs(copy.astype(int) - resize(recordings[0][0].image(3), 10, 32)).mean() < 25
    assert build_cache(recordings, tmp_path / "cache", SMALL).verified == 10


def test_webp_and_quality(tree, tmp_path):
    recordings = kitti_recordings(tree, ["left"], ["0002_sync"])
    sizes = []
    for quality in (30, 95):
        folder = tmp_path / str(quality)
        build_cache(recordings, folder, CacheSettings(20, 60, "webp", quality))
        sizes.append(sum(path.stat().st_size for path in folder.rglob("*.webp")))
    assert sizes[0] < 0.7 * sizes[1]


def test_damaged_and_missing_copies_are_made_again(tree, tmp_path):
    recordings, folder = kitti_recordings(tree, ["left"]), tmp_path / "cache"
    build_cache(recordings, folder, SMALL)
    expected = content(folder)
    home = folder / name(1) / "l"
    (home / "0000000001.jpg").write_bytes(b"garbage")
    (home / "0000000002.jpg").unlink()
    (home / partial_name("0000000004", ".jpg").replace(str(os.getpid()), "999999999")).write_bytes(b"half")
    report = build_cache(recordings, folder, SMALL)
    assert (report.made, report.replaced, report.verified) == (2, 1, 8)
    assert content(folder) == expected


def test_a_cache_grows_by_recordings_and_frames(tree, tmp_path):
    both, folder = kitti_recordings(tree, ["left"]), tmp_path / "cache"
    build_cache([(both[0][0], [1, 2])], folder, SMALL)
    build_cache([(both[0][0], [4])], folder, SMALL)
    assert list(ImageCache(folder).frames(both[0][0])["frames"]) == [f"{n:010d}" for n in (1, 2, 4)]
    build_cache(both, folder, SMALL)
    build_cache(both, tmp_path / "clean", SMALL)
    assert content(folder) == content(tmp_path / "clean")


def test_killed_while_writing_it_ends_like_a_clean_run(tree, tmp_path):
    """SIGKILL in each moment of writing a file, a moment later every time, until a run gets through."""
    recordings, folder = kitti_recordings(tree, ["left"]), tmp_path / "cache"
    build_cache(recordings, tmp_path / "clean", SMALL)
    clean, fork = content(tmp_path / "clean"), multiprocessing.get_context("fork")
    for moment in itertools.count(1):
        run = fork.Process(target=_build_until, args=(moment, recordings, folder))
        run.start()
        run.join()
        finished = {path: data for path, data in content(folder).items() if ".partial" not in path}
        assert finished.items() <= clean.items()  # never half a file, never one that does not belong
        if run.exitcode == 0:
            break
        assert run.exitcode == -signal.SIGKILL
    assert moment > 6  # each moment came more than once
    assert content(folder) == clean


def _build_until(moment, recordings, folder):
    """Die at the given moment: when half of a file is written, when all of it is, when it has its name."""
    cv2.setNumThreads(0)
    write, replace, moments = Path.write_bytes, os.replace, itertools.count(1)

    def pass_moment():
        if next(moments) == moment:
            os.kill(os.getpid(), signal.SIGKILL)

    def write_in_halves(path, data):
        write(path, data[: len(data) // 2])
        pass_moment()
        return write(path, data)

    def replace_slowly(source, target):
        pass_moment()
        replace(source, target)
        pass_moment()

    Path.write_bytes, os.replace = write_in_halves, replace_slowly
    build_cache(recordings, folder, SMALL)


@pytest.mark.slow
def test_killed_with_several_processes_through_the_command_line(tree, tmp_path):
    import subprocess
    import sys

    command = [
        sys.executable,
        "-m",
        "saunet",
        "prepare",
        "cache",
        f"root={tree}",
        "height=10",
        "width=32",
        "workers=2",
    ]
    assert subprocess.run([*command, f"folder={tmp_path / 'clean'}"], cwd=tmp_path).returncode == 0
    waits = np.random.default_rng(1).uniform(2, 15, 3)
    for wait in waits:
        run = subprocess.Popen([*command, f"folder={tmp_path / 'cache'}"], cwd=tmp_path, start_new_session=True)
        try:
            run.wait(wait)
        except subprocess.TimeoutExpired:
            run.kill()  # the parent alone: its processes must follow by themselves
            run.wait()
    end = time.monotonic() + 60
    while time.monotonic() < end and _of_session(run.pid):
        time.sleep(0.2)
    assert not _of_session(run.pid)
    assert subprocess.run([*command, f"folder={tmp_path / 'cache'}"], cwd=tmp_path).returncode == 0
    assert content(tmp_path / "cache") == content(tmp_path / "clean")
    assert os.listdir(tree) == ["2011_09_26"]


def _of_session(leader):
    """Return the processes that a session leader has left behind."""
    import psutil

    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == leader and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
        except (psutil.Error, OSError):
            continue
    return found


def test_what_cannot_work_is_one_sentence(tree, tmp_path):
    recordings, folder = kitti_recordings(tree, ["left"]), tmp_path / "cache"
    build_cache(recordings, folder, SMALL)
    with pytest.raises(DataError, match="was made with height=10, quality=95; use the same"):
        build_cache(recordings, folder, CacheSettings(12, 32, quality=90))
    settings = folder / "cache.json"
    settings.write_text(settings.read_text().replace('"version": 1', '"version": 7'))
    for use in (lambda: build_cache(recordings, folder, SMALL), lambda: ImageCache(folder)):
        with pytest.raises(DataError, match="has version 7, but version 1 is required; delete it and make it again"):
            use()
    with pytest.raises(DataError, match="is not empty and not a cache"):
        build_cache(recordings, tree, SMALL)
    with pytest.raises(DataError, match=r"no cache at .* make it: saunet prepare cache"):
        ImageCache(tmp_path / "nowhere")
    for wrong, message in (({"quality": 0}, "quality is 0"), ({"format": "gif"}, "format")):
        with pytest.raises((ConfigError, TypeError), match=message):
            CacheSettings(10, 32, **wrong)


def test_broken_originals_stop_or_are_skipped(tree, tmp_path):
    (tree / name(1) / "image_02" / "data" / "0000000002.png").write_bytes(b"")
    recordings = kitti_recordings(tree, ["left"], ["0001_sync"])
    with pytest.raises(DataError, match=r"0000000002\.png is empty"):
        build_cache(recordings, tmp_path / "cache", SMALL)
    report = build_cache(recordings, tmp_path / "cache", SMALL, on_error="skip")
    assert len(report.failures) == 1
    assert list(ImageCache(tmp_path / "cache").frames(recordings[0][0])["frames"]) == [
        f"{number:010d}" for number in (0, 1, 3, 4, 5)
    ]


def test_frames_of_two_sizes_are_named_or_skipped(tree, tmp_path):
    odd = tree / name(1) / "image_02" / "data" / "0000000002.png"
    cv2.imwrite(str(odd), np.zeros((22, 60, 3), np.uint8))
    recordings = kitti_recordings(tree, ["left"])
    with pytest.raises(DataError, match=r"0000000002\.png is 60x22 .* but the frames of '.*' are 60x20"):
        build_cache(recordings, tmp_path / "cache", SMALL)
    report = build_cache(recordings, tmp_path / "cache", SMALL, on_error="skip")
    assert len(report.failures) == 1
    assert "0000000002.png is 60x22" in report.failures[0]
    listed = ImageCache(tmp_path / "cache").frames(recordings[0][0])
    assert list(listed["frames"]) == [f"{number:010d}" for number in (0, 1, 3, 4, 5)]
    again = build_cache(recordings, tmp_path / "cache", SMALL, on_error="skip")
    assert (again.made, again.verified, len(again.failures)) == (0, 9, 1)


def test_frames_of_two_sizes_are_named_where_the_recording_does_not_know_its_size(tmp_path):
    class Drive(NumberDrive):
        def image(self, index):
            return np.zeros((20 + 2 * index, 60, 3), np.uint8)

    with pytest.raises(DataError, match=r"have different sizes: 20x60 \(frame 0\) and 22x60 \(frame 1\)"):
        build_cache([(Drive(), [0, 1])], tmp_path / "cache", SMALL)


def test_copies_of_changed_originals_are_made_again(tree, tmp_path):
    recordings, folder = kitti_recordings(tree, ["left"]), tmp_path / "cache"
    build_cache(recordings, folder, SMALL)
    original = tree / name(1) / "image_02" / "data" / "0000000002.png"
    before, copy = original.stat().st_mtime_ns, folder / name(1) / "l" / "0000000002.jpg"
    cv2.imwrite(str(original), np.full((20, 60, 3), 200, np.uint8))
    os.utime(original, ns=(before, before + 1))
    report = build_cache(recordings, folder, SMALL)
    assert (report.made, report.replaced, report.verified) == (1, 1, 9)
    assert np.abs(read_image(copy).astype(int) - 200).max() < 5
    os.utime(original, ns=(before, before + 2))  # touched, but the same picture
    assert build_cache(recordings, folder, SMALL).verified == 10
    listed = json.loads((folder / name(1) / "l" / "frames.json").read_text())
    assert listed["originals"]["0000000002"] == [original.stat().st_size, before + 2]
    del listed["originals"]  # as older versions wrote it: then all are compared
    (folder / name(1) / "l" / "frames.json").write_text(json.dumps(listed))
    cv2.imwrite(str(original), np.full((20, 60, 3), 100, np.uint8))
    assert build_cache(recordings, folder, SMALL).replaced == 1
    cv2.imwrite(str(original), np.full((10, 30, 3), 100, np.uint8))
    for number in (0, 1, 3, 4, 5):
        cv2.imwrite(str(original.with_name(f"{number:010d}.png")), np.full((10, 30, 3), 100, np.uint8))
    with pytest.raises(
        DataError, match=r"were made from images of 20x60 .* which are now 10x30; delete .*0001_sync.l "
    ):
        build_cache(kitti_recordings(tree, ["left"]), folder, SMALL)


@pytest.mark.parametrize(
    "content", ["{}", "[1]", "x", '{"native": [20], "frames": {}}', '{"native": [20, 60]}', '{"frames": {}}']
)
def test_a_damaged_list_is_one_sentence(tree, tmp_path, content):
    recordings, folder = kitti_recordings(tree, ["left"]), tmp_path / "cache"
    build_cache(recordings, folder, SMALL)
    before = json.loads((folder / name(1) / "l" / "frames.json").read_text())
    (folder / name(1) / "l" / "frames.json").write_text(content)
    for use in (
        lambda: build_cache(recordings, folder, SMALL),
        lambda: ImageCache(folder).drive(recordings[0][0], [0]),
    ):
        with pytest.raises(DataError, match=r"frames\.json is damaged; delete it and run saunet prepare cache again"):
            use()
    (folder / name(1) / "l" / "frames.json").unlink()
    assert build_cache(recordings, folder, SMALL).verified == 10
    assert json.loads((folder / name(1) / "l" / "frames.json").read_text()) == before
