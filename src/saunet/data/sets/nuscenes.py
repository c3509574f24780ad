"""nuScenes: scenes of six cameras and a laser scanner in relational tables; key frames at 2 Hz, sweeps at 12 Hz."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from saunet.data.drive import Drive
from saunet.data.lidar import read_scan
from saunet.data.loading.options import Loading
from saunet.data.loading.selecting import parse_ranges
from saunet.data.sets.base import FilesDataModule, Listing, ScannedDrive, chosen, find_root, reading, transform
from saunet.errors import DataError, one_of
from saunet.io.plain import iterate_json, read_json
from saunet.registry import datamodules

CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT")
LIDAR = "LIDAR_TOP"
VAL = frozenset(
    parse_ranges(
        "3,12-18,35-36,38-39,92-110,221,268-278,329-332,344-346,519-524,552-565,625-627,629-630,632-638,770-771,775,"
        "777-778,780-784,794-800,802,904-917,919-931,962-963,966-969,971-972,1059-1073"
    )
)
"""Numbers of the 150 validation scenes of v1.0-trainval (nuscenes.org's own division); the other 700 train."""
MINI_VAL = frozenset((103, 916))  # of the ten scenes of v1.0-mini
CONDITIONS = ("clear", "rain", "night", "night rain")

Array = NDArray[np.float64]


class Record(NamedTuple):
    """A row of ``sample_data``: one measurement of one sensor."""

    time: float  # seconds
    file: str
    sample: str | None  # of key frames
    sensor: str  # token of its calibration
    ego: str  # token of the pose of the car


class NuScenesDrive(ScannedDrive):
    """One camera in one scene; depth at key frames, from the scan of the same sample moved to the time of the image."""

    def __init__(self, tables: Tables, scene: str, camera: str, key_frames: bool, there: Listing) -> None:
        records = [each for each in tables.records[scene, camera] if each.sample or not key_frames]
        scans = {each.sample: each for each in tables.records[scene, LIDAR]}
        self._numbering = "frames=key_frames" if key_frames else "frames=sweeps"
        self.wanted = range(len(records))
        self.keys = [index for index, each in enumerate(records) if each.sample]
        (sensor,) = {each.sensor for each in records}
        T_ego_cam, K = tables.sensors[sensor]
        files = {index: tables.root / each.file for index, each in enumerate(records)}
        super().__init__(
            f"{tables.names[scene]}/{camera}",
            {index: path for index, path in files.items() if path in there},
            K,
            tables.folder / "calibrated_sensor.json",
            tables.sizes[scene, camera],
            times={index: each.time for index, each in enumerate(records)},
            poses={index: tables.pose(each) for index, each in enumerate(records)},
            camera_height=float(T_ego_cam[2, 3]),  # the car's frame lies on the ground
            condition=tables.conditions[scene],
            scans={
                index: (tables.root / scans[each.sample].file, tables.pose(scans[each.sample]))
                for index, each in enumerate(records)
                if each.sample in scans
            },
        )

    @property
    def numbering(self) -> str:
        return self._numbering

    def points(self, scan: Path) -> NDArray[np.float32]:
        return read_scan(scan, columns=5)


class Tables:
    """The tables of one version, for some cameras and for the scanner at key frames."""

    def __init__(self, root: Path, version: str, cameras: Iterable[str]) -> None:
        self.root, self.folder = root, root / version
        wanted = {LIDAR, *cameras}
        with reading(self.folder, "a folder of nuScenes' tables"):
            scenes = self._read("scene")
            self.names = {row["token"]: str(row["name"]) for row in scenes}
            self.conditions = {row["token"]: _condition(row["description"]) for row in scenes}
            scene_of = {row["token"]: row["scene_token"] for row in self._read("sample")}
            channels = {row["token"]: row["channel"] for row in self._read("sensor")}
            self.sensors: dict[str, tuple[Array, Array]] = {}
            channel_of = {}
            for row in self._read("calibrated_sensor"):
                channel = channels[row["sensor_token"]]
                if channel in wanted:
                    channel_of[row["token"]] = channel
                    T = transform(row["rotation"], row["translation"], "wxyz", f"calibrated_sensor {row['token']}")
                    self.sensors[row["token"]] = T, np.array(row["camera_intrinsic"], np.float64)
            self.records: defaultdict[tuple[str, str], list[Record]] = defaultdict(list)
            self.sizes: dict[tuple[str, str], tuple[int, int]] = {}
            for row in iterate_json(self.folder / "sample_data.json"):
                channel = channel_of.get(row["calibrated_sensor_token"])
                if channel is None or (channel == LIDAR and not row["is_key_frame"]):
                    continue
                scene, sample = scene_of[row["sample_token"]], row["sample_token"] if row["is_key_frame"] else None
                sensor, ego = row["calibrated_sensor_token"], row["ego_pose_token"]
                self.records[scene, channel].append(
                    Record(row["timestamp"] / 1e6, row["filename"], sample, sensor, ego)
                )
                self.sizes[scene, channel] = row["height"], row["width"]
            for rows in self.records.values():
                rows.sort()
            moments = {each.ego for rows in self.records.values() for each in rows}
            self._egos = {
                row["token"]: (row["rotation"], row["translation"])
                for row in iterate_json(self.folder / "ego_pose.json")
                if row["token"] in moments
            }
        if lost := len(moments) - len(self._egos):
            raise DataError(
                f"{self.folder / 'ego_pose.json'} lacks {lost} of the {len(moments)} poses that sample_data.json "
                "names; unpack the tables again"
            )

    def _read(self, table: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = read_json(self.folder / f"{table}.json")
        return rows

    def pose(self, record: Record) -> Array:
        """Return T_world_sensor at the time of a record."""
        rotation, translation = self._egos[record.ego]
        T_world_ego = transform(rotation, translation, "wxyz", f"ego_pose {record.ego}")
        T: Array = T_world_ego @ self.sensors[record.sensor][0]
        return T


def _condition(description: str) -> str:
    words = description.lower()
    return " ".join(word for word in ("night", "rain") if word in words) or "clear"


@datamodules.register("nuscenes")
class NuScenesDataModule(FilesDataModule):
    """nuScenes: training on sweeps at 12 Hz, validation and test on key frames with the scanner's depth.

    Args:
        root: Folder with the tables (``v1.0-trainval``), ``samples`` and ``sweeps``.
        version: ``v1.0-trainval`` (700 scenes to train, 150 to validate and test) or ``v1.0-mini`` (8 and 2); by
            default the first one present.
        cameras: Cameras to train on, such as ``CAM_FRONT`` and ``CAM_BACK``.
        test_cameras: Cameras to validate and test on.
        frames: ``sweeps`` takes all frames, at about 12 Hz; ``key_frames`` those of ``samples`` alone, at 2 Hz.
        conditions: Only scenes with one of these conditions, ``clear``, ``rain``, ``night`` or ``night rain``, found in
            the scenes' descriptions; all if empty.
        **loading: Loader settings, as in `LoadOptions`.

    Raises:
        ConfigError: if a parameter is out of range or a choice is unknown.
    """

    protocol = "nuscenes"

    def __init__(
        self,
        *,
        root: str = "data/nuscenes",
        version: Literal["v1.0-trainval", "v1.0-mini"] | None = None,
        cameras: Sequence[str] = ("CAM_FRONT",),
        test_cameras: Sequence[str] = ("CAM_FRONT",),
        frames: Literal["sweeps", "key_frames"] = "sweeps",
        conditions: Sequence[str] = (),
        target_depth: bool = False,
        with_pose: bool = False,
        cache: str | None = None,
        **loading: Unpack[Loading],
    ) -> None:
        super().__init__(target_depth=target_depth, with_pose=with_pose, cache=cache, **loading)
        self.root, self.version = root, version
        self.cameras = chosen("cameras", cameras, CAMERAS)
        self.test_cameras = chosen("test_cameras", test_cameras, CAMERAS)
        self.frames = one_of("frames", frames, ("sweeps", "key_frames"))
        self.conditions = tuple(one_of("conditions", each, CONDITIONS) for each in conditions)
        self._tables: Tables | None = None

    def drives(self, split: str) -> Sequence[Drive]:
        tables = self._tables = self._tables or self._read()
        held_out = MINI_VAL if tables.folder.name == "v1.0-mini" else VAL
        scenes = [
            token
            for token, name in tables.names.items()
            if (int(name.removeprefix("scene-")) in held_out) == (split != "train")
            and (not self.conditions or tables.conditions[token] in self.conditions)
        ]
        cameras = self.cameras if split == "train" else self.test_cameras
        there, key_frames = Listing(), self.frames == "key_frames"
        made = [NuScenesDrive(tables, scene, camera, key_frames, there) for scene in scenes for camera in cameras]
        if scenes and not any(drive.indices for drive in made):
            raise DataError(
                f"{tables.root} has none of the images of the {len(scenes)} {split} scenes in {tables.folder.name}; "
                "unpack the files v1.0-..._blobs.tgz there"
            )
        if self.has_neighbors(split) and not key_frames and not (tables.root / "sweeps").is_dir():
            raise DataError(
                f"{tables.root} has no sweeps, the frames between the key frames; unpack the files with sweeps there, "
                "or set data.frames=key_frames"
            )
        return made

    def targets(self, split: str, drive: Drive) -> Sequence[int]:
        made = cast(NuScenesDrive, drive)  # by `drives`
        return made.wanted if split == "train" else made.keys

    def _read(self) -> Tables:
        holds = f"{self.version or 'v1.0-*'}/scene.json"
        root = find_root(self.root, holds, "the folder with v1.0-trainval and samples")
        known = [name for name in ("v1.0-trainval", "v1.0-mini") if (root / name / "scene.json").is_file()]
        if not known:
            raise DataError(f"{root} has neither v1.0-trainval nor v1.0-mini; unpack v1.0-trainval_meta.tgz there")
        return Tables(root, self.version or known[0], (*self.cameras, *self.test_cameras))
