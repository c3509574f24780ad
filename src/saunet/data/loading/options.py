"""Loader settings, which are the same for every data set: names, defaults and checks in one place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from typing_extensions import TypedDict

from saunet import schema
from saunet.errors import ConfigError, in_range, one_of, positive


@dataclass(frozen=True, kw_only=True)
class LoadOptions:
    """How frames become batches; every data module takes these settings as keywords.

    Args:
        height: Image height in pixels.
        width: Image width in pixels.
        offsets: Time offsets of the source frames.
        batch_size: Samples per step over all devices together.
        workers: Loader processes per device, at most one per core.
        crop_margin: Load training frames this much larger (0.1 = 10 %) and cut out a random window; K follows.
        flip_prob: Probability of mirroring in training.
        color_jitter_prob: Probability of color jitter in training.
        track_motion: Take the camera's motion from tracked points instead of the pose network, which learns from it
            through ``objective.extra.tracked_motion``; see `saunet.geometry.tracks.tracked_motion`.
        with_speed: Put the distance traveled between frames into batches, from speeds and times or from poses, for the
            velocity term.
        guess_camera: Start from a 60 degree field of view if the camera is unknown and its frames do not tell;
            otherwise such data are refused. ``model.intrinsics=learned`` sets it.
        seed: Seed of the order, the augmentation, and what is held out at random.
        manifest: File of frames to leave out of training and validation, written by ``saunet doctor``.
        on_error: What to do with an unreadable file: ``raise`` stops and names it; ``skip`` names and counts it and
            continues. Training then uses another sample; the frames of other splits are all read beforehand.

    Raises:
        ConfigError: if a value is out of range.
    """

    height: int = 192
    width: int = 640
    offsets: Sequence[int] = (-1, 1)
    batch_size: int = 12
    workers: int = 4
    crop_margin: float = 0.05
    flip_prob: float = 0.5
    color_jitter_prob: float = 0.5
    track_motion: bool = False
    with_speed: bool = False
    guess_camera: bool = False
    seed: int = 0
    manifest: str | None = None
    on_error: Literal["raise", "skip"] = "raise"

    def __post_init__(self) -> None:
        for name in ("height", "width", "batch_size"):
            positive(name, getattr(self, name))
        for name in ("workers", "seed"):
            positive(name, getattr(self, name), allow_zero=True)
        for name in ("crop_margin", "flip_prob", "color_jitter_prob"):
            in_range(name, getattr(self, name), 0, 1)
        one_of("on_error", self.on_error, ("raise", "skip"))
        check_offsets(self.offsets)


class Loading(TypedDict, total=False):
    """The fields of `LoadOptions`, for signatures: ``**loading: Unpack[Loading]``."""

    height: int
    width: int
    offsets: Sequence[int]
    batch_size: int
    workers: int
    crop_margin: float
    flip_prob: float
    color_jitter_prob: float
    track_motion: bool
    with_speed: bool
    guess_camera: bool
    seed: int
    manifest: str | None
    on_error: Literal["raise", "skip"]


schema.unpacked(Loading, LoadOptions)


def check_offsets(offsets: Sequence[int]) -> None:
    if 0 in offsets or len(set(offsets)) != len(offsets):
        raise ConfigError(f"offsets are {list(offsets)}; they must be distinct and not 0, such as [-1, 1]")
