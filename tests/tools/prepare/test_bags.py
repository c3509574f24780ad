"""Bags of ROS 1 and 2 and MCAP files, written by rosbags, become clips that ``data=video`` reads."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from videos import number_of, numbered

import saunet
from saunet.data.video.camera import read_camera
from saunet.data.video.clips import find_clips
from saunet.errors import ConfigError, DataError
from saunet.io.images import encode_jpeg, read_image
from saunet.tools.prepare import bags as bags_module
from saunet.tools.prepare.importing import import_recordings
from saunet.tools.prepare.tool import PrepareOptions, prepare

rosbags = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")
from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

START = 1_403_636_579_763_555_584  # ns
STEP = 100_000_000
COUNT = 12
KINDS = ["ros1", "sqlite3", "mcap"]
D = [-0.28, 0.07, 0.0002, 0.00002, 0.0]
K = [110.0, 0.0, 63.5, 0.0, 111.0, 47.5, 0.0, 0.0, 1.0]


class Bag:
    """Writes messages of any of the three formats."""

    def __init__(self, kind: str, path: Path) -> None:
        self.one = kind == "ros1"
        self.path = path.with_suffix(".bag") if self.one else path
        self.store = get_typestore(Stores.ROS1_NOETIC if self.one else Stores.ROS2_HUMBLE)
        storage = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        self.writer: Any = Writer1(self.path) if self.one else Writer2(path, version=9, storage_plugin=storage)
        self.connections: dict[str, Any] = {}
        self.counter = itertools.count()

    def __enter__(self) -> Bag:
        self.writer.open()
        return self

    def __exit__(self, *_: Any) -> None:
        self.writer.close()

    def make(self, name: str, **values: Any) -> Any:
        return self.store.types[name](**values)

    def header(self, stamp: int) -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        more = {"seq": next(self.counter)} if self.one else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id="cam0", **more)

    def write(self, topic: str, message: Any, received: int) -> None:
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        pack = self.store.serialize_ros1 if self.one else self.store.serialize_cdr
        self.writer.write(self.connections[topic], received, pack(message, name))

    def image(self, topic: str, stamp: int, pixels: Any, encoding: str, pad: int = 0) -> None:
        rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, pad)))
        values = {"height": len(pixels), "width": pixels.shape[1], "encoding": encoding, "is_bigendian": 0}
        data = {"step": rows.shape[1], "data": rows.ravel().view(np.uint8)}
        self.write(topic, self.make("sensor_msgs/msg/Image", header=self.header(stamp), **values, **data), stamp + 7)

    def compressed(self, topic: str, stamp: int, data: bytes) -> None:
        values = {"format": "jpeg", "data": np.frombuffer(data, np.uint8)}
        message = self.make("sensor_msgs/msg/CompressedImage", header=self.header(stamp), **values)
        self.write(topic, message, stamp + 7)

    def info(self, topic: str, stamp: int) -> None:
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        R, P = np.eye(3).ravel(), np.array([*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0])
        numbers = {"D": np.array(D), "K": np.array(K), "R": R, "P": P}
        numbers = numbers if self.one else {key.lower(): value for key, value in numbers.items()}
        values = {"height": 96, "width": 128, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
        message = self.make("sensor_msgs/msg/CameraInfo", header=self.header(stamp), roi=roi, **values, **numbers)
        self.write(topic, message, stamp)

    def vector(self, x: float, y: float = 0.0, z: float = 0.0, kind: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def odometry(self, stamp: int, speed: float, x: float = 0.0) -> None:
        turn = self.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        pose = self.make("geometry_msgs/msg/Pose", position=self.vector(x, kind="Point"), orientation=turn)
        twist = self.make("geometry_msgs/msg/Twist", linear=self.vector(speed), angular=self.vector(0.0))
        unknown = np.zeros(36)
        message = self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp),
            child_frame_id="base",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=unknown),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown),
        )
        self.write("/odom", message, stamp)

    def fix(self, stamp: int, latitude: float, status: int = 0) -> None:
        state = self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1)
        place = {"latitude": latitude, "longitude": 8.4, "altitude": 115.0}
        covariance = {"position_covariance": np.zeros(9), "position_covariance_type": 0}
        message = self.make("sensor_msgs/msg/NavSatFix", header=self.header(stamp), status=state, **place, **covariance)
        self.write("/fix", message, stamp)


def drive(kind: str, folder: Path) -> Path:
    """Two cameras (raw with padded rows, and JPEG), depth, CameraInfo of one, and speeds that grow by 1 m/s²."""
    folder.mkdir(exist_ok=True)
    with Bag(kind, folder / "drive") as bag:
        for number in range(COUNT):
            stamp = START + number * STEP
            bag.info("/cam0/camera_info", stamp)
            bag.odometry(stamp, 5 + number / 10)
            bag.image("/cam0/image_raw", stamp, numbered(number)[..., ::-1], "bgr8", pad=5)
            bag.compressed("/cam1/image_raw/compressed", stamp, encode_jpeg(numbered(number)))
            bag.image("/depth/image", stamp, np.ones((96, 128), np.uint16), "16UC1")
        return bag.path


@pytest.fixture(scope="module", params=KINDS)
def bag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drive(request.param, tmp_path_factory.mktemp(request.param))


def test_a_bag_becomes_clips_that_train(bag: Path, tmp_path: Path) -> None:
    said = str(prepare(PrepareOptions(job="import", input=str(bag), folder=str(tmp_path))))
    assert "24 frames made, 0 existed already, 0 skipped" in said
    assert "camera from /cam0/camera_info, speeds from /odom" in said
    assert "no CameraInfo: add camera.yaml" in said
    clip = tmp_path / "drive" / "cam0_image_raw"
    with_images = {path.parent.name for path in tmp_path.glob("drive/*/*.jpg")}
    assert with_images == {"cam0_image_raw", "cam1_image_raw_compressed"}
    assert [clip.name for clip in find_clips(tmp_path, str(clip / "camera.yaml"))] == sorted(
        f"drive/{name}" for name in with_images
    )
    camera = read_camera(clip / "camera.yaml")
    assert camera.K.ravel().tolist() == K
    assert camera.distortion == tuple(D)
    data = saunet.build("data", "video", root=str(clip), fps=None, static="keep", workers=0, with_speed=True,
                        height=32, width=64, batch_size=1)  # fmt: skip
    data.setup("fit")
    (recording,) = data.drives()
    assert recording.indices == list(range(COUNT))
    assert [number_of(recording.image(index)) for index in recording.indices] == list(range(COUNT))
    assert recording.time(3) - recording.time(0) == pytest.approx(0.3, abs=1e-6)
    assert recording.speed(4) == pytest.approx(5.4)
    assert recording.distance(2, 7) == pytest.approx(0.5 * (5.2 + 5.7) / 2, rel=1e-6)
    sample = data.datasets["train"][0]
    assert sample["distance"] == pytest.approx([0.1 * 5.05, 0.1 * 5.15], abs=0.02)
    cam1 = tmp_path / "drive" / "cam1_image_raw_compressed" / f"{START}.jpg"
    assert cam1.read_bytes() == encode_jpeg(numbered(0))  # as it was


def test_an_interrupted_import_resumes_and_a_finished_one_is_kept(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep, calls = bags_module.write_bytes, itertools.count()

    def full(path: Path, data: bytes) -> None:
        if next(calls) == 9:
            raise DataError(f"cannot write {path}: No space left on device")
        keep(path, data)

    monkeypatch.setattr(bags_module, "write_bytes", full)
    with pytest.raises(DataError, match="No space left"):
        import_recordings(bag, tmp_path)
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.jpg")}
    assert len(made) == 9
    again = import_recordings(bag, tmp_path)
    assert (again.made, again.before) == (15, 9)
    assert {path: path.stat().st_mtime_ns for path in made} == made
    with monkeypatch.context() as patched:  # nothing is read a third time, though one topic is depth
        patched.delattr(bags_module.Bag, "_run")
        last = import_recordings(bag, tmp_path)
    assert (last.made, last.before) == (0, 24)
    assert "0 frames, not color images" in str(last)
    other = bag.with_name("other") / bag.name
    other.parent.mkdir(exist_ok=True)
    files = [bag] if bag.is_file() else list(bag.iterdir())
    for file in files:
        target = other if bag.is_file() else other / file.name
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(file.read_bytes())
    with pytest.raises(DataError, match="another version"):
        import_recordings(other, tmp_path)


def test_sources_of_speed(tmp_path: Path) -> None:
    """Positions by odometry without a twist, and by satellites: one degree of latitude is 111.2 km at 49 degrees."""
    for name, speed in (("moved", 8.0), ("fixed", 12.0)):
        with Bag("ros1", tmp_path / name) as bag:
            for number in range(40):
                stamp = START + number * STEP
                bag.image("/image", stamp, np.full((8, 8), number, np.uint8), "mono8")
                if name == "moved":
                    bag.odometry(stamp, 0.0, x=speed * number / 10)
                bag.fix(stamp, 49.0 + 12.0 * number / 10 / 111_208, status=-1 if number in (3, 20) else 0)
        import_recordings(tmp_path / f"{name}.bag", tmp_path / "clips")
        rows = np.loadtxt(tmp_path / "clips" / name / "image" / "speeds.csv", delimiter=",", skiprows=1)
        assert len(rows) == (40 if name == "moved" else 38)
        assert rows[:, 1] == pytest.approx(speed, rel=1e-3)


@pytest.mark.parametrize("encoding", ["rgb8", "rgba8", "bgra8", "mono8", "yuv422_yuy2", "bayer_rggb8"])
def test_encodings(tmp_path: Path, encoding: str) -> None:
    red = np.full((16, 16, 3), (200, 30, 40), np.uint8)
    mosaic = np.where(np.add.outer(np.arange(16) % 2, np.arange(16) % 2) == 0, 200, 30).astype(np.uint8)
    mosaic[1::2, 1::2] = 40
    yuv = np.zeros((16, 16, 2), np.uint8)  # BT.601 of that red: Y 86, U 107, V 202
    yuv[..., 0], yuv[:, ::2, 1], yuv[:, 1::2, 1] = 86, 107, 202
    alpha = np.full((16, 16, 1), 9, np.uint8)
    pixels = {
        "rgb8": red,
        "rgba8": np.concatenate([red, alpha], 2),
        "bgra8": np.concatenate([red[..., ::-1], alpha], 2),
        "mono8": red[..., 0],
        "yuv422_yuy2": yuv,
        "bayer_rggb8": mosaic,
    }[encoding]
    with Bag("mcap", tmp_path / "a") as bag:
        bag.image("/image", 12 * 10**9 + 5, pixels, encoding)
    import_recordings(tmp_path / "a", tmp_path / "clips")
    image = read_image(tmp_path / "clips" / "a" / "image" / "12.000000005.jpg")  # simulated time
    wanted = [200, 200, 200] if encoding == "mono8" else [200, 30, 40]
    assert np.median(image.reshape(-1, 3), 0) == pytest.approx(wanted, abs=6)


def test_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DataError, match="no file or folder"):
        import_recordings(tmp_path / "nowhere", tmp_path / "clips")
    with pytest.raises(DataError, match="no bag below"):
        import_recordings(tmp_path, tmp_path / "clips")
    with pytest.raises(ConfigError, match="import needs input"):
        PrepareOptions(job="import", input="a.bag")
    whole = drive("ros1", tmp_path / "whole")
    with pytest.raises(ConfigError, match=r"topics is '/cam0/image'.*/cam0/image_raw"):
        import_recordings(whole, tmp_path / "clips", ["/cam0/image"])
    (tmp_path / "cut.bag").write_bytes(whole.read_bytes()[:20_000])
    with pytest.raises(DataError, match=r"reading the bag .*cut\.bag failed.*reindex"):
        import_recordings(tmp_path / "cut.bag", tmp_path / "clips")
    with Bag("sqlite3", tmp_path / "odd") as bag:
        bag.image("/image", START, np.zeros((8, 8, 3), np.uint8), "lab8")
        bag.image("/image", START + STEP, np.zeros((8, 8, 3), np.uint8), "rgb8")
    with pytest.raises(DataError, match=r"encoding 'lab8'; allowed: rgb8"):
        import_recordings(tmp_path / "odd", tmp_path / "clips")
    report = import_recordings(tmp_path / "odd", tmp_path / "clips", on_error="skip")
    assert (report.made, len(report.failures)) == (1, 1)
    with Bag("sqlite3", tmp_path / "all_odd") as bag:
        bag.image("/image", START, np.zeros((8, 8, 3), np.uint8), "lab8")
    for _ in range(2):  # what could not be read is tried again
        report = import_recordings(tmp_path / "all_odd", tmp_path / "clips", on_error="skip")
        assert "no frame that can be read" in str(report)
    with Bag("sqlite3", tmp_path / "none") as bag:
        bag.odometry(START, 1.0)
    with pytest.raises(DataError, match=r"no image topic; it has: /odom"):
        import_recordings(tmp_path / "none", tmp_path / "clips")
