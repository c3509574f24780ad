"""The contract of a recording: complete defaults, proxies that forward all of it, and no probing anywhere."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from drives import NumberDrive

from saunet.data.drive import Drive, DriveProxy, camera_files

SOURCE = Path(__file__).parents[2] / "src" / "saunet"
MEMBERS = {name for name in vars(Drive) if not name.startswith("_")}
GENERIC = {"name", "origin", "path", "folder", "time"}
"""Members that other things have too."""


class Bare(Drive):
    """The least that a data set has to say."""

    name = "bare"
    indices = (0, 2, 3)

    def image(self, index):
        return np.zeros((4, 6, 3), np.uint8)

    def intrinsics(self, index):
        return np.eye(3)


def test_four_members_are_enough_and_the_rest_is_unknown():
    drive = Bare()
    unknown = {drive.depth(0), drive.pose(0), drive.time(0), drive.timestamps, drive.fps, drive.speed(0)}
    unknown |= {drive.distance(0, 2), drive.stereo(), drive.T_stereo_cam, drive.path(0), drive.folder}
    unknown |= {drive.frame_size, drive.camera_height, drive.condition, drive.depth_key(0), drive.scene_mask}
    unknown |= {drive.lens, drive.camera_file}
    assert unknown == {None}
    assert (drive.has_depth(0), drive.recorded(2), drive.numbering, drive.origin) == (False, 2, "", "")
    assert not drive.has_scene_mask
    np.testing.assert_array_equal(drive.recorded_image(2), drive.image(2))


@pytest.mark.parametrize("missing", ["name", "indices", "image", "intrinsics"])
def test_a_forgotten_member_is_an_error_at_once(missing):
    members = {name: getattr(Bare, name) for name in ("name", "indices", "image", "intrinsics") if name != missing}
    with pytest.raises(TypeError, match=missing):
        type("Broken", (Drive,), members)()


@pytest.mark.parametrize("attribute", ["protocol", "ground_truth"])
def test_how_to_evaluate_is_refused_in_a_drive_where_nothing_reads_it(attribute):
    with pytest.raises(TypeError, match=rf"Mine has the attribute '{attribute}'.* DepthDataModule; move it there"):
        type("Mine", (Bare,), {attribute: "none"})


def test_what_follows_from_what_is_known():
    class Timed(NumberDrive):
        def time(self, index):
            return None if index == 3 else 0.5 * index

    drive = Timed(indices=(0, 1, 3, 4, 5))
    np.testing.assert_array_equal(drive.timestamps, [0, 0.5, np.nan, 2, 2.5])
    assert drive.fps == 2
    assert drive.has_depth(0)
    assert not Timed(truth=False).has_depth(0)
    assert drive.distance(1, 4) == pytest.approx(np.hypot(0.3, 3))


def test_without_poses_the_distance_follows_from_speeds_and_times():
    class Driven(Bare):
        def time(self, index):
            return {0: 10.0, 2: 10.5, 3: 10.7}[index]

        def speed(self, index):
            return {0: 4.0, 2: 6.0, 3: None}[index]

    drive = Driven()
    assert drive.distance(0, 2) == drive.distance(2, 0) == pytest.approx(2.5)
    assert drive.distance(2, 2) == 0
    assert drive.distance(0, 3) is None


def test_camera_files_are_counted_once_for_each_recording():
    class Filmed(Bare):
        def __init__(self, name, file):
            self.name, self._file = name, file

        @property
        def camera_file(self):
            return None if self._file is None else Path(self._file)

    assert camera_files([Bare()]) == ""
    assert camera_files([Filmed("a", "x.yaml"), Filmed("b", "x.yaml"), Bare()]) == "camera: x.yaml"
    drives = [
        Filmed("a", "x"),
        Filmed("b", "y"),
        Filmed("b", "y"),
        Filmed("c", "y"),
        Filmed("d", "z"),
        Filmed("e", "v"),
    ]
    assert camera_files(drives) == "cameras: 4 files: y (2 clips), x (1 clip), z (1 clip), ..."


def test_a_proxy_forwards_every_member():
    assert vars(DriveProxy).keys() >= MEMBERS

    asked: list[str] = []

    class Loud(NumberDrive):
        def __getattribute__(self, name):
            if name in MEMBERS:
                asked.append(name)
            return super().__getattribute__(name)

    proxy = DriveProxy(Loud())
    for name in sorted(MEMBERS):
        asked.clear()
        member = inspect.getattr_static(DriveProxy, name)
        arguments = () if isinstance(member, property) else (1,) * (len(inspect.signature(member).parameters) - 1)
        given = getattr(proxy, name)
        _ = given if isinstance(member, property) else given(*arguments)
        assert asked[0] == name


def test_nothing_probes_a_recording():
    """A member that a caller looks for by name is one that a typo in a data set silently switches off."""
    found = []
    for path in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name) or len(node.args) < 2:
                continue
            called, target, word = node.func.id, ast.unparse(node.args[0]), ast.unparse(node.args[1])
            member = isinstance(node.args[1], ast.Constant) and node.args[1].value in MEMBERS - GENERIC
            probes = called in ("getattr", "hasattr") and (member or "drive" in target.lower())
            sorts = called in ("isinstance", "issubclass") and any(
                each.endswith(("Drive", "Sequence")) and each != "Sequence" for each in re.split(r"\W+", word)
            )
            if probes or sorts:
                found.append(f"{path.relative_to(SOURCE)}: {ast.unparse(node)}")
    assert not found
