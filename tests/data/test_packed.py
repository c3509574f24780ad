"""Packed data give the batches of the folders that they were packed from, bit for bit, from a disk and a server."""

from __future__ import annotations

import contextlib
import functools
import http.server
import itertools
import pickle
import tarfile
import threading
from typing import ClassVar

import fsspec
import numpy as np
import pytest
import torch
from clip_tree import frames, make_clip, make_video

from saunet.data.loading.windows import measured_distance
from saunet.data.packed.store import Part, Store, shard_name
from saunet.errors import ConfigError, DataError
from saunet.registry import datamodules
from saunet.tools.prepare.pack import pack

SIZE = {"height": 32, "width": 64, "batch_size": 3, "workers": 0}


def clips(root):
    """Return a data module of a folder of JPEGs, one of PNGs that are cropped, and a video."""
    make_clip(root / "clips", "a", frames(14), suffix=".jpg")
    make_clip(root / "clips", "b", frames(12, seed=1))
    make_video(root / "clips" / "c.avi", frames(13, seed=2))
    return datamodules.build("video", root=str(root / "clips"), frames_cache=str(root / "cache"), **SIZE)


def street(root, **options):
    size = {**SIZE, "train_drives": 2, "val_drives": 1, "test_drives": 1, "frames_per_drive": 6}
    return datamodules.build("synthetic_tiny", **size, target_depth=True, with_pose=True, **options)


def kitti(root, **options):
    return datamodules.build("kitti", root=str(root), split="all", val_share=0.2, **SIZE, **options)


def packed(folder, **options):
    return datamodules.build("packed", root=str(folder), **{**SIZE, **options})


def batches(data, split):
    loader = getattr(data, f"{split}_dataloader")()
    if split == "train":
        loader.sampler.set_epoch(2)
    return list(loader)


def equal(ours, theirs):
    assert len(ours) == len(theirs)
    assert len(ours) > 0
    for mine, other in zip(ours, theirs, strict=True):
        assert mine.keys() == other.keys()
        for key, value in mine.items():
            if isinstance(value, torch.Tensor):
                torch.testing.assert_close(value, other[key], rtol=0, atol=0, equal_nan=True)
            else:
                assert value == other[key]


def alike(source, folder, **options):
    pack(source, folder, shard_mb=1, workers=2)
    again = packed(folder, **options)
    for data in (source, again):
        data.setup()
    assert again.fingerprints() == source.fingerprints()
    assert again.usage == source.usage
    for split in source.datasets:
        equal(batches(again, split), batches(source, split))
    for key in ("protocol", "protocols", "ground_truth", "camera_height"):
        assert getattr(again, key) == getattr(source, key)
    return again


def test_clips(tmp_path):
    again = alike(clips(tmp_path), tmp_path / "packed")
    with tarfile.open(tmp_path / "packed" / shard_name(0)) as archive:  # any tool can look into it
        members = {member.name: archive.extractfile(member).read() for member in archive}
    original = (tmp_path / "clips" / "a" / "frame_3.jpg").read_bytes()
    assert original in members.values()  # not encoded anew
    drive = again.datasets["train"].drives[0]
    assert pickle.loads(pickle.dumps(drive)).fps == drive.fps == 10
    assert drive.time(3) == pytest.approx(0.3)


@pytest.mark.parametrize("stereo", [False, True])
def test_depth_poses_and_pairs(tmp_path, stereo):
    source = street(tmp_path, stereo=stereo)
    source.odometer = measured_distance
    again = alike(source, tmp_path / "packed")
    assert {"distance", "T_src_tgt", "target_depth"} <= batches(again, "train")[0].keys()


def test_distances_can_be_asked_for_afterwards(tmp_path):
    source = street(tmp_path, stereo=False)
    alike(source, tmp_path / "packed")
    again = packed(tmp_path / "packed", with_speed=True)
    again.setup("fit")
    assert batches(again, "train")[0]["distance"].isfinite().all()


def test_kitti_with_scans(tmp_path, kitti_mini):
    again = alike(kitti(kitti_mini / "raw", target_depth=True), tmp_path / "packed")
    assert batches(again, "train")[0]["target_depth"].any()


def test_a_resumed_epoch_and_several_processes(tmp_path):
    source = clips(tmp_path)
    again = alike(source, tmp_path / "packed")
    expected = batches(source, "train")
    first = again.train_dataloader()
    first.sampler.set_epoch(2)
    seen = list(itertools.islice(first, 3))
    rest = packed(tmp_path / "packed")
    rest.setup("fit")
    loader = rest.train_dataloader()
    loader.sampler.set_epoch(2)
    loader.load_state_dict(first.state_dict())
    equal([*seen, *loader], expected)
    parts = []
    for rank in range(3):
        again._place = lambda rank=rank: (rank, 3)
        parts.append([name for batch in batches(again, "train") for name in batch["name"]])
    assert len({*parts[0], *parts[1], *parts[2]}) == sum(map(len, parts))  # disjoint
    assert sorted(itertools.chain(*parts)) == sorted(name for batch in expected for name in batch["name"])


class _Ranges(http.server.SimpleHTTPRequestHandler):
    """A file server that gives byte ranges."""

    asked: ClassVar[list[str]] = []

    def do_GET(self):
        data = open(self.translate_path(self.path), "rb").read()  # noqa: SIM115
        asked = self.headers.get("Range")
        self.asked.append(f"{self.path} {asked}")
        first, last = (asked or "bytes=0-").removeprefix("bytes=").split("-")
        part = data[int(first) : int(last) + 1 if last else None]
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(len(part)))
        self.send_header("Content-Range", f"bytes {first}-{int(first) + len(part) - 1}/{len(data)}")
        self.end_headers()
        self.wfile.write(part)

    def log_message(self, *_):
        """Say nothing."""


@contextlib.contextmanager
def served(folder):
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Ranges, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_over_the_network_with_a_bounded_cache(tmp_path):
    pytest.importorskip("aiohttp")
    source = clips(tmp_path)
    pack(source, tmp_path / "packed", shard_mb=1)
    source.setup("fit")
    whole = sum(path.stat().st_size for path in (tmp_path / "packed").glob("*.tar"))
    with served(tmp_path / "packed") as address:
        cache = {"stream_cache": str(tmp_path / "kept"), "stream_cache_gb": whole / 2 / 1e9}
        data = packed(address, workers=1, **cache)
        data.setup("fit")
        equal(batches(data, "train"), batches(source, "train"))
        kept = sum(path.stat().st_size for path in (tmp_path / "kept").rglob("*") if path.is_file())
        assert whole / 4 < kept <= whole / 2
        first, _Ranges.asked[:] = len(_Ranges.asked), []
        again = packed(address, **cache)
        again.setup("fit")
        equal(batches(again, "train"), batches(source, "train"))
        assert len(_Ranges.asked) < first
    with pytest.raises(DataError, match="cannot read"):
        again.datasets["train"].drives[-1]._store.file("pack.json")


def test_an_object_store(tmp_path, monkeypatch):
    pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0)
    server.start()
    try:
        _, port = server.get_host_and_port()
        for key in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(key, "any")
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        source = clips(tmp_path)
        pack(source, tmp_path / "packed", shard_mb=1)
        system = fsspec.filesystem("s3")
        system.mkdir("bucket")
        system.put(str(tmp_path / "packed"), "bucket/data", recursive=True)
        data = packed("s3://bucket/data", workers=2)
        for each in (source, data):
            each.setup("fit")
        equal(batches(data, "train"), batches(source, "train"))
        with pytest.raises(DataError, match=r"s3://bucket/other/pack.json does not exist"):
            packed("s3://bucket/other").setup("fit")
    finally:
        server.stop()


def test_what_is_wrong_is_said(tmp_path):
    with pytest.raises(DataError, match=r"pack.json does not exist.*saunet prepare pack"):
        packed(tmp_path / "none").setup("fit")
    source = clips(tmp_path)
    pack(source, tmp_path / "packed", shard_mb=1)
    with pytest.raises(DataError, match="already has packed data"):
        pack(source, tmp_path / "packed", shard_mb=1)
    with pytest.raises(DataError, match="not empty"):
        pack(source, tmp_path / "clips", shard_mb=1)
    with pytest.raises(ConfigError, match=r"offsets are \[-2, 2\].*packed for \[-1, 1\]"):
        packed(tmp_path / "packed", offsets=[-2, 2]).setup("fit")
    shard = tmp_path / "packed" / shard_name(0)
    shard.write_bytes(shard.read_bytes()[:2000])
    data = packed(tmp_path / "packed")
    data.setup("fit")
    with pytest.raises(DataError, match="ends before byte"):
        batches(data, "train")
    store = Store(str(tmp_path / "packed"))
    assert len(store.part(Part(0, 10, 20))) == 20
    assert np.isin(list(shard.read_bytes()[10:30]), list(store.part(Part(0, 10, 20)))).all()
