from __future__ import annotations

import os

import numpy as np
import pytest
import scipy.spatial
import torch
from prepare_tree import name

from saunet.data.loading.stored import DepthMaps
from saunet.errors import ConfigError, DataError
from saunet.io.atomic import partial_name
from saunet.io.images import read_depth
from saunet.tools.prepare.pool import Workers
from saunet.tools.prepare.targets import densify, densify_map, interpolate
from saunet.tools.prepare.tool import kitti_recordings


def barycentric(depth):
    """Linear interpolation over Delaunay triangles, pixel by pixel."""
    rows, columns = np.nonzero(depth)
    points = np.stack([columns, rows], -1).astype(float)
    mesh = scipy.spatial.Delaunay(points)
    out = np.zeros(depth.shape)
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            triangle = int(mesh.find_simplex(np.array([x, y], float)))
            if triangle >= 0:
                corners = mesh.simplices[triangle]
                system = np.vstack([points[corners].T, np.ones(3)])
                out[y, x] = np.linalg.solve(system, [x, y, 1]) @ depth[rows[corners], columns[corners]]
    return out


def test_linear_is_barycentric_inside_the_hull_and_nothing_outside():
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((20, 30)) < 0.1, rng.uniform(3, 60, (20, 30)), 0).astype(np.float32)
    depth[:4] = 0
    dense = interpolate(depth)
    assert np.allclose(dense, barycentric(depth), atol=1e-4)
    assert (dense[:4] == 0).all()
    assert np.allclose(dense[depth > 0], depth[depth > 0])


def test_a_plane_in_depth_is_reproduced():
    rows, columns = np.indices((20, 30))
    plane = (5 + 0.5 * rows + 0.25 * columns).astype(np.float32)
    depth = np.where(np.random.default_rng(1).random((20, 30)) < 0.1, plane, 0).astype(np.float32)
    dense = interpolate(depth)
    assert np.allclose(dense[dense > 0], plane[dense > 0], atol=1e-4)


@pytest.mark.parametrize("known", [[], [(3, 3)], [(3, 3), (5, 9)], [(3, 3), (3, 5), (3, 9)]])
def test_too_little_to_interpolate_stays_as_it_is(known):
    depth = np.zeros((10, 12), np.float32)
    for place in known:
        depth[place] = 7.0
    assert np.array_equal(interpolate(depth), depth)


def test_a_tree_is_densified_once_and_completed(tree):
    recordings = kitti_recordings(tree, ["left"])
    done = densify(recordings, ["linear", "colorization"])
    assert (done.made, done.before, done.without) == (10, 0, 0)
    drive = recordings[0][0]
    for kind in ("linear", "colorization"):
        maps = DepthMaps(kind)
        assert maps.path(drive, 3).parent == tree / name(1) / f"depth_{kind}" / "l"
        assert maps.frames(drive) == set(range(6))
        expected = densify_map(kind, drive.image(3), drive.depth(3))
        assert np.abs(maps.read(drive, 3) - expected).max() <= 1 / 512
    stamps = {path: path.stat().st_mtime_ns for path in tree.rglob("depth_*/l/*.png")}
    assert len(stamps) == 20
    lost = next(iter(stamps))
    lost.unlink()
    leftover = lost.with_name(partial_name("0000000003", ".png").replace(str(os.getpid()), "999999999"))
    leftover.write_bytes(b"half")
    done = densify(recordings, ["linear", "colorization"])
    assert (done.made, done.before) == (1, 9)
    assert lost.is_file()
    assert not leftover.exists()
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items() if path != lost)


def test_a_folder_of_their_own_leaves_the_data_untouched(tree, tmp_path):
    before = sorted(tree.rglob("*"))
    densify(kitti_recordings(tree, ["left"], ["0002_sync"]), ["linear"], str(tmp_path / "maps"))
    assert sorted(tree.rglob("*")) == before
    stored = sorted((tmp_path / "maps" / name(2) / "depth_linear" / "l").glob("*.png"))
    assert len(stored) == 4
    assert read_depth(stored[0]).shape == (20, 60)


def test_broken_scans_stop_or_are_skipped(tree):
    scans = tree / name(1) / "velodyne_points" / "data"
    (scans / "0000000002.bin").write_bytes(b"12345")
    (scans / "0000000004.bin").unlink()
    recordings = kitti_recordings(tree, ["left"], ["0001_sync"])
    with pytest.raises(DataError, match=r"0000000002\.bin has 5 bytes"):
        densify(recordings)
    done = densify(recordings, on_error="skip")
    assert done.without == 1
    assert len(done.failures) == 1
    assert "0000000002.bin" in done.failures[0]
    assert DepthMaps("linear").frames(recordings[0][0]) == {0, 1, 3, 5}


def test_processes_make_the_same_files(tree, tmp_path):
    recordings = kitti_recordings(tree, ["left"], ["0002_sync"])
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as in the processes: sums of several threads are rounded in another order
    try:
        for folder, workers in (("one", 0), ("two", 2)):
            densify(recordings, ["colorization"], str(tmp_path / folder), Workers(workers))
    finally:
        torch.set_num_threads(threads)
    files = [sorted((tmp_path / folder).rglob("*.png")) for folder in ("one", "two")]
    assert len(files[0]) == 4
    assert [path.read_bytes() for path in files[0]] == [path.read_bytes() for path in files[1]]


def test_what_cannot_work_is_one_sentence(tree):
    recordings = kitti_recordings(tree, ["left"])
    for path in tree.rglob("*.bin"):
        os.unlink(path)
    with pytest.raises(DataError, match="none of the 10 frames has a scan, such as"):
        densify(recordings)


def test_maps_made_differently_are_not_mixed(tree):
    recordings = kitti_recordings(tree, ["left"])
    densify(recordings)
    improved = kitti_recordings(tree, ["left"], depth="improved")
    truth = tree / name(1) / "proj_depth" / "groundtruth" / "image_02" / "0000000000.png"
    truth.parent.mkdir(parents=True)
    truth.write_bytes(b"x")
    with pytest.raises(DataError, match=r"made with different settings \(depth\)"):
        densify(improved)
    info = tree / name(1) / "depth_linear" / "l" / "maps.json"
    info.write_text(info.read_text().replace('"version": 1', '"version": 9'))
    with pytest.raises(DataError, match="have version 9, but version 1 is required"):
        densify(recordings)


def test_recordings_are_chosen(tree, tmp_path):
    assert [(drive.name, len(frames)) for drive, frames in kitti_recordings(tree, ["left"])] == [
        (f"{name(1)} l", 6),
        (f"{name(2)} l", 4),
    ]
    listed = tmp_path / "frames.txt"
    listed.write_text(f"{name(1)} 4 l\n")
    assert kitti_recordings(tree, ["left"], split=str(listed))[0][1] == [3, 4, 5]
    for options, message in (
        ({"drives": ["0009_sync"]}, "drives holds '0009_sync'"),
        ({"split": "eigen_zohu_by_drive"}, "did you mean 'eigen_zhou_by_drive'"),
    ):
        with pytest.raises(ConfigError, match=message):
            kitti_recordings(tree, **options)
    with pytest.raises(DataError, match="hold no frames of cameras"):
        kitti_recordings(tree, ["right"])
