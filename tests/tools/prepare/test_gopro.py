"""GoPro videos, whose data track the test writes as GPMF describes it, become clips with speeds."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from videos import number_of, numbered, write_video

import saunet
from saunet.errors import ConfigError, DataError
from saunet.tools.prepare import gopro, importing
from saunet.tools.prepare.gopro import samples
from saunet.tools.prepare.importing import import_recordings
from saunet.tools.prepare.tool import PrepareOptions, prepare

CAMERA = "image_size: [128, 96]\nK: [110, 110, 63.5, 47.5]\n"


def element(key: str, kind: str, size: int, data: bytes) -> bytes:
    return struct.pack(">4scBH", key.encode(), kind.encode(), size, len(data) // size) + data + bytes(-len(data) % 4)


def nested(key: str, *parts: bytes) -> bytes:
    return element(key, "\0", 1, b"".join(parts))


def device(*streams: bytes) -> bytes:
    name = element("DVNM", "c", 1, b"Hero6 Black")  # 11 bytes: padded to 12
    other = nested("STRM", element("SCAL", "s", 2, struct.pack(">h", 418)), element("ACCL", "s", 6, bytes(60)))
    return nested("DEVC", element("DVID", "L", 4, bytes(4)), name, other, *streams)


def gps5(rows: Sequence[tuple[float, ...]], fix: int = 3, precision: int = 150) -> bytes:
    """Latitude, longitude, altitude, 2D and 3D speed."""
    scales = (10_000_000, 10_000_000, 1000, 1000, 100)
    data = b"".join(struct.pack(">5i", *(round(v * s) for v, s in zip(row, scales, strict=True))) for row in rows)
    return nested(
        "STRM",
        element("GPSF", "L", 4, struct.pack(">I", fix)),
        element("GPSU", "c", 16, b"240503103000.123"),
        element("GPSP", "S", 2, struct.pack(">H", precision)),
        element("SCAL", "l", 4, struct.pack(">5i", *scales)),
        element("GPS5", "l", 20, data),
    )


def gps9(rows: Sequence[tuple[float, ...]]) -> bytes:
    """The same, days since 2000, seconds of the day, dilution of precision, and fix."""
    scales = (10_000_000, 10_000_000, 1000, 1000, 100, 1, 1000, 100, 1)
    pack = struct.Struct(">7i2H")
    data = b"".join(pack.pack(*(round(v * s) for v, s in zip(row, scales, strict=True))) for row in rows)
    return nested(
        "STRM",
        element("SCAL", "l", 4, struct.pack(">9i", *scales)),
        element("TYPE", "c", 1, b"lllllllSS"),
        element("GPS9", "?", pack.size, data),
    )


def speed_at(seconds: float) -> float:
    return 5 + seconds


def write_gopro(path: Path, payloads: Sequence[bytes], seconds: float = 1.001, frames: int = 60) -> Path:
    """Write a video of 20 frames a second and a data track with one packet for each payload."""
    with av.open(str(path), "w") as out:
        video: Any = out.add_stream("libx264", rate=20)
        video.width, video.height, video.pix_fmt = 128, 96, "yuv420p"
        data = out.add_data_stream("bin_data")
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(numbered(number), "rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 20)
            out.mux(video.encode(frame))
        out.mux(video.encode(None))
        for number, payload in enumerate(payloads):
            packet = av.Packet(payload)
            packet.stream, packet.time_base = data, Fraction(1, 1000)
            packet.pts = packet.dts = round(1000 * seconds * number)
            packet.duration = round(1000 * seconds)
            out.mux(packet)
    return path


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Three seconds of 18 positions, the speed growing by 1 m/s²; no fix in the second one."""
    moments = [[1.001 * (second + number / 18) for number in range(18)] for second in range(3)]
    payloads = [
        device(gps5([(49 + t / 1e4, 8.4, 115, speed_at(t), 9) for t in times], fix=0 if place == 1 else 3))
        for place, times in enumerate(moments)
    ]
    (tmp_path / "card").mkdir()
    return write_gopro(tmp_path / "card" / "GX010042.MP4", payloads)


def test_a_gopro_becomes_a_clip_that_trains(video: Path, tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(CAMERA)
    write_video(tmp_path / "card" / "other.mp4", 5)  # of another camera
    (tmp_path / "card" / "GL010042.LRV").write_bytes(video.read_bytes())  # the same at low resolution
    (tmp_path / "card" / "._GX010042.MP4").write_bytes(b"\0\5\x16\7")
    folder, camera = tmp_path / "clips", str(tmp_path / "camera.yaml")
    said = str(prepare(PrepareOptions(job="import", input=str(video.parent), folder=str(folder), camera=camera)))
    assert "GX010042: 36 speeds" in said
    assert "18 more without a fix" in said
    table = folder / "GX010042" / "GX010042.speeds.csv"
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    assert table.read_text().startswith("time,speed,latitude,longitude,altitude\n")
    assert rows[:, 0] == pytest.approx([1.001 * n / 18 for n in range(54) if not 18 <= n < 36], abs=2e-3)
    assert rows[:, 1] == pytest.approx(speed_at(rows[:, 0]), abs=3e-3)
    assert rows[:, 2] == pytest.approx(49 + rows[:, 0] / 1e4, abs=1e-6)
    data = saunet.build("data", "video", root=str(folder), fps=None, static="keep", workers=0, with_speed=True,
                        height=32, width=64, batch_size=1, frames_cache=str(tmp_path / "cache"))  # fmt: skip
    data.setup("fit")
    (recording,) = data.drives()
    assert [number_of(recording.image(index)) for index in recording.indices] == list(range(60))
    assert recording.speed(7) == pytest.approx(speed_at(0.35), abs=5e-3)
    assert recording.distance(4, 10) == pytest.approx(0.3 * speed_at(0.35), rel=1e-3)


def test_an_import_is_kept_resumes_and_refuses_another_version(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "clips"
    with monkeypatch.context() as patched:

        def full(path: Path, content: object) -> None:
            raise DataError(f"cannot write {path}: No space left on device")

        patched.setattr(gopro, "write_json", full)
        with pytest.raises(DataError, match="No space left"):
            import_recordings(video, folder)
    import_recordings(video, folder)
    table = folder / "GX010042" / "GX010042.speeds.csv"
    made = table.stat().st_mtime_ns
    with monkeypatch.context() as patched:
        patched.delattr(gopro, "_rows")
        assert "36 speeds" in str(import_recordings(video, folder))
    assert table.stat().st_mtime_ns == made
    video.write_bytes(video.read_bytes() + bytes(8))
    with pytest.raises(DataError, match="another version"):
        import_recordings(video, folder)
    own = tmp_path / "own" / "GX010042"
    own.mkdir(parents=True)
    (own / "GX010042.MP4").write_bytes(b"mine")
    with pytest.raises(DataError, match="other files"):
        import_recordings(video, own.parent)
    assert (own / "GX010042.MP4").read_bytes() == b"mine"


def test_newer_cameras_know_fix_and_precision_of_each_sample() -> None:
    rows = [(49.0, 8.4, 115.0, 7.0, 7.1, 8900, 37_800.5, 1.2, 3), (49.0, 8.4, 115.0, 7.5, 7.1, 8900, 37_800.6, 1.2, 0),
            (49.0, 8.4, 115.0, 8.0, 7.1, 8900, 37_800.7, 9.9, 3)]  # fmt: skip
    both = device(gps5([(48.0, 8.4, 115.0, 1.0, 1.0)]), gps9(rows))
    assert list(samples(both, "a")) == [pytest.approx((7.0, 49.0, 8.4, 115.0)), None, None]
    assert list(samples(device(gps5([(48.0, 8.4, 115.0, 1.0, 1.0)], precision=1500)), "a")) == [None]
    assert list(samples(device(), "a")) == []


def test_refused(tmp_path: Path) -> None:
    plain = write_video(tmp_path / "plain.mp4", 5)
    with pytest.raises(DataError, match=r"no GoPro data track.*data=video"):
        import_recordings(plain, tmp_path / "clips")
    with pytest.raises(DataError, match="no bag below"):
        import_recordings(tmp_path, tmp_path / "clips")
    (tmp_path / "a.txt").touch()
    with pytest.raises(DataError, match="neither a bag"):
        import_recordings(tmp_path / "a.txt", tmp_path / "clips")
    whole = device(gps5([(49.0, 8.4, 115.0, 5.0, 5.0)] * 4))
    quiet = write_gopro(tmp_path / "quiet.mp4", [device()] * 2, frames=5)
    with pytest.raises(ConfigError, match="topics"):
        import_recordings(quiet, tmp_path / "clips", ["/image"])
    assert "no speeds: the camera has no GPS receiver" in str(import_recordings(quiet, tmp_path / "clips"))
    broken = write_gopro(tmp_path / "broken.mp4", [whole, whole[:-30]], frames=5)
    with pytest.raises(DataError, match=r"broken\.mp4, telemetry at 1\.0 s.*damaged"):
        import_recordings(broken, tmp_path / "clips")
    assert len(import_recordings(broken, tmp_path / "clips", on_error="skip").failures) == 1
    assert importing.find_recordings(tmp_path) == ([], [broken, quiet])  # and not the clip made of one
    (tmp_path / "cut.mp4").write_bytes(quiet.read_bytes()[: quiet.stat().st_size // 2])
    with pytest.raises(DataError, match=r"cut\.mp4 is not a video that can be read"):
        import_recordings(tmp_path, tmp_path / "clips")
    assert len(import_recordings(tmp_path, tmp_path / "clips", on_error="skip").failures) == 2


@pytest.mark.parametrize("seed", range(40))
def test_damage_is_one_sentence(seed: int) -> None:
    random = np.random.default_rng(seed)
    payload = bytearray(device(gps5([(49.0, 8.4, 115.0, 5.0, 5.0)] * 4), gps9([(49, 8, 1, 7, 7, 89, 5, 1, 3)])))
    for place in random.integers(0, len(payload), 6):
        payload[place] = random.integers(0, 256)
    cut = bytes(payload[: random.integers(8, len(payload))])
    try:
        found = list(samples(cut, "a"))
    except DataError:
        with pytest.raises(DataError, match="damaged"):
            list(samples(cut, "a"))
    else:
        assert len(found) <= 4
