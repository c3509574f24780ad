"""The newest pictures of a connected camera or an address, even if the connection fails in between."""

from __future__ import annotations

import itertools
import re
import statistics
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import av
import cv2
from av.error import FFmpegError
from av.video.reformatter import VideoReformatter

from saunet.errors import DataError, one_of
from saunet.io.video import Deinterlacer, Picture, VideoFrame, to_rgb

SCHEMES = ("rtsp", "rtsps", "rtmp", "http", "https", "tcp", "udp")
"""Kinds of addresses that count as cameras."""
_WAITING = 1
"""Most waiting pictures; a newer one replaces the oldest. Each further one adds a frame of latency."""
_SILENCE = 5.0
"""Seconds without a picture after which a connection counts as lost."""
_PATIENCE = 60.0
"""Seconds after which a lost connection is given up."""
_DEVICE = re.compile(r"/dev/video\d+")
# A playlist may refer to the protocols that cameras use, but not to files.
_OPTIONS = {"protocol_whitelist": "rtsp,rtp,rtmp,http,https,httpproxy,tcp,tls,udp,crypto", "rtsp_transport": "tcp"}
_OPTIONS["analyzeduration"] = "1000000"  # microseconds


def live_source(source: object) -> int | str | None:
    """Return the camera's number, device or address that an input names; None if it names none."""
    if isinstance(source, int):
        return source
    if not isinstance(source, str | Path):
        return None
    text = str(source)
    if text.isdecimal() and not Path(text).exists():
        return int(text)
    if "://" in text:
        one_of(f"the kind of address of {_name(text)}", text.partition("://")[0].lower(), SCHEMES)
        return text
    return text if _DEVICE.fullmatch(text) else None


def live_title(source: int | str) -> str:
    """Return what to call a camera's results: nothing that may be secret."""
    if isinstance(source, int):
        return f"camera{source}"
    parts = urlsplit(source)
    return re.sub(r"\W+", "_", f"{parts.hostname or ''} {Path(parts.path).stem}").strip("_") or "camera"


def _name(source: int | str) -> str:
    """Return what to call a camera in messages: an address without its password and query."""
    if isinstance(source, int):
        return f"camera {source}"
    parts = urlsplit(source)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}" if parts.scheme else source


@dataclass(frozen=True, slots=True, eq=False)
class _Arrived:
    picture: Picture
    at: float


class CameraReader:
    """Frames of a camera or an address until it is stopped; times are those of arrival.

    A thread receives; only the newest picture waits. A lost connection is reopened.

    Attributes:
        fps: Frames per second, as far as known.
        height: Of the frames.
        width: Of the frames.
        dropped: Pictures that newer ones replaced before they were taken.
        lost: How often the connection was lost.
    """

    declared, timed, missing, dropped, lost = None, True, 0, 0, 0
    height: int
    width: int
    fps = 25.0
    _stopped = False
    _end: str | None = None
    _latencies: deque[float] | None = None

    def __init__(self, source: int | str) -> None:
        self.name = _name(source)
        self._source, self._waiting = source, deque[_Arrived](maxlen=_WAITING)
        self._arrival = threading.Condition()
        opened = self._opened()
        first = next(opened, None)
        if first is None:
            raise DataError(
                f"{self.name} gives no picture; check that it is connected and that no other program uses it"
            )
        self._waiting.append(first)
        self.height, self.width = first.picture.shape[:2]
        self._thread = threading.Thread(target=self._receive, args=(opened,), daemon=True)
        self._thread.start()

    def frames(self) -> Iterator[VideoFrame]:
        """Yield frames as they come; numbers count what is taken."""
        start: float | None = None
        for number in itertools.count():
            with self._arrival:
                while not self._waiting and self._end is None and not self._stopped:
                    self._arrival.wait(0.1)
                if self._stopped or not self._waiting:
                    return
                newest = self._waiting.popleft()
            start = newest.at if start is None else start
            if newest.picture.shape[:2] != (self.height, self.width):
                raise DataError(
                    f"{self.name} changes its size from {self.width}x{self.height} to "
                    f"{newest.picture.shape[1]}x{newest.picture.shape[0]} (width x height); set one size in the camera"
                )
            yield VideoFrame(number, newest.at - start, newest.picture, newest.at)

    def stop(self) -> None:
        """End `frames` after the one that is in work; safe in a signal handler."""
        self._stopped = True

    def close(self) -> None:
        """Release the camera."""
        self.stop()
        self._thread.join(1.0)  # enough to release a device; a network read may block until its timeout

    def answered(self, frame_arrived: float) -> str:
        """Take note that a picture's results are out, and return the latency in words."""
        if self._latencies is None:
            self._latencies = deque(maxlen=10_000)
        self._latencies.append(time.monotonic() - frame_arrived)
        return f"latency {1000 * self._latencies[-1]:.0f} ms"

    @property
    def notes(self) -> list[str]:
        """Notes about the recording, one sentence each."""
        found = list[str]()
        if self._latencies:
            usual, worst = statistics.median(self._latencies), max(self._latencies)
            found.append(f"latency from arrival to result: median {1000 * usual:.0f} ms, at most {1000 * worst:.0f} ms")
        if self.dropped:
            found.append(f"{self.dropped} frames arrived faster than prediction and were replaced by newer ones")
        if self.lost:
            found.append(f"the connection to {self.name} was lost and reopened {self.lost} times")
        return found

    @property
    def problems(self) -> list[str]:
        """What ended the recording, other than its user."""
        return [self._end] if self._end else []

    def _receive(self, opened: Iterator[_Arrived]) -> None:
        """Keep the newest pictures waiting, until it is stopped or the camera is gone for good."""
        last, wait = time.monotonic(), 0.25
        while not self._stopped:
            try:
                for arrived in opened:
                    last, wait = arrived.at, 0.25
                    with self._arrival:
                        self.dropped += len(self._waiting) == _WAITING
                        self._waiting.append(arrived)
                        self._arrival.notify()
            except DataError as error:
                self._end = str(error)
                return
            if time.monotonic() - last > _PATIENCE:
                self._end = (
                    f"{self.name} has given no picture for {_PATIENCE:.0f} seconds; what came before is complete"
                )
                return
            if wait == 0.25:
                self.lost += 1
            time.sleep(wait)
            wait, opened = min(2 * wait, 4.0), self._opened()

    def _opened(self) -> Iterator[_Arrived]:
        return self._streamed(self._source) if "://" in str(self._source) else self._captured()

    def _streamed(self, address: Any) -> Iterator[_Arrived]:
        """Yield what an address sends until the connection ends, however it ends."""
        try:
            with av.open(address, options=_OPTIONS, timeout=_SILENCE, metadata_errors="replace") as container:
                stream: Any = container.streams.best("video")
                if stream is None or stream.codec_context is None:
                    return
                if container.duration and container.duration > 0:
                    raise DataError(
                        f"{self.name} is a finished video, and reading it like a live camera would lose frames; "
                        "download it, and give the file"
                    )
                stream.thread_type = "SLICE"  # threads that work on several frames at once would delay them
                self.fps = float(stream.average_rate or stream.guessed_rate or self.fps)
                weave: Deinterlacer | None = None
                converter = VideoReformatter()
                for packet in container.demux(stream):
                    if self._stopped:
                        return
                    at = time.monotonic()
                    try:
                        frames = stream.decode(packet)
                    except FFmpegError:  # the next packet may be intact
                        continue
                    for frame in frames:
                        if weave is None and frame.interlaced_frame:
                            weave = Deinterlacer(stream)
                        for each in (frame,) if weave is None else weave.push(frame):
                            yield _Arrived(to_rgb(each, self.name, converter), at)
        except (FFmpegError, OSError):
            return

    def _captured(self) -> Iterator[_Arrived]:
        """Yield what a connected camera gives until it gives nothing."""
        capture: Any = cv2.VideoCapture(self._source)
        try:
            if 0 < (fps := capture.get(cv2.CAP_PROP_FPS)) < 1000:
                self.fps = float(fps)
            while capture.isOpened() and not self._stopped:
                done, frame = capture.read()
                if not done or frame is None:
                    return
                yield _Arrived(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), time.monotonic())
        finally:
            capture.release()
