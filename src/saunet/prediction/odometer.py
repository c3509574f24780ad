"""The path of a camera: motions between neighbors from a pose network or tracked points, chained, and drawn."""

from __future__ import annotations

import itertools
import math
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor, nn

from saunet.data.loading.windows import tracked_poses
from saunet.errors import CheckpointError, ConfigError, DataError, positive
from saunet.io.images import network_input, write_image
from saunet.io.progress import bar
from saunet.io.trajectories import write_kitti
from saunet.metrics.odometry import chain_motions
from saunet.prediction.pointcloud import Camera
from saunet.runs.record import Scale
from saunet.weights.files import read_model

_PAPER, _GRID, _INK, _TRACK, _START, _END = (
    (250, 250, 250), (222, 222, 222), (60, 60, 60), (31, 90, 180), (40, 140, 60), (200, 60, 40),
)  # fmt: skip


class TrackedPose(nn.Module):
    """Motion to the next frame from tracked points, instead of a pose network; its length comes from depth."""

    offsets = (1,)

    def __init__(self, depth: nn.Module, asked_for: bool = False) -> None:
        super().__init__()
        self.depth = depth
        self.asked_for = asked_for  # although the model has a pose network

    def forward(
        self, target: Float[Tensor, "b 3 h w"], sources: Float[Tensor, "b 1 3 h w"], K: Float[Tensor, "b 3 3"]
    ) -> Float[Tensor, "b 1 4 4"]:
        return tracked_poses(target, sources, K, self.depth(target).depth[0])


class Odometer:
    """Follows the camera through a clip, frame by frame; memory grows only by one pose per frame.

    A network that sees both neighbors predicts two motions at once, so it runs only at every second frame.
    """

    def __init__(
        self,
        pose: nn.Module,
        height: int,
        width: int,
        scale: Scale | None = None,
        device: str | torch.device = "cpu",
        batch_size: int = 1,
    ) -> None:
        positive("batch_size", batch_size)
        self._offsets: tuple[int, ...] = tuple(pose.offsets)  # type: ignore[arg-type]
        if not {-1, 1} & set(self._offsets):
            raise ConfigError(
                f"the pose network was trained on offsets {list(self._offsets)}; a path needs the motion between "
                "neighboring frames, so use a model trained with offset 1 or -1"
            )
        self.scale = scale
        self._pose, self._size, self._device = pose.to(device).eval(), (height, width), torch.device(device)
        self._batch_size = batch_size
        self._reach = max(abs(offset) for offset in self._offsets)
        self._stride = 2 if {-1, 1} <= set(self._offsets) else 1
        self._next = 1 if -1 in self._offsets else 0  # the first frame with a neighbor on the side of this offset
        self._count = 0
        self._images: dict[int, Tensor] = {}
        self._cameras: dict[int, Tensor] = {}
        self._waiting: list[int] = []
        self._motions: dict[int, Float64[np.ndarray, "4 4"]] = {}  # frame i -> T_next_cam

    @classmethod
    def from_model(
        cls,
        path: str | Path,
        motion: str = "auto",
        scale: Scale | None = None,
        device: str = "cpu",
        batch_size: int = 1,
    ) -> Odometer:
        """Load the pose network of a checkpoint or exported folder, or its depth network to track points with.

        With ``motion="tracked"`` points are tracked even if there is a pose network. No code in the file is run.
        """
        if Path(path).suffix.lower() == ".onnx":
            raise ConfigError(f"{path} has no pose network, which a trajectory needs; give the checkpoint")
        model = read_model(path)
        depth, pose = model.networks()
        size = model.record.height, model.record.width
        followed = TrackedPose(depth, pose is not None) if pose is None or motion == "tracked" else pose
        return cls(followed, *size, scale or model.record.scale, device, batch_size)

    def restart(self) -> Odometer:
        """Return an odometer with the same network, ready for the first frame of another clip."""
        return Odometer(self._pose, *self._size, self.scale, self._device, self._batch_size)

    @property
    def tracks(self) -> bool:
        """Whether points are tracked because there is no pose network; this requires the camera's intrinsics."""
        return isinstance(self._pose, TrackedPose)

    @property
    def told(self) -> str:
        """Description of the source of the motion if `tracks`."""
        asked_for = isinstance(self._pose, TrackedPose) and self._pose.asked_for
        why = "requested by motion=tracked" if asked_for else "the model has no pose network"
        return f"from tracked points ({why}), with its length from the predicted depth"

    def add(self, image: UInt8[np.ndarray, "h w 3"], K: Float[np.ndarray, "3 3"] | None = None) -> None:
        """Add the next frame, with its intrinsics in pixels if `tracks`."""
        self._images[self._count] = torch.from_numpy(network_input(image, *self._size)).to(self._device)
        if self.tracks:
            assert K is not None, "tracking points requires the camera"
            self._cameras[self._count] = torch.from_numpy(Camera(K, *image.shape[:2]).resized(*self._size).K)
        self._count += 1
        while self._next + self._reach < self._count:
            self._ask_at(self._next)
            self._next += self._stride

    def trajectory(self) -> Float64[np.ndarray, "n 4 4"]:
        """Return the camera-to-world pose of every frame so far; the world is the first camera."""
        if self._count < 2:
            raise DataError(f"a path needs at least 2 frames, got {self._count}")
        last = self._count - 1
        for center in range(self._next, last + (1 not in self._offsets), self._stride):
            self._ask_at(center)
        self._answer()
        if last - 1 not in self._motions:  # motions come in pairs; this one has none
            self._ask_at(last - 1)
            self._answer()
        motions = np.stack([self._motions[index] for index in range(last)])
        motions = _filled(motions) if self.tracks else motions
        if not np.isfinite(motions).all():
            raise CheckpointError("the pose network's output is not finite; the weights are damaged")
        motions[:, :3, 3] *= self.scale.factor if self.scale else 1.0
        return chain_motions(motions)

    def _ask_at(self, center: int) -> None:
        self._waiting.append(center)
        if len(self._waiting) == self._batch_size:
            self._answer()

    @torch.inference_mode()
    def _answer(self) -> None:
        """Run the network on the waiting frames; sources beyond the ends of the clip are replaced by its end frames."""
        if not self._waiting:
            return
        last = self._count - 1
        near = [[min(max(center + offset, 0), last) for offset in self._offsets] for center in self._waiting]
        target = torch.stack([self._images[center] for center in self._waiting])
        sources = torch.stack([torch.stack([self._images[index] for index in row]) for row in near])
        cameras = (torch.stack([self._cameras[center] for center in self._waiting]),) if self.tracks else ()
        # as Python numbers: an array of torch's would hold on to its memory for the whole clip
        answers = np.array(self._pose(target, sources, *cameras).tolist(), dtype=np.float64)
        for center, row in zip(self._waiting, answers, strict=True):
            for offset, T_src_tgt in zip(self._offsets, row, strict=True):
                if offset == 1 and center < last:
                    self._motions[center] = T_src_tgt
                elif offset == -1 and center > 0:
                    self._motions[center - 1] = np.linalg.inv(T_src_tgt)
        self._waiting.clear()
        oldest = self._count - 2 - 2 * self._reach
        for kept in (self._images, self._cameras):
            for index in [index for index in kept if index <= oldest]:
                del kept[index]


def _filled(motions: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "n 4 4"]:
    """Replace unknown motions with the previous one, or the first known one."""
    known = np.isfinite(motions).all((1, 2))
    if not known.any():
        raise DataError(
            f"the camera's motion is unknown between all {len(motions) + 1} frames: too few points can be tracked; "
            "give brighter or sharper frames, closer in time"
        )
    lost = int((~known).sum())
    if lost:
        warnings.warn(
            f"too few points could be tracked in {lost} of {len(motions)} steps of the path; there the motion of the "
            "previous step is used",
            stacklevel=2,
        )
    before = np.maximum.accumulate(np.where(known, np.arange(len(motions)), -1))
    return motions[np.where(before < 0, known.argmax(), before)]


def follow(odometer: Odometer, drive: Any, progress: bool = True) -> Float64[np.ndarray, "n 4 4"]:
    """Return ``T_world_cam`` of each frame of a recording; the world is the first camera."""
    numbers = list(drive.indices)
    gaps = [a for a, b in itertools.pairwise(numbers) if b != a + 1]
    if gaps:
        raise DataError(f"'{drive.name}' has no frame {gaps[0] + 1}; a path needs every frame from first to last")
    odometer = odometer.restart()
    with bar(progress, "images", taken=True) as shown:
        task = shown.add_task(drive.name, total=len(numbers))
        for number in numbers:
            odometer.add(drive.image(number), drive.intrinsics(number) if odometer.tracks else None)
            shown.advance(task)
    return odometer.trajectory()


def write_trajectory(picture: Path, T_world_cam: Float64[np.ndarray, "n 4 4"], metric: bool) -> None:
    """Write a trajectory twice: drawn from above, and beside it as KITTI poses (``.txt``)."""
    write_kitti(picture.with_suffix(".txt"), T_world_cam)
    write_image(picture, draw_from_above(T_world_cam, metric))


def draw_from_above(
    T_world_cam: Float64[np.ndarray, "n 4 4"], metric: bool, size: int = 800
) -> UInt8[np.ndarray, "{size} {size} 3"]:
    """Draw the path of the camera from above: x to the right, z (ahead at the start) up, at the same scale."""
    way = T_world_cam[:, [0, 2], 3]
    extent = max(float(np.ptp(way, axis=0).max()), 1e-9) * 1.15
    margin, top = size // 16, size // 10
    zoom = np.array([1, -1]) * (size - margin - top) / extent
    middle = (way.max(0) + way.min(0)) / 2
    center = np.array([size / 2, top + (size - margin - top) / 2])
    canvas = np.full((size, size, 3), _PAPER, np.uint8)
    step = _round_step(extent / 5)
    for axis in (0, 1):
        low, high = ((middle[axis] + side * size / abs(zoom[axis])) / step for side in (-1, 1))
        for index in range(math.ceil(low), math.floor(high) + 1):
            at = round(center[axis] + (index * step - middle[axis]) * zoom[axis])
            first, last = ((at, 0), (at, size)) if axis == 0 else ((0, at), (size, at))
            cv2.line(canvas, first, last, _GRID, 1)
    points = np.round((center + (way - middle) * zoom) * 16).astype(np.int32)  # sixteenths of a pixel
    cv2.polylines(canvas, [points[:, None]], False, _TRACK, 2, cv2.LINE_AA, 4)
    for index, color in ((0, _START), (-1, _END)):
        cv2.circle(canvas, points[index].tolist(), 6 * 16, color, -1, cv2.LINE_AA, 4)
    length = float(np.linalg.norm(np.diff(T_world_cam[:, :3, 3], axis=0), axis=1).sum())
    unit = "m" if metric else "relative units"
    canvas[: top - 8] = _PAPER
    words = f"{len(way)} frames, {length:.4g} {unit} along the path; one square is {step:g} {unit}"
    for row, text in enumerate((words, "from above; green: start, looking up; red: end")):
        cv2.putText(canvas, text, (14, 26 + 24 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _INK, 1, cv2.LINE_AA)
    return canvas


def _round_step(value: float) -> float:
    """Return the largest of 1, 2 or 5 times a power of ten that is not above ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= value * (1 + 1e-9))
