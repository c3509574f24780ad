"""A drive through a generated street as a recording: frames are rendered when first asked for, and kept."""

from __future__ import annotations

import functools
import hashlib
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.errors import ConfigError, DataError, one_of, positive
from saunet.io.atomic import replacing
from saunet.io.plain import read_arrays
from saunet.synthetic.render import Camera, cast
from saunet.synthetic.shade import shade
from saunet.synthetic.travel import Travel, pose, travel
from saunet.synthetic.world import KERB_HEIGHT, VERSION, World

F64 = NDArray[np.float64]
Frame = tuple[NDArray[np.uint8], NDArray[np.float32]]

FRAME_SECONDS = 0.1
"""Time between frames."""
MAX_DEPTH = 1000.0
"""Ground farther away than this counts as unknown, like the sky; meters."""
_HORIZON = 0.46  # height of the principal point over the image's


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything that decides a drive's pixels; see `SyntheticDrive`."""

    seed: int = 0
    frames: int = 60
    height: int = 64
    width: int = 192
    moving_cars: int = 0
    camera_height: float = 1.65
    focal: float = 0.58
    baseline: float = 0.54
    camera: Literal["left", "right"] = "left"

    def __post_init__(self) -> None:
        for name in ("frames", "height", "width", "focal", "baseline"):
            positive(name, getattr(self, name))
        for name in ("seed", "moving_cars"):
            positive(name, getattr(self, name), allow_zero=True)
        one_of("camera", self.camera, ("left", "right"))
        if self.camera_height < 3 * KERB_HEIGHT:
            raise ConfigError(f"camera_height is {self.camera_height} m; it must be at least {3 * KERB_HEIGHT:.2f} m")


class SyntheticDrive(Drive):
    """One camera's recording of a drive through a generated street.

    Args:
        seed: Which street and which drive through it; equal settings give equal bytes.
        frames: Number of frames, at 10 Hz.
        height: Pixels.
        width: Pixels.
        moving_cars: Number of cars that move, by turns ahead and oncoming.
        camera_height: Meters above the road.
        focal: Focal length over image width; 0.58 is KITTI's.
        baseline: Meters between the left and the right camera.
        camera: Which of the two cameras this is; the left one keeps to the lane.
        cache: Folder in which rendered drives are kept between runs; None keeps nothing.

    Raises:
        ConfigError: for a value that cannot be.
    """

    def __init__(
        self,
        seed: int = 0,
        frames: int = 60,
        height: int = 64,
        width: int = 192,
        moving_cars: int = 0,
        camera_height: float = 1.65,
        focal: float = 0.58,
        baseline: float = 0.54,
        camera: Literal["left", "right"] = "left",
        cache: Path | str | None = None,
    ) -> None:
        self.settings = Settings(seed, frames, height, width, moving_cars, camera_height, focal, baseline, camera)
        self._cache = None if cache is None else Path(cache)
        self._frames: dict[int, Frame] = {}

    @property
    def name(self) -> str:
        return f"synthetic/{self.settings.seed:06d} {self.settings.camera[0]}"

    @property
    def frame_size(self) -> tuple[int, int]:
        return self.settings.height, self.settings.width

    @property
    def camera_height(self) -> float:
        return self.settings.camera_height

    def time(self, index: int) -> float:
        return FRAME_SECONDS * index

    @property
    def fps(self) -> float:
        return 1 / FRAME_SECONDS

    def has_depth(self, index: int) -> bool:
        return True

    @property
    def indices(self) -> Sequence[int]:
        return range(self.settings.frames)

    @functools.cached_property
    def travel(self) -> Travel:
        """How the left camera moves."""
        return travel(self.settings.seed, self.settings.frames)

    @functools.cached_property
    def world(self) -> World:
        """The street."""
        length = float(self.travel.along[-1])
        return World(self.settings.seed, length, self.settings.moving_cars, self.travel.speed)

    def image(self, index: int) -> NDArray[np.uint8]:
        """Return the frame, h x w x 3, RGB."""
        return self._frame(index)[0]

    def depth(self, index: int) -> NDArray[np.float32]:
        """Return exact depth along the camera's axis, h x w, meters, 0 for the sky and beyond `MAX_DEPTH`."""
        return self._frame(index)[1]

    def intrinsics(self, index: int = 0) -> F64:
        """Return K, 3 x 3, in pixels (integer coordinates are pixel centers): square pixels, KITTI's field of view."""
        height, width = self.settings.height, self.settings.width
        focal = self.settings.focal * width
        center = ((width - 1) / 2, _HORIZON * (height - 1))
        return np.array([[focal, 0.0, center[0]], [0.0, focal, center[1]], [0.0, 0.0, 1.0]])

    def pose(self, index: int) -> F64:
        """Return T_world_cam, 4 x 4, meters (x right, y down, z forward); the road is the plane y = 0."""
        move, at = self.travel, self._checked(index)
        across = self.world.section.lane + float(move.wander[at])
        T_world_cam = pose(
            self.world.road, float(move.along[at]), across, float(move.yaw[at]), float(move.pitch[at]),
            self.settings.camera_height,
        )  # fmt: skip
        if self.settings.camera == "right":
            T_world_cam[:3, 3] += T_world_cam[:3, 0] * self.settings.baseline
        return T_world_cam

    def stereo(self) -> SyntheticDrive:
        """Return the other camera's recording of the same drive: always the same object, so it is rendered once."""
        return self._stereo

    @functools.cached_property
    def _stereo(self) -> SyntheticDrive:
        twin = self._seen_by("right" if self.settings.camera == "left" else "left")
        twin.__dict__["_stereo"] = self
        return twin

    @property
    def T_stereo_cam(self) -> F64:  # noqa: N802 (frames in names)
        """Where the other camera is, 4 x 4, meters: ``baseline`` to the side."""
        T = np.eye(4)
        T[0, 3] = -self.settings.baseline if self.settings.camera == "left" else self.settings.baseline
        return T

    def _seen_by(self, camera: str) -> SyntheticDrive:
        twin = SyntheticDrive(**{**asdict(self.settings), "camera": camera}, cache=self._cache)
        twin.__dict__.update({name: self.__dict__[name] for name in ("world", "travel") if name in self.__dict__})
        return twin

    @property
    def rendered(self) -> bool:
        """Whether all frames are in memory."""
        return len(self._frames) == self.settings.frames

    def render(self, progress: Callable[[], object] | None = None) -> None:
        """Render all frames that are not in memory yet, or read them from the cache folder."""
        if self._cache is not None and not self.rendered and self._stored.exists():
            self._load()
        for index in self.indices:
            self._frame(index)
            if progress is not None:
                progress()
        if self._cache is not None and not self._stored.exists():
            self._save()

    def _checked(self, index: int) -> int:
        if not 0 <= index < self.settings.frames:
            raise DataError(f"'{self.name}' has no frame {index}; it has 0 to {self.settings.frames - 1}")
        return index

    def _frame(self, index: int) -> Frame:
        if index not in self._frames:
            camera = Camera(
                self.intrinsics(), self.pose(self._checked(index)), self.settings.height, self.settings.width
            )
            polygons = self.world.polygons_at(index)
            hits = cast(self.world, polygons, camera)
            inverse = hits.inverse_depth[0]
            known = inverse > 1 / MAX_DEPTH
            depth = np.where(known, 1 / np.where(known, inverse, 1), 0).astype(np.float32)
            self._frames[index] = shade(self.world, polygons, camera, hits), depth
        return self._frames[index]

    @property
    def _stored(self) -> Path:
        assert self._cache is not None
        key = hashlib.sha256(repr((VERSION, astuple(self.settings))).encode()).hexdigest()[:20]
        return self._cache / f"{self.settings.seed:06d}_{self.settings.camera}_{key}.npz"

    def _load(self) -> None:
        path = self._stored
        try:
            stored = read_arrays(path)
            images, depths = stored["image"], stored["depth"]
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DataError(f"{path} is not a rendered drive ({error}); delete it to render it again") from error
        if images.shape[:3] != depths.shape or depths.shape[0] != self.settings.frames:
            raise DataError(f"{path} holds images {images.shape}, depth {depths.shape}; delete it to render it again")
        self._frames = dict(enumerate(zip(images, depths, strict=True)))

    def _save(self) -> None:
        """Keep all frames in the cache folder."""
        images = np.stack([self._frames[i][0] for i in self.indices])
        depths = np.stack([self._frames[i][1] for i in self.indices])
        with replacing(self._stored) as temporary, temporary.open("wb") as file:
            np.savez(file, image=images, depth=depths)
