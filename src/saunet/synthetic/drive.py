"""A drive through a generated street as a recording: frames are rendered when first asked for, and kept."""

from __future__ import annotations

import functools
import hashlib
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
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
from saunet.synthetic.world import KERB_HEIGHT, VERSION, Travel, World, pose, travel

F64 = NDArray[np.float64]
Frame = tuple[NDArray[np.uint8], NDArray[np.float32]]

FRAME_SECONDS = 0.1
MAX_DEPTH = 1000.0
"""Ground farther away than this counts as unknown, like the sky; meters."""
_HORIZON = 0.46  # row of the principal point, as a fraction of the image's height


@dataclass(eq=False)
class SyntheticDrive(Drive):
    """One camera's recording of a drive through a generated street, at 10 Hz; the road is the plane y = 0.

    Depth is exact, and 0 for the sky and beyond `MAX_DEPTH`. Equal settings give equal bytes.
    """

    seed: int = 0
    """Which street and which drive through it."""
    frames: int = 60
    height: int = 64
    width: int = 192
    moving_cars: int = 0
    """Number of cars that move, by turns ahead and oncoming."""
    camera_height: float = 1.65
    focal: float = 0.58
    """Focal length over image width; 0.58 is KITTI's."""
    baseline: float = 0.54
    """Meters between the left and the right camera."""
    camera: Literal["left", "right"] = "left"
    """Which of the two cameras this is; the left one keeps to the lane."""
    cache: Path | str | None = None
    """Folder in which rendered drives are kept between runs; None keeps nothing."""
    _frames: dict[int, Frame] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("frames", "height", "width", "focal", "baseline"):
            positive(name, getattr(self, name))
        for name in ("seed", "moving_cars"):
            positive(name, getattr(self, name), allow_zero=True)
        one_of("camera", self.camera, ("left", "right"))
        if self.camera_height < 3 * KERB_HEIGHT:
            raise ConfigError(f"camera_height is {self.camera_height} m; it must be at least {3 * KERB_HEIGHT:.2f} m")

    @property
    def name(self) -> str:
        return f"synthetic/{self.seed:06d} {self.camera[0]}"

    @property
    def frame_size(self) -> tuple[int, int]:
        return self.height, self.width

    def time(self, index: int) -> float:
        return FRAME_SECONDS * index

    @property
    def fps(self) -> float:
        return 1 / FRAME_SECONDS

    def has_depth(self, index: int) -> bool:
        return True

    @property
    def indices(self) -> Sequence[int]:
        return range(self.frames)

    @functools.cached_property
    def travel(self) -> Travel:
        return travel(self.seed, self.frames)

    @functools.cached_property
    def world(self) -> World:
        return World(self.seed, float(self.travel.along[-1]), self.moving_cars, self.travel.speed)

    def image(self, index: int) -> NDArray[np.uint8]:
        return self._frame(index)[0]

    def depth(self, index: int) -> NDArray[np.float32]:
        return self._frame(index)[1]

    def intrinsics(self, index: int = 0) -> F64:
        focal = self.focal * self.width
        center = ((self.width - 1) / 2, _HORIZON * (self.height - 1))
        return np.array([[focal, 0.0, center[0]], [0.0, focal, center[1]], [0.0, 0.0, 1.0]])

    def pose(self, index: int) -> F64:
        self._check(index)
        T_world_cam = pose(self.world.road, self.travel, index, self.world.section.lane, self.camera_height)
        if self.camera == "right":
            T_world_cam[:3, 3] += T_world_cam[:3, 0] * self.baseline
        return T_world_cam

    def stereo(self) -> SyntheticDrive:
        return self._stereo

    @functools.cached_property
    def _stereo(self) -> SyntheticDrive:
        twin = replace(self, camera="right" if self.camera == "left" else "left")
        shared = {name: value for name, value in self.__dict__.items() if name in ("world", "travel")}
        twin.__dict__.update(shared, _stereo=self)  # each is the other's, so that no frame is rendered twice
        return twin

    @property
    def T_stereo_cam(self) -> F64:  # noqa: N802 (frames in names)
        T = np.eye(4)
        T[0, 3] = -self.baseline if self.camera == "left" else self.baseline
        return T

    @property
    def rendered(self) -> bool:
        return len(self._frames) == self.frames

    def render(self, progress: Callable[[], object] | None = None) -> None:
        """Render all frames that are not in memory yet, or read them from the cache folder."""
        stored = self._stored
        if stored and not self.rendered and stored.exists():
            self._load(stored)
        for index in self.indices:
            self._frame(index)
            if progress is not None:
                progress()
        if stored and not stored.exists():
            images, depths = (np.stack(each) for each in zip(*(self._frames[i] for i in self.indices), strict=True))
            with replacing(stored) as temporary, temporary.open("wb") as file:
                np.savez(file, image=images, depth=depths)

    def _check(self, index: int) -> None:
        if not 0 <= index < self.frames:
            raise DataError(f"'{self.name}' has no frame {index}; it has 0 to {self.frames - 1}")

    def _frame(self, index: int) -> Frame:
        if index not in self._frames:
            camera = Camera(self.intrinsics(), self.pose(index), self.height, self.width)
            polygons = self.world.polygons_at(index)
            hits = cast(self.world, polygons, camera)
            inverse = hits.inverse_depth[0]
            known = inverse > 1 / MAX_DEPTH
            depth = np.where(known, 1 / np.where(known, inverse, 1), 0).astype(np.float32)
            self._frames[index] = shade(self.world, polygons, camera, hits), depth
        return self._frames[index]

    @property
    def _stored(self) -> Path | None:
        if self.cache is None:
            return None
        settings = tuple(getattr(self, each.name) for each in fields(self) if each.name not in ("cache", "_frames"))
        key = hashlib.sha256(repr((VERSION, settings)).encode()).hexdigest()[:20]
        return Path(self.cache) / f"{self.seed:06d}_{self.camera}_{key}.npz"

    def _load(self, path: Path) -> None:
        try:
            stored = read_arrays(path)
            images, depths = stored["image"], stored["depth"]
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise DataError(f"{path} is not a rendered drive ({error}); delete it to render it again") from error
        if images.shape[:3] != depths.shape or depths.shape[0] != self.frames:
            raise DataError(f"{path} holds images {images.shape}, depth {depths.shape}; delete it to render it again")
        self._frames = dict(enumerate(zip(images, depths, strict=True)))
