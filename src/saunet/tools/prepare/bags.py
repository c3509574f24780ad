"""Bags of ROS 1 and 2 and MCAP files as clips: pictures named by their time stamps, the camera, and speeds.

Messages are read once, in order, one at a time. A picture's file appears only when complete and is not made again, so
an interrupted import resumes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.data.video.calibrations import FILE_NAME
from saunet.data.video.camera import read_camera, write_camera
from saunet.data.video.clips import QUALITY
from saunet.data.video.drive import SPEEDS
from saunet.errors import ConfigError, DataError, one_of
from saunet.io.atomic import remove_partial_files, write_bytes, write_json
from saunet.io.images import encode_jpeg
from saunet.io.plain import read_json
from saunet.io.progress import bar
from saunet.io.speeds import write_speeds
from saunet.tools.prepare.gopro import RECORD
from saunet.tools.prepare.pool import OnError

Rows = list[tuple[float, ...]]
_RAW, _COMPRESSED, _INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
}
"""Encoding of a raw image -> bytes per pixel, and OpenCV's conversion to RGB."""
_NOT_COLOR = ("16UC1", "32FC1", "mono16")
"""Encodings of depth and the like; such topics are not clips."""
_NO_CLIP = "not color images"


@dataclass
class BagClip:
    """One image topic of a bag."""

    topic: str
    home: Path
    state: dict[str, Any]
    made: int = 0
    before: int = 0
    failed: int = 0
    about: list[str] = field(default_factory=list)
    info: str = ""
    """The camera's first CameraInfo, as YAML."""
    names: set[str] = field(default_factory=set)

    def __str__(self) -> str:
        return f"{self.home}: {', '.join([f'{self.made + self.before} frames', *self.about])}"


class Bag:
    """One bag, whose topics become clips."""

    def __init__(self, path: Path, folder: Path, topics: Sequence[str], on_error: OnError, failures: list[str]) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ModuleNotFoundError as reason:
            raise ConfigError("bags are read with rosbags; install it: pip install 'saunet[bags]'") from reason
        self.path, self.folder, self.wanted, self.on_error, self.failures = path, folder, topics, on_error, failures
        store = get_typestore(Stores.ROS2_HUMBLE)  # for older bags, which do not define their messages
        self._reader: Any = _read(path, lambda: AnyReader([path], default_typestore=store))

    def clips(self) -> list[BagClip]:
        _read(self.path, self._reader.open)
        try:
            clips = self._claim()
            if any(clip.state.get("frames") is None for clip in clips):
                self._run(clips)
            return clips
        finally:
            self._reader.close()

    def _claim(self) -> list[BagClip]:
        """Return the clips to make; folders of another version of the bag are refused."""
        images = sorted({c.topic for c in self._reader.connections if c.msgtype in (_RAW, _COMPRESSED)})
        for topic in self.wanted:
            one_of("topics", topic, images)
        facts = max((self.path.rglob("*") if self.path.is_dir() else [self.path]), key=lambda each: each.stat().st_size)
        now = {"bag": self.path.name, "bytes": facts.stat().st_size, "changed": facts.stat().st_mtime_ns}
        clips = []
        for topic in self.wanted or [each for each in images if not each.endswith("compressedDepth")]:
            home = self.folder / self.path.stem / (topic.strip("/").replace("/", "_") or "images")
            remove_partial_files(home, ".*.partial*")
            clip = BagClip(topic, home, {**now, "topic": topic, "frames": None})
            if (home / RECORD).is_file():
                known = read_json(home / RECORD)
                if not isinstance(known, dict) or {**known, "frames": None} != clip.state:
                    raise DataError(f"{home} was imported from another version of {self.path}; delete it first")
                clip.state = known
                clip.before = known["frames"] or 0
                clip.about += [_NO_CLIP] if known["frames"] == 0 else []
            elif home.is_dir() and any(home.iterdir()):
                raise DataError(f"{home} holds other files; choose another folder")
            clips.append(clip)
        if not clips:
            raise DataError(f"{self.path} has no image topic; it has: {', '.join(sorted(self._reader.topics))[:300]}")
        return clips

    def _run(self, clips: Sequence[BagClip]) -> None:
        open_ = {clip.topic: clip for clip in clips if clip.state["frames"] is None}
        infos, speeds = dict[str, Any](), dict[tuple[int, str], Rows]()
        kinds = {_RAW, _COMPRESSED, _INFO, *_SPEEDS}
        chosen = [
            each
            for each in self._reader.connections
            if each.msgtype in kinds and (each.topic in open_ or each.msgtype not in (_RAW, _COMPRESSED))
        ]
        with bar() as shown:
            task = shown.add_task(f"importing {self.path.name}", total=sum(each.msgcount for each in chosen))
            for connection, received, data in self._messages(chosen):
                shown.advance(task)
                kind, topic = connection.msgtype, connection.topic
                if kind == _INFO and topic in infos:
                    continue
                try:
                    message = _read(self.path, lambda: self._reader.deserialize(data, kind))  # noqa: B023
                    stamp = _stamp(message, received)
                    if kind == _INFO:
                        infos[topic] = message
                    elif kind in _SPEEDS:
                        order, _, rows_of = _SPEEDS[kind]
                        speeds.setdefault((order, topic), []).append((stamp / 1e9, *rows_of(message)))
                    else:
                        self._keep(open_[topic], stamp, message)
                except DataError as error:
                    if self.on_error == "raise":
                        raise
                    self.failures.append(f"{topic} at {received}: {error}")
                    if topic in open_:
                        open_[topic].failed += 1
        found = _speed_of(speeds)
        for clip in open_.values():
            self._finish(clip, infos, found)

    def _messages(self, chosen: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
        left = self._reader.messages(connections=chosen)
        end = object()
        while (each := _read(self.path, lambda: next(left, end))) is not end:
            yield each

    def _keep(self, clip: BagClip, stamp: int, message: Any) -> None:
        """Write a picture unless it exists; before the first, record which bag the folder belongs to."""
        name = str(stamp) if stamp >= 10**18 else f"{stamp // 10**9}.{stamp % 10**9:09d}"
        if name in clip.names:
            return
        for suffix in (".jpg", ".png"):
            if (clip.home / f"{name}{suffix}").is_file():
                clip.before += 1
                clip.names.add(name)
                return
        data, suffix = _picture(message, f"{self.path}, {clip.topic}")
        if data:
            if not (clip.home / RECORD).is_file():
                write_json(clip.home / RECORD, clip.state)
            write_bytes(clip.home / f"{name}{suffix}", data)
            clip.made += 1
            clip.names.add(name)

    def _finish(self, clip: BagClip, infos: dict[str, Any], speeds: tuple[str, Rows] | None) -> None:
        if not clip.names:
            clip.about.append("no frame that can be read" if clip.failed else _NO_CLIP)
            if not clip.failed:
                write_json(clip.home / RECORD, {**clip.state, "frames": 0})  # so it is not read again
            return
        space = clip.topic.removesuffix("/compressed").rpartition("/")[0]
        name = next((each for each in infos if each.rpartition("/")[0] == space), None)
        if name is not None:
            info, file = infos[name], clip.home / "camera_info.yaml"
            write_bytes(file, _info_text(info).encode())
            rectified = "rect" in clip.topic.removesuffix("/compressed").rpartition("/")[2]
            camera = read_camera(f"{file}:rect" if rectified else file)
            write_camera(clip.home / FILE_NAME, camera, f"saunet prepare import: {name} of {self.path.name}")
        clip.about.append(f"camera from {name}" if name else f"no CameraInfo: add {FILE_NAME}, or set camera=FILE")
        if speeds is not None:
            write_speeds(clip.home / SPEEDS, ("time", "speed"), speeds[1])
        clip.about.append(f"speeds from {speeds[0]}" if speeds else "no speeds")
        write_json(clip.home / RECORD, {**clip.state, "frames": len(clip.names)})


def _read(path: Path, action: Callable[[], Any]) -> Any:
    """Turn any exception from inside the library, raised for a damaged bag, into one sentence."""
    try:
        return action()
    except Exception as reason:
        text = str(reason).splitlines()[0][:150] if str(reason) else type(reason).__name__
        raise DataError(f"reading the bag {path} failed ({text}); copy it again, or reindex it") from reason


def _stamp(message: Any, received: int) -> int:
    """Return the time of a message's measurement in ns; if it has none, the time of its recording."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec) or received


def _picture(message: Any, name: str) -> tuple[bytes, str]:
    """Return an image message as a file's bytes and suffix: compressed ones unchanged, None for depth maps."""
    if hasattr(message, "format"):
        data = bytes(message.data)
        for magic, suffix in ((b"\xff\xd8\xff", ".jpg"), (b"\x89PNG\r\n\x1a\n", ".png")):
            if data.startswith(magic):
                return data, suffix
        raise DataError(f"{name} holds images of format '{message.format[:40]}'; JPEG and PNG can be read")
    image = rgb_of(message, name)
    return (b"", "") if image is None else (encode_jpeg(image, QUALITY), ".jpg")


def rgb_of(message: Any, name: str) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return the RGB picture of a raw image message of ROS 1 or 2; None for a depth map. ``name`` is the topic's."""
    encoding, height, width = message.encoding, int(message.height), int(message.width)
    if encoding in _NOT_COLOR:
        return None
    if encoding not in _ENCODINGS:
        raise DataError(f"{name} holds images of encoding '{encoding[:40]}'; allowed: {', '.join(_ENCODINGS)}")
    size, conversion = _ENCODINGS[encoding]
    step, flat = int(message.step), np.frombuffer(message.data, np.uint8)
    if step < size * width or flat.size < step * height or min(height, width) < 1:
        raise DataError(f"{name} has an image of {width}x{height} with {flat.size} bytes in rows of {step}")
    rows = flat[: step * height].reshape(height, step)[:, : size * width]
    pixels = np.ascontiguousarray(rows.reshape(height, width, size) if size > 1 else rows)
    image: Any = pixels if conversion is None else cv2.cvtColor(pixels, conversion)
    return image  # type: ignore[no-any-return]


def _info_text(info: Any) -> str:
    """Return a CameraInfo as ``rostopic echo`` prints it; ROS 1 spells K, ROS 2 k."""
    lines = [f"height: {info.height}", f"width: {info.width}", f"distortion_model: {info.distortion_model}"]
    for key in "DKRP":
        numbers = getattr(info, key, None)
        numbers = getattr(info, key.lower()) if numbers is None else numbers
        lines.append(f"{key}: [{', '.join(repr(float(each)) for each in numbers)}]")
    return "\n".join(lines) + "\n"


def _length(vector: Any) -> float:
    return float(np.linalg.norm([vector.x, vector.y, vector.z]))


def _odometry(message: Any) -> tuple[float, ...]:
    at = message.pose.pose.position
    return _length(message.twist.twist.linear), at.x, at.y, at.z


def _fix(message: Any) -> tuple[float, ...]:
    known = message.status.status >= 0
    return tuple(float(each) if known else np.nan for each in (message.latitude, message.longitude, message.altitude))


_SPEEDS: dict[str, tuple[int, str, Callable[[Any], tuple[float, ...]]]] = {
    "geometry_msgs/msg/TwistWithCovarianceStamped": (0, "twist", lambda each: (_length(each.twist.twist.linear),)),
    "geometry_msgs/msg/TwistStamped": (0, "twist", lambda each: (_length(each.twist.linear),)),
    "nav_msgs/msg/Odometry": (1, "odometry", _odometry),
    "sensor_msgs/msg/NavSatFix": (2, "positions", _fix),
}
"""Kind of message -> its priority, its description, and its numbers."""


def _speed_of(found: dict[tuple[int, str], Rows]) -> tuple[str, Rows] | None:
    """Return the topic and rows of (seconds, m/s) of the best source of speeds; None if there is none."""
    for (order, topic), rows in sorted(found.items(), key=lambda each: (each[0][0], -len(each[1]))):
        table = np.array(sorted(rows), dtype=np.float64)
        table = table[np.isfinite(table).all(1)]
        table = table[np.append(np.diff(table[:, 0]) > 0, True)] if len(table) else table
        if len(table) < 2:
            continue
        times, speeds = table[:, 0], table[:, 1]
        if order == 1 and not speeds.any():  # a visual odometry without a twist
            speeds = _differences(times, table[:, 2:])
        elif order == 2:
            speeds = _differences(times, _local(table[:, 1:]))
        return topic, [(float(f"{t:.9f}"), float(f"{v:.6g}")) for t, v in zip(times, speeds, strict=True)]
    return None


def _differences(times: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return speeds from differences of positions over a second around each time."""
    low, high = np.maximum(times - 0.5, times[0]), np.minimum(times + 0.5, times[-1])
    steps = [np.interp(high, times, each) - np.interp(low, times, each) for each in places.T]
    return np.asarray(np.linalg.norm(steps, axis=0) / (high - low))


def _local(fixes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return meters north, east and up from latitudes, longitudes (degrees) and heights, with WGS 84's local radii."""
    squared, sine = 6.69437999014e-3, np.sin(np.radians(fixes[0, 0]))
    east = 6378137.0 / np.sqrt(1 - squared * sine**2)
    north = east * (1 - squared) / (1 - squared * sine**2)
    turned = np.radians(fixes[:, :2] - fixes[0, :2])
    return np.stack([north * turned[:, 0], east * np.sqrt(1 - sine**2) * turned[:, 1], fixes[:, 2]], axis=1)
