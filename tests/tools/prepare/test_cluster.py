"""``executor=dask`` with two worker processes, one of which is killed at work."""

from __future__ import annotations

import hashlib

import pytest
from fragile_teacher import FragileTeacher

from saunet.data.loading.stored import CacheSettings
from saunet.errors import ConfigError
from saunet.tools.prepare.cache import build_cache
from saunet.tools.prepare.pool import Workers
from saunet.tools.prepare.targets import densify, teach
from saunet.tools.prepare.tool import kitti_recordings

distributed = pytest.importorskip("distributed", reason="distributed (extra dask) is not installed")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scheduler():
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster:
        yield cluster.scheduler_address


def contents(folder):
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_a_lost_worker_costs_nothing(tree, tmp_path, scheduler):
    recordings, grave = kitti_recordings(tree, ["left"]), tmp_path / "grave"
    done = teach(recordings, FragileTeacher(grave), str(tmp_path / "cluster"), Workers(scheduler=scheduler))
    assert grave.exists()
    assert (done.made, done.failures) == (10, ())
    teach(recordings, FragileTeacher(grave), str(tmp_path / "one"))
    assert len(contents(tmp_path / "one")) == 12
    assert contents(tmp_path / "cluster") == contents(tmp_path / "one")


def test_all_jobs_make_the_files_of_one_process(tree, tmp_path, scheduler):
    recordings, settings = kitti_recordings(tree, ["left"]), CacheSettings(10, 30)
    (tree / "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/0000000003.bin").write_bytes(b"abc")
    for name, workers in (("one", Workers()), ("cluster", Workers(scheduler=scheduler))):
        done = densify(recordings, ["linear"], str(tmp_path / name / "maps"), workers, "skip")
        assert (done.made, len(done.failures)) == (9, 1)
        report = build_cache(recordings, tmp_path / name / "cache", settings, workers)
        assert report.made == 10
    assert contents(tmp_path / "cluster") == contents(tmp_path / "one")


def test_a_scheduler_that_is_not_there_is_one_sentence(tree, monkeypatch):
    monkeypatch.setattr("saunet.tools.prepare.pool._PATIENCE", 0.5)
    with pytest.raises(ConfigError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1"):
        densify(kitti_recordings(tree, ["left"]), workers=Workers(scheduler="tcp://127.0.0.1:1"))
