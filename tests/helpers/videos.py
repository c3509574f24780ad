"""Small videos of any kind, written with PyAV; every frame carries its number as a bar code on its top edge."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
BITS = 8
PIXELS = {"libx264": "yuv420p", "libx265": "yuv420p", "mjpeg": "yuvj420p"}


def numbered(number: int, height: int = 96, width: int = 128, shift: int = 2) -> Picture:
    """Return a texture that moves by ``shift`` pixels a frame, with ``number`` in black and white blocks on top."""
    blocks = np.random.default_rng(0).integers(40, 216, (height // 8 + 1, 100, 3)).repeat(8, 0).repeat(8, 1)
    left = (number * shift) % 400
    picture = np.ascontiguousarray(blocks[:height, left : left + width]).astype(np.uint8)
    for bit in range(BITS):
        side = width // BITS
        picture[: height // 6, bit * side : (bit + 1) * side] = 255 * (number >> bit & 1)
    return picture


def number_of(picture: Picture) -> int:
    """Read the bar code back."""
    height, width = picture.shape[:2]
    row, side = height // 12, width // BITS
    return sum(int(picture[row, bit * side + side // 2].mean() > 128) << bit for bit in range(BITS))


def write_video(
    path: Path,
    pictures: Iterable[Picture] | int = 20,
    *,
    codec: str = "libx264",
    pixels: str | None = None,
    times: Sequence[float] | None = None,
    fps: int = 20,
    options: Mapping[str, str] | None = None,
    container: Mapping[str, str] | None = None,
    form: str | None = None,
    matrix: str = "ITU601",
    full_range: bool = False,
    rotation: int = 0,
    interlaced: bool = False,
    sound: float = 0.0,
    **tags: Any,
) -> Path:
    """Write a video.

    ``times`` are seconds of the frames (evenly spaced by default), ``tags`` are set on the codec context
    (``colorspace=1``), ``sound`` is the length in seconds of a silent sound track.
    """
    images = [numbered(number) for number in range(pictures)] if isinstance(pictures, int) else list(pictures)
    with av.open(str(path), "w", format=form, options=dict(container or {})) as out:
        stream: Any = out.add_stream(codec, rate=fps, options=dict(options or {}))
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixels or PIXELS.get(codec, "yuv420p")
        base = Fraction(1, fps) if times is None else Fraction(1, 1000)
        stream.codec_context.time_base = base
        for name, value in tags.items():
            setattr(stream.codec_context, name, value)
        if interlaced:
            stream.codec_context.flags |= 1 << 18 | 1 << 29  # interlaced DCT and motion estimation
        if rotation:
            stream.set_display_rotation(rotation)
        audio: Any = out.add_stream("aac" if path.suffix != ".webm" else "libopus", rate=48000) if sound else None
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, "rgb24").reformat(
                format=stream.pix_fmt,
                dst_colorspace=matrix,
                dst_color_range="JPEG" if full_range or "yuvj" in stream.pix_fmt else "MPEG",
            )
            frame.time_base = base
            frame.pts = number if times is None else round(times[number] * 1000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
        if audio is not None:
            for start in range(0, int(sound * 48000), 960):
                silence = av.AudioFrame.from_ndarray(np.zeros((1, 960), np.float32), format="fltp", layout="mono")
                silence.sample_rate, silence.pts = 48000, start
                out.mux(audio.encode(silence))
            out.mux(audio.encode(None))
    return path
