"""Reading and writing videos: frames in display order, with their times, colors and rotation."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import VideoReformatter
from jaxtyping import UInt8

from saunet.errors import ConfigError, DataError, UnreadableError, one_of, positive
from saunet.io.atomic import Session, replacing
from saunet.io.times import times_file, video_times

_CONTAINERS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".ts", ".mts", ".m2ts", ".3gp")
_OTHERS = (".3g2", ".flv", ".vob", ".lrv", ".ogv")
BARE_SUFFIXES = frozenset((".h264", ".264", ".h265", ".265", ".hevc", ".mjpg", ".mjpeg"))
"""File name endings of bare streams, which may not state their rate."""
VIDEO_SUFFIXES = BARE_SUFFIXES.union(_CONTAINERS, _OTHERS)
"""File name endings that are taken for videos."""

CODECS: dict[str, tuple[str, dict[str, str]]] = {
    "h264": ("libx264", {"preset": "veryfast", "crf": "18"}),
    "mp4v": ("mpeg4", {"qmin": "3", "qmax": "6"}),
    "vp09": ("libvpx-vp9", {"crf": "24", "b": "0", "deadline": "realtime", "cpu-used": "6"}),
}
"""What a video can be written as: ``h264`` plays everywhere; ``mp4v`` is quickest; ``vp09`` is free of patents."""

Picture = UInt8[np.ndarray, "_ _ 3"]
_RAW = frozenset({"h264", "hevc", "vvc", "obu", "m4v", "mpegvideo", "mjpeg", "h263", "vc1"})
"""Formats of bare frames: what FFmpeg says of their rate and times is a guess."""
_INDEXED = ("mov", "avi")
"""Formats whose mean rate is counted, not rounded or guessed."""
_TICKS = 90_000
"""Ticks a second of the videos that are written: divides all usual rates."""


@dataclass(frozen=True, slots=True, eq=False)
class VideoFrame:
    """One frame of a video."""

    number: int
    """From 0, as recorded."""
    time: float | None
    """Seconds since the first frame; None if unknown."""
    image: Picture
    arrived: float | None = None
    """When it came from a live camera, on the monotonic clock."""


class VideoReader(Session):
    """Frames of a video file as RGB bytes, as a player shows them: in order, rotated, deinterlaced, in true colors.

    Their times are those of ``NAME.times.csv`` beside the file, if there is one, else its own.

    Iterating reads from the start each time; one frame is in memory at a time. ``rate`` is for a bare stream
    (``.hevc``, ``.h264``) that does not contain its own. Frames wider than ``max_width`` shrink to it while their
    colors are converted, which takes half the time of shrinking them after.

    Attributes:
        fps: Mean frames per second; None if unknown.
        declared: Number of frames as the file states it, or estimated from its duration; None if unknown.
        height: Height of the frames, after rotation and shrinking.
        width: Width of the frames, after rotation and shrinking.
        origin: Time stamp of the first frame in the file, in seconds; 0 if it has none.
        missing: After reading to the end: number of frames missing from a truncated file.
        damaged: After reading to the end: number of frames decoded only in part or not at all.
        plain: After reading to the end: number of frames in one single color.
        count: Frames decoded since the start of the last reading.
    """

    def __init__(self, source: str | Path, rate: float | int | None = None, max_width: int | None = None) -> None:
        self.path, self.name, self._max_width = Path(source), str(source), max_width
        if not self.path.is_file():
            raise DataError(f"no video at {source}; check the path")
        if self.path.stat().st_size == 0:
            raise UnreadableError(f"{source} is empty (0 bytes); copy it again")
        self.missing = self.damaged = self.plain = self.count = 0
        self._broken, self._converter = False, VideoReformatter()
        with self._opened() as (container, stream):
            first = next(self._decoded(container, stream), None)
            if first is None:
                raise UnreadableError(
                    f"{self.name} has no frame that can be decoded; it may be truncated or have an unusual codec"
                )
            self.height, self.width = self._picture(first).shape[:2]
            self._timed = container.format.name not in _RAW and first.time is not None
            self.origin = float(first.time) if self._timed else 0.0
            mean, usual = self._rates(container, stream)
            self.fps, self._pace = mean or rate, usual or rate
            self.declared = self._count(container, stream)
        self._times = video_times(self.path)
        if self._times is not None and len(self._times) > 1:
            self.fps, self._pace = (float(1 / of(np.diff(self._times))) for of in (np.mean, np.median))

    def __iter__(self) -> Iterator[Picture]:
        return (frame.image for frame in self.frames())

    @property
    def timed(self) -> bool:
        """Whether frames have times."""
        return self._timed or self._times is not None or self.fps is not None

    def frames(self, fps: float | int | None = None) -> Iterator[VideoFrame]:
        """Yield frames with their times: all, or those nearest to equal steps of time, ``fps`` of them per second."""
        stamped = self._stamped()
        if fps is not None and self._pace is not None and fps < self._pace * (1 - 1e-3):
            stamped = nearest_steps(stamped, positive("fps", fps))
        for number, seconds, frame in stamped:
            image = self._picture(frame)
            if image.shape[:2] != (self.height, self.width):
                raise DataError(
                    f"{self.name} changes its size from {self.width}x{self.height} to "
                    f"{image.shape[1]}x{image.shape[0]} (width x height) at frame {number}; all frames must have one "
                    "size, so split the file there"
                )
            self.plain += _one_color(image)
            yield VideoFrame(number, seconds, image)

    def close(self) -> None:
        """Nothing is held open between two iterations."""

    def _picture(self, frame: Any) -> Picture:
        return to_rgb(frame, self.name, self._converter, self._max_width)

    @contextlib.contextmanager
    def _opened(self) -> Iterator[tuple[Any, Any]]:
        """Open the file anew, as container and stream; what FFmpeg cannot read is one sentence."""
        try:
            # "file:" keeps names with colons from being taken for addresses; playlists must not open others either
            options = {"protocol_whitelist": "file"}
            with av.open(f"file:{self.path}", options=options, metadata_errors="replace") as container:
                stream: Any = container.streams.best("video")  # not an embedded cover picture
                if stream is None:
                    raise UnreadableError(f"{self.name} contains no video, only sound or text")
                if stream.codec_context is None:
                    raise UnreadableError(f"{self.name} has a codec that cannot be decoded; convert it to H.264")
                stream.thread_type = "AUTO"
                yield container, stream
        except FFmpegError as reason:
            if isinstance(reason, PermissionError):
                raise UnreadableError(f"cannot read {self.name}: {reason.strerror}") from reason
            raise UnreadableError(
                f"{self.name} is not a video that can be read, or is truncated; copy it again or convert it to mp4"
            ) from reason

    def _decoded(self, container: Any, stream: Any) -> Iterator[Any]:
        """Yield decoded frames, deinterlaced where they are interlaced."""
        weave: Deinterlacer | None = None
        for packet in _packets(container, stream):
            self._broken |= packet is None
            try:
                frames = stream.decode(packet)
            except FFmpegError:
                self.damaged += 1
                continue
            for frame in frames:
                self.damaged += frame.is_corrupt
                if weave is None and frame.interlaced_frame:
                    weave = Deinterlacer(stream)
                yield from (frame,) if weave is None else weave.push(frame)
        if weave is not None:
            yield from weave.push(None)

    def _stamped(self) -> Iterator[tuple[int, float | None, Any]]:
        """Yield all frames with number and time; a clock that jumps back continues where it was."""
        self.missing = self.damaged = self.plain = self.count = 0
        self._broken = False
        step, shift, last = 1 / (self.fps or 25), -self.origin, -math.inf
        with self._opened() as (container, stream):
            for number, frame in enumerate(self._decoded(container, stream)):
                self.count = number + 1
                if self._times is not None:
                    if number >= len(self._times):
                        raise DataError(
                            f"{times_file(self.path)} has the times of {len(self._times)} frames, but {self.name} "
                            "has more; add the others"
                        )
                    yield number, self._times[number], frame
                    continue
                if not self._timed:
                    yield number, number / self.fps if self.fps else None, frame
                    continue
                seconds = last + step if frame.time is None else float(frame.time) + shift
                if seconds <= last:
                    shift, seconds = shift + last + step - seconds, last + step
                last = seconds
                yield number, seconds, frame
        if self.plain and self.plain == self.count:
            raise DataError(
                f"every one of the {self.plain} frames of {self.name} has one single color; it was not decoded, or "
                "the camera was covered; convert it to H.264 and check it"
            )
        if self._broken or _truncated(self.path):
            self.missing = max(1, (self.declared or 0) - self.count)
        elif self._times is not None and self.count < len(self._times):
            raise DataError(
                f"{times_file(self.path)} has the times of {len(self._times)} frames, but {self.name} has only "
                f"{self.count}; check whether the table belongs to another video"
            )

    def _rates(self, container: Any, stream: Any) -> tuple[float | None, float | None]:
        """Return the mean rate, and the usual one: that of the median step between the first frames."""
        if not self._timed:
            rate = stream.codec_context.framerate
            known = float(rate) if rate and 0 < rate < 1000 else None
            return known, known
        with self._opened() as again:
            packets = itertools.islice((packet for packet in _packets(*again) if packet is not None), 300)
            stamps = sorted({packet.pts for packet in packets if packet.pts is not None})
        # Packets come in decoding order, so that some of the last stamps may be missing.
        stamps = stamps[:-16] if len(stamps) > 200 else stamps
        steps = np.diff(stamps) * float(stream.time_base)
        average = float(stream.average_rate or 0) or None
        mean, usual = (float(1 / np.mean(steps)), float(1 / np.median(steps))) if len(steps) else (average, average)
        return average if average and container.format.name.startswith(_INDEXED) else mean, usual

    def _count(self, container: Any, stream: Any) -> int | None:
        if stream.frames > 0:
            return int(stream.frames)
        lasts = float(stream.duration * stream.time_base) if stream.duration else (container.duration or 0) / 1e6
        return round(lasts * self.fps) or None if self.fps and self._timed else None


def nearest_steps(
    frames: Iterable[tuple[int, float | None, Any]], fps: float | int
) -> Iterator[tuple[int, float | None, Any]]:
    """Yield those of (number, seconds, frame) that are nearest to equal steps of time, each at most once."""
    previous: tuple[int, float, Any] | None = None
    start, step, half = 0.0, 0, 0.0
    for number, seconds, frame in frames:
        if seconds is None:
            raise DataError("frames without times cannot be chosen by time; give the rate of the stream")
        if previous is None:
            start = seconds
        else:
            half = (seconds - previous[1]) / 2
            reached = (previous[1] + half - start) * fps - 1e-6  # in steps of 1/fps; of equally near ones, the later
            if step < reached:
                yield previous
                step = math.ceil(reached)
        previous = (number, seconds, frame)
    if previous is not None and (step == 0 or step < (previous[1] + half - start) * fps - 1e-6):
        yield previous


class VideoWriter(Session):
    """Writes RGB frames to an mp4 file that gets its name only when complete.

    Use it as a context manager; an error discards the file.
    """

    def __init__(self, path: str | Path, fps: float | int, codec: str = "h264") -> None:
        self.path = Path(path)
        one_of(f"the suffix of {self.path.name}", self.path.suffix.lower(), [".mp4"])
        self.fps, self.codec = positive("fps", fps), one_of("codec", codec, CODECS)
        self.count, self._last, self._size = 0, -1, (0, 0)
        self._container: Any = None

    def session(self) -> Iterator[None]:
        with replacing(self.path) as self._temporary:
            try:
                yield
                if self._container is not None:
                    self._container.mux(self._stream.encode(None))
            finally:
                if self._container is not None:
                    self._container.close()
            self._check()

    def write(self, frame: Picture, seconds: float | int | None = None) -> None:
        """Append a frame, shown from ``seconds`` on; all have the size of the first, made even as codecs need it."""
        if self._container is None:
            self._size = (frame.shape[0], frame.shape[1])
            self._start()
        if frame.shape[:2] != self._size:
            raise DataError(
                f"frame {self.count} is {frame.shape[:2]} (height, width), the ones before it are {self._size}"
            )
        pad = ((0, self._size[0] % 2), (0, self._size[1] % 2), (0, 0))
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(np.pad(frame, pad, mode="edge")), "rgb24")
        # Setting the tags converts nothing, so the values are converted to match them.
        picture = picture.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        ticks = round((self.count / self.fps if seconds is None else seconds) * _TICKS)
        self._last = picture.pts = max(ticks, self._last + 1)
        picture.time_base = Fraction(1, _TICKS)
        self._container.mux(self._stream.encode(picture))
        self.count += 1

    def _start(self) -> None:
        name, options = CODECS[self.codec]
        try:
            av.Codec(name, "w")
        except ValueError as reason:
            raise ConfigError(
                f"codec is {self.codec}, which this PyAV cannot write to {self.path}; set codec=mp4v"
            ) from reason
        self._container = av.open(f"file:{self._temporary}", "w", format="mp4", options={"movflags": "+faststart"})
        rate = Fraction(self.fps).limit_denominator(1001)
        self._stream: Any = self._container.add_stream(name, rate=max(rate, Fraction(1, 1001)), options=options)
        self._stream.height, self._stream.width = (side + side % 2 for side in self._size)
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.time_base = Fraction(1, 30_000 if self.codec == "mp4v" else _TICKS)
        context.colorspace = context.color_primaries = context.color_trc = 1  # BT.709
        context.color_range = 1  # limited (TV) range, 16 to 235

    def _check(self) -> None:
        if self.count == 0:
            raise DataError(f"no frame was given, so {self.path} was not written")
        try:
            with av.open(f"file:{self._temporary}") as container:
                kept = sum(1 for _ in _packets(container, container.streams.video[0])) - 1
        except FFmpegError:
            kept = 0
        if kept != self.count:
            raise DataError(f"{self.path} kept {kept} of {self.count} frames, so it was discarded; is the disk full?")


class Deinterlacer:
    """FFmpeg's yadif: one frame out for each one in; frames that are not interlaced pass unchanged."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._graph: Any = None
        self._key: object = None

    def push(self, frame: Any) -> Iterator[Any]:
        """Take a frame, None at the end, and yield those that are ready."""
        key = frame and (frame.format.name, frame.width, frame.height)
        if self._graph is not None and key != self._key:
            self._graph.push(None)
            yield from self._ready()
            self._graph = None
        if frame is None:
            return
        if self._graph is None:
            self._graph, self._key = av.filter.Graph(), key
            source = self._graph.add_buffer(
                width=frame.width, height=frame.height, format=frame.format, time_base=self._stream.time_base
            )
            yadif = self._graph.add("yadif", "mode=send_frame:deint=interlaced")
            source.link_to(yadif)
            yadif.link_to(self._graph.add("buffersink"))
            self._graph.configure()
        self._graph.push(frame)
        yield from self._ready()

    def _ready(self) -> Iterator[Any]:
        while True:
            try:
                yield self._graph.pull()
            except (av.error.BlockingIOError, av.error.EOFError):
                return


def _packets(container: Any, stream: Any) -> Iterator[Any]:
    """Yield a stream's packets, last an empty one, which flushes; None instead where the file cannot be read on."""
    try:
        yield from container.demux(stream)
    except FFmpegError:
        yield None


def to_rgb(frame: Any, name: str, converter: VideoReformatter, max_width: int | None = None) -> Picture:
    """Convert by the frame's own tags of matrix and range, and turn it as its display matrix says.

    One converter serves all frames; a frame's own would be set up, with its threads, for each. Pictures wider than
    ``max_width`` shrink to it; FFmpeg's linear filter then spans as many pixels as one pixel of the result covers.
    """
    turns = round(frame.rotation / 90) % 4  # counter-clockwise, as NumPy's
    height, width = frame.height, frame.width
    across = height if turns % 2 else width
    if max_width is not None and across > max_width:
        height, width = (round(side * max_width / across) for side in (height, width))
    try:
        image = converter.reformat(
            frame, width=width, height=height, format="rgb24", interpolation="BILINEAR"
        ).to_ndarray()
    except (FFmpegError, ValueError) as reason:
        raise UnreadableError(
            f"{name} has pixels of format {frame.format.name}, which cannot be converted to RGB; convert it to H.264"
        ) from reason
    return np.ascontiguousarray(np.rot90(image, turns)) if turns else image


def _one_color(image: Picture) -> bool:
    few = image[::16, ::16]
    return bool((few == few[0, 0]).all() and (image == image[0, 0]).all())


def _truncated(path: Path) -> bool:
    """Return whether a file is shorter than its outermost chunks say (MP4, AVI, Matroska); other formats do not say."""
    at, size = 0, path.stat().st_size
    with path.open("rb") as file:
        while at < size:
            file.seek(at)
            length = _chunk_length(file.read(16))
            if length is None:
                return False
            at += length
    return at > size


_BOXES = (b"ftyp", b"moov", b"mdat", b"moof", b"free", b"skip", b"wide", b"mfra", b"sidx", b"styp", b"uuid", b"meta")


def _chunk_length(head: bytes) -> int | None:
    """Return the bytes of the chunk that starts so; None if it does not say, or is of no known kind."""
    if len(head) < 16:
        return None
    if head[:4] == b"RIFF":
        return 8 + int.from_bytes(head[4:8], "little") if any(head[4:8]) else None
    if head[:4] in (b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"):  # EBML header, Matroska segment
        count = 9 - head[4].bit_length()  # leading zeros tell how many bytes the length has
        value = int.from_bytes(head[4 : 4 + count], "big") - (1 << 7 * count)
        return None if count > 8 or value == (1 << 7 * count) - 1 else 4 + count + value
    if head[4:8] in _BOXES:
        length = int.from_bytes(head[:4], "big")
        return int.from_bytes(head[8:], "big") if length == 1 else length or None
    return None
