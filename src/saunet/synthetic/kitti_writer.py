"""Recordings written to disk in KITTI's layouts, so that everything which reads KITTI can be tried without it.

KITTI's calibration counts pixels from one: a reader projects with it and subtracts 1. The principal points written are
therefore those of the recording plus 1, and every LiDAR point is the point at a pixel's center, so that it falls back
on its pixel exactly.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from saunet.data.drive import Drive
from saunet.errors import DataError, one_of
from saunet.synthetic import oxts
from saunet.synthetic.rig import Rig

F64 = NDArray[np.float64]

_MAX_RANGE = 120.0  # meters a scanner measures
_BEAMS = np.radians(np.linspace(2.0, -24.8, 64))
_AZIMUTHS = np.radians(np.arange(-60.0, 60.0, 0.18))
_SECONDS = 0.1


def write_raw(
    root: Path | str,
    drives: Sequence[Drive],
    *,
    right: Sequence[Drive] | None = None,
    date: str = "2011_09_26",
    first_number: int = 1,
    lidar: bool = True,
    motion: bool = True,
    ground_truth: bool = False,
    image_format: Literal["png", "jpg"] = "png",
) -> list[str]:
    """Write recordings as one date of KITTI's raw data: images, calibration, LiDAR scans, OXTS.

    Args:
        root: Folder that holds the dates; made if missing.
        drives: Recordings of the left color camera (image_02), all of one size and calibration.
        right: The same drives seen by the right color camera (image_03).
        date: Name of the date's folder.
        first_number: Number of the first drive.
        lidar: Write ``velodyne_points``: float32 x y z reflectance in the scanner's frame; needs depth.
        motion: Write ``oxts``: 30 values a frame; needs poses.
        ground_truth: Write ``proj_depth/groundtruth``: 16-bit PNG of 256 x meters.
        image_format: ``"png"`` or ``"jpg"``.

    Returns:
        Drive folders relative to ``root``.

    Raises:
        ConfigError: if there is nothing to write, or the recordings do not fit together.
        DataError: if the date's folder exists or cannot be written, or a recording lacks what is asked for. Nothing is
            left behind then.
    """
    one_of("image_format", image_format, ("png", "jpg"))
    rig = Rig.of(drives, right)
    names = [f"{date}/{date}_drive_{first_number + n:04d}_sync" for n in range(len(drives))]
    with _whole_folder(Path(root) / date) as folder:
        rig.write_calibration(folder)
        for number, drive in enumerate(drives):
            target = folder / Path(names[number]).name
            cameras = [(2, drive)] if right is None else [(2, drive), (3, right[number])]
            for camera, view in cameras:
                _write_images(target / f"image_{camera:02d}", view, "%010d", image_format, stamps=True)
                if ground_truth:
                    _write_depth(target / f"proj_depth/groundtruth/image_{camera:02d}", view)
            if lidar:
                _write_scans(target / "velodyne_points", drive, rig)
            if motion:
                T_world_imu = [_pose(drive, i) @ rig.T_cam_imu for i in drive.indices]
                _write_stamps(target / "oxts", drive.indices)
                oxts.write(target / "oxts", list(drive.indices), T_world_imu, _SECONDS)
    return names


def write_odometry(
    root: Path | str, drives: Sequence[Drive], *, right: Sequence[Drive] | None = None, first_sequence: int = 0
) -> list[str]:
    """Write recordings as KITTI's odometry data: sequences/NN (image_2, calib.txt, times.txt) and poses/NN.txt.

    The left camera is camera 0 and camera 2 at once, so that the poses, which are camera 0's, are those of the images.

    Args:
        root: Folder to make; it must not exist.
        drives: Recordings of the left camera.
        right: The same drives seen by the right camera.
        first_sequence: Number of the first sequence.

    Returns:
        Names of the sequences: ``["00", ...]``.

    Raises:
        ConfigError: if there is nothing to write, or the recordings do not fit together.
        DataError: if the folder exists or cannot be written, or a recording has no pose. Nothing is left behind.
    """
    names = [f"{first_sequence + n:02d}" for n in range(len(drives))]
    with _whole_folder(Path(root)) as folder:
        (folder / "poses").mkdir()
        for number, (name, drive) in enumerate(zip(names, drives, strict=True)):
            other = None if right is None else [right[number]]
            rig = Rig.of([drive], other)
            target = folder / "sequences" / name
            for camera, view in [(2, drive), *((3, d) for d in other or [])]:
                _write_images(target / f"image_{camera}", view, "%06d", "png")
            lines = [f"P{camera}: {_numbers(P, 12)}" for camera, P in enumerate(rig.odometry_projections())]
            (target / "calib.txt").write_text("\n".join(lines) + "\n")
            times = [f"{_SECONDS * (i - drive.indices[0]):e}" for i in drive.indices]
            (target / "times.txt").write_text("\n".join(times) + "\n")
            from_start = np.linalg.inv(_pose(drive, drive.indices[0]))
            poses = [_numbers((from_start @ _pose(drive, i))[:3], 9) for i in drive.indices]
            (folder / "poses" / f"{name}.txt").write_text("\n".join(poses) + "\n")
    return names


@contextmanager
def _whole_folder(target: Path) -> Iterator[Path]:
    """Yield a folder beside ``target`` that becomes ``target`` when all went well and disappears otherwise."""
    if target.exists():
        raise DataError(f"{target} exists and is not overwritten; remove it or choose another place")
    temporary: Path | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
        temporary.chmod(0o755)
        yield temporary
        temporary.rename(target)
        temporary = None
    except OSError as reason:
        raise DataError(
            f"cannot write {target}: {reason.strerror or reason}; check the folder, its rights and its space"
        ) from reason
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def lidar_scan(drive: Drive, index: int, rig: Rig) -> NDArray[np.float32]:
    """Sample a frame's depth like a scanner with 64 beams on the car's roof."""
    depth, image = _depth(drive, index), drive.image(index)
    elevation, azimuth = np.meshgrid(_BEAMS, _AZIMUTHS, indexing="ij")
    level = np.cos(elevation)
    beams = np.stack([level * np.cos(azimuth), -level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    K = np.asarray(drive.intrinsics(index), np.float64)
    # As if the scanner were at the camera's place, half a meter off: that decides only the pattern.
    rays = beams @ np.linalg.inv(rig.T_velo_cam)[:3, :3].T
    rays = rays[rays[:, 2] > 0.1]
    pixels = np.rint(rays / rays[:, 2:] @ K.T)[:, :2].astype(np.int64)
    height, width = depth.shape
    inside = (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    u, v = np.unique(pixels[inside], axis=0).T
    z = depth[v, u].astype(np.float64)
    measured = (z > 0) & (z < _MAX_RANGE)
    u, v, z = u[measured], v[measured], z[measured]
    points = np.stack([u, v, np.ones_like(u)], axis=1) @ np.linalg.inv(K).T * z[:, None]
    points = points @ rig.T_velo_cam[:3, :3].T + rig.T_velo_cam[:3, 3]
    reflectance = image[v, u].mean(axis=1, keepdims=True) / 255
    return np.concatenate([points, reflectance], axis=1).astype(np.float32)


def _write_scans(folder: Path, drive: Drive, rig: Rig) -> None:
    _write_stamps(folder, drive.indices)
    for index in drive.indices:
        (folder / "data" / f"{index:010d}.bin").write_bytes(lidar_scan(drive, index, rig).tobytes())


def _write_images(folder: Path, drive: Drive, pattern: str, image_format: str, stamps: bool = False) -> None:
    place = folder / "data" if stamps else folder
    place.mkdir(parents=True)
    if stamps:
        _write_stamps(folder, drive.indices)
    for index in drive.indices:
        _write_picture(place / f"{pattern % index}.{image_format}", drive.image(index)[..., ::-1])


def _write_depth(folder: Path, drive: Drive) -> None:
    folder.mkdir(parents=True)
    for index in drive.indices:
        scaled = np.rint(_depth(drive, index) * 256.0)
        _write_picture(folder / f"{index:010d}.png", np.where(scaled < 2**16, scaled, 0).astype(np.uint16))


def _write_picture(path: Path, picture: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    done, data = cv2.imencode(path.suffix, np.ascontiguousarray(picture))
    if not done:
        raise DataError(f"cannot encode {path.name}; the picture is {picture.shape} {picture.dtype}")
    path.write_bytes(data.tobytes())


def _write_stamps(folder: Path, indices: Sequence[int]) -> None:
    (folder / "data").mkdir(parents=True, exist_ok=True)
    lines = []
    for index in indices:
        minutes, seconds = divmod(_SECONDS * index, 60.0)
        lines.append(f"2011-09-26 {13 + int(minutes) // 60:02d}:{int(minutes) % 60:02d}:{seconds:012.9f}")
    (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")


def _numbers(values: F64, digits: int) -> str:
    return " ".join(f"{value:.{digits}e}" for value in np.asarray(values).ravel())


def _depth(drive: Drive, index: int) -> NDArray[np.float32]:
    depth = drive.depth(index)
    if depth is None:
        raise DataError(f"frame {index} of '{drive.name}' has no depth; write it without lidar and ground_truth")
    return depth


def _pose(drive: Drive, index: int) -> F64:
    T_world_cam = drive.pose(index)
    if T_world_cam is None:
        raise DataError(f"frame {index} of '{drive.name}' has no pose; write it as raw data without motion")
    return T_world_cam
