"""Damage the files that users bring, and read them: only errors of saunet come out, soon, and little memory goes.

``python tests/faults/fuzz.py --seconds 600`` shares so many seconds among the parsers and prints what it did.
"""

from __future__ import annotations

import argparse
import importlib.util
import io
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))

from prepare_tree import CALIBRATION, SCANNER
from tiny_checkpoint import write_checkpoint

from saunet.data.kitti.files import oxts_speed, read_calibration, read_times, read_timestamps
from saunet.data.kitti.splits import read_split
from saunet.data.lidar import read_scan
from saunet.data.loading.selecting import read_manifest
from saunet.data.video.camera import read_camera
from saunet.errors import SaunetError
from saunet.io.images import read_depth, read_image, write_image
from saunet.io.plain import read_array, read_arrays, read_json, read_yaml
from saunet.io.speeds import read_speeds
from saunet.io.trajectories import read_kitti
from saunet.runs.checkpoint import read_checkpoint
from saunet.runs.run import read_run
from saunet.weights.files import read_model

SLOW = 2.0
"""Seconds that no file may take."""
MEMORY = 300
"""MB by which this process may grow, over all files of a parser."""
WORDS = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"9" * 400, b"9" * 5000, b"0x10", b"1_0", b"null", b"true"),
    *(b"[", b"]", b"{", b"}", b":", b": ", b",", b'"', b"'", b"\n", b"\r\n", b" ", b"\t", b"\0", b"\xff", b"\xc3\xa9"),
    *(b"[" * 3000, b"{a: " * 500, b"&a ", b"*a", b"!!python/object:os.system ", b"!!binary ", b"? ", b"<<: *a", b"---"),
    *(b"!!opencv-matrix", b"\xd9\xa3", b"2011-09-26", b"- ", b"#", b"%", b"|", b">", b"<!ENTITY a 'b'>", b"&lt;", b"="),
)


@st.composite
def damage(draw: st.DrawFn, whole: bytes) -> bytes:
    """Return a file's bytes after a few accidents."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        until = min(len(data), at + draw(st.integers(0, 24)))
        match draw(st.integers(0, 5)):
            case 0:
                del data[at:]
            case 1:
                del data[at:until]
            case 2:
                data[at:at] = draw(st.sampled_from(WORDS))
            case 3:
                data[at:until] = draw(st.sampled_from(WORDS))
            case 4:
                data[at:at] = data[draw(st.integers(0, at)) : until]
            case 5 if at < len(data):
                data[at] = draw(st.integers(0, 255))
    return bytes(data)


def _calibrations() -> ModuleType:
    file = Path(__file__).parents[1] / "data" / "test_calibrations.py"
    spec = importlib.util.spec_from_file_location("calibrations_of_other_tools", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _array() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.arange(12, dtype=np.float32).reshape(3, 4))
    return buffer.getvalue()


def _arrays() -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, a=np.arange(12.0), b=np.ones((2, 2), np.uint8))
    return buffer.getvalue()


def _torch() -> bytes:
    buffer = io.BytesIO()
    record = {"format": 1, "model": {"encoder": {"_target_": "x"}}, "height": 32}
    torch.save({"saunet": record, "state_dict": {"a": torch.ones(3)}, "epoch": 1}, buffer)
    return buffer.getvalue()


def _picture(suffix: str, image: Any) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_image(Path(folder) / f"x{suffix}", image)
        return (Path(folder) / f"x{suffix}").read_bytes()


def _model(part: str) -> bytes:
    from safetensors.torch import save

    with tempfile.TemporaryDirectory() as folder:
        write_checkpoint(Path(folder) / "x.ckpt", 32, 64)
        read = read_checkpoint(Path(folder) / "x.ckpt")
    if part == "config":
        return json.dumps(read.record.to_plain()).encode()
    return save({name: value.contiguous() for name, value in read.state.items()}, {"format": "pt"})


def _export(path: Path) -> object:
    """Read and build an exported model whose record is the file."""
    path.with_name("config.json").write_bytes(path.read_bytes())
    weights = path.with_name("model.safetensors")
    if not weights.exists():
        weights.write_bytes(_model("weights"))
    return read_model(path.parent).networks()


def _run(path: Path) -> object:
    for name in ("run.json", "csv/metrics.csv", ".hydra/config.yaml"):
        (path.parent / name).parent.mkdir(exist_ok=True)
        (path.parent / name).write_bytes(path.read_bytes())
    return read_run(path.parent)


def _kitti(path: Path) -> object:
    (path.parent / "calib_cam_to_cam.txt").write_bytes(path.read_bytes())
    (path.parent / "calib_velo_to_cam.txt").write_bytes(path.read_bytes())
    return read_calibration(path.parent)


_OTHERS = _calibrations()
_GRAY = np.tile(np.arange(24, dtype=np.uint8)[:, None, None] * 9, (1, 32, 3))
_MANIFEST = '{"format": 1, "leave_out": {"a": {"static": [1, 2]}}, "numbering": {"a": "x"}, "test_only": ["a"]}'
_CAMERA = (
    b"image_size: [320, 200]\nK: [250, 252, 158.0, 101.0]\nfps: 10\ncamera_height: 1.4\ncrop: [0, 0.1, 0, 0]\n"
    b"model: fisheye\ndistortion: [0.1, 0.01, 0.0, 0.0]\ncondition: sunny\n"
)
PARSERS: dict[str, tuple[Callable[[Path], object], tuple[bytes, ...]]] = {
    "camera.yaml": (read_camera, (_CAMERA,)),
    "calibrations of other tools": (
        read_camera,
        (
            *(getattr(_OTHERS, name).encode() for name in ("ROS", "OPENCV", "OPENCV5", "OPENCV_XML", "KALIBR", "VINS")),
            *(getattr(_OTHERS, name).encode() for name in ("KITTI360", "KITTI", "ORB")),
            *(json.dumps(plain).encode() for plain in (_OTHERS.NERF, _OTHERS.MATLAB)),
            _OTHERS.COLMAP_BINARY,
        ),
    ),
    "KITTI calibration": (_kitti, (CALIBRATION.encode() + SCANNER.encode(),)),
    "KITTI scan": (read_scan, (np.ones((5, 4), np.float32).tobytes(),)),
    "KITTI OXTS": (oxts_speed, (b" ".join([b"1.5"] * 30),)),
    "KITTI time stamps": (read_timestamps, (b"2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.064389445\n",)),
    "KITTI times": (read_times, (b"0.0\n1.0e-1\n0.2\n",)),
    "poses": (read_kitti, (b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n",)),
    "split": (read_split, (b"2011_09_26/2011_09_26_drive_0001_sync 5 l\n",)),
    "speeds": (read_speeds, (b"drive,time,speed\na,0.0,1.5\na,1.0,2.5\n", b"frame,speed\n0,1\n5,2\n")),
    "manifest": (read_manifest, (_MANIFEST.encode(),)),
    "json": (read_json, (b'{"a": [1, 2.5, null, true, {"b": "text"}]}',)),
    "yaml": (read_yaml, (b"a: &a [1, 2.5, null]\nb: {c: text, d: *a}\n",)),
    "npy": (read_array, (_array(),)),
    "npz": (read_arrays, (_arrays(),)),
    "checkpoint": (read_checkpoint, (_torch(),)),
    "exported model": (_export, (_model("config"),)),
    "run's folder": (_run, (b'{"status": "running", "pid": 1}', b"epoch,step,val/loss\n0,1,2.5\n", b"a: 1\n")),
    "image": (read_image, (_picture(".png", _GRAY), _picture(".jpg", _GRAY))),
    "depth": (read_depth, (_picture(".png", np.full((8, 9), 300, np.uint16)), _array())),
}
"""What reads a file, and files that it can read."""


class Fuzz:
    """One parser under damage, with what came of it."""

    def __init__(self, name: str, folder: Path) -> None:
        self.read, self.seeds = PARSERS[name]
        self.path = folder / "file"
        self.files = self.refused = 0
        self.slowest, self.longest = 0.0, 0
        self.before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def one(self, data: bytes) -> None:
        self.path.write_bytes(data)
        begin = time.process_time()
        try:
            self.read(self.path)
        except SaunetError as error:
            self.refused += 1
            self.longest = max(self.longest, len(str(error)))
        self.files += 1
        took = time.process_time() - begin
        self.slowest = max(self.slowest, took)
        assert took < SLOW, f"it took {took:.1f} s"
        assert self.longest < 2000, f"a message of {self.longest} characters"

    def run(self, examples: int, number: int | None = None) -> None:
        """Read so many damaged files; the same ones every time, unless a number draws others."""
        profile = {"database": None, "deadline": None, "suppress_health_check": list(HealthCheck)}
        profile |= (
            {"phases": list(Phase)} if number is None else {"phases": [Phase.generate]}
        )  # shrinking takes minutes

        @settings(max_examples=examples, derandomize=number is None, **profile)  # type: ignore[arg-type]
        @given(st.sampled_from(self.seeds).flatmap(damage))
        def drawn(data: bytes) -> None:
            self.one(data)

        (drawn if number is None else seed(number)(drawn))()

    @property
    def grown(self) -> float:
        """MB that the process has grown by."""
        return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - self.before) / 1024


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60, help="of CPU time, for all parsers together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=[""], nargs="+", help="parsers whose names begin so")
    given_ = parser.parse_args()
    chosen, wrong = [name for name in PARSERS if name.startswith(tuple(given_.only))], 0
    for name in chosen:
        with tempfile.TemporaryDirectory() as folder:
            fuzz, end, number = (
                Fuzz(name, Path(folder)),
                time.process_time() + given_.seconds / len(chosen),
                given_.seed,
            )
            found = ""
            while time.process_time() < end and not found:
                number += 1
                try:
                    fuzz.run(200, number)
                except Exception as error:
                    found = f"{type(error).__name__}: {str(error)[:300]} {getattr(error, '__notes__', '')}"
            if fuzz.grown > MEMORY:
                found = f"{found} the process grew by {fuzz.grown:.0f} MB"
        wrong += bool(found)
        said = {"files": fuzz.files, "refused": fuzz.refused, "slowest": round(fuzz.slowest, 3), "grown": fuzz.grown}
        print(json.dumps({"parser": name, **said, "wrong": found}), flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
