"""KITTI's layouts on disk: what is written, read back without any of our readers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from saunet.errors import ConfigError, DataError
from saunet.synthetic import SyntheticDrive, kitti_writer, write_odometry, write_raw
from saunet.synthetic.kitti_writer import DATAFORMAT, records

DATE = "2011_09_26"


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive(seed=4, frames=3, height=60, width=180)


@pytest.fixture(scope="module")
def raw(drive: SyntheticDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti") / "raw"
    assert write_raw(root, [drive], right=[drive.stereo()], ground_truth=True) == [f"{DATE}/{DATE}_drive_0001_sync"]
    return root / DATE


def calibration(path: Path) -> dict[str, np.ndarray]:
    pairs = (line.split(": ", 1) for line in path.read_text().splitlines())
    return {key: np.array(value.split(), float) for key, value in pairs if key != "calib_time"}


def homogeneous(R: np.ndarray, T: np.ndarray) -> np.ndarray:
    return np.vstack([np.hstack([R.reshape(3, 3), T.reshape(3, 1)]), [0, 0, 0, 1]])


def project(raw: Path, camera: str, scan: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """KITTI's projection as its development kit does it, nearest first."""
    cameras = calibration(raw / "calib_cam_to_cam.txt")
    velo = calibration(raw / "calib_velo_to_cam.txt")
    R_rect = homogeneous(cameras["R_rect_00"], np.zeros(3))
    P = cameras[f"P_rect_{camera}"].reshape(3, 4) @ R_rect @ homogeneous(velo["R"], velo["T"])
    scan = scan[scan[:, 0] >= 0]
    u, v, z = P @ np.vstack([scan[:, :3].T, np.ones(len(scan))])
    column, row = np.round(u / z).astype(int) - 1, np.round(v / z).astype(int) - 1
    inside = (column >= 0) & (row >= 0) & (column < size[1]) & (row < size[0])
    depth = np.zeros(size)
    for r, c, meters in sorted(zip(row[inside], column[inside], z[inside], strict=True), key=lambda p: -p[2]):
        depth[r, c] = meters
    return depth


def test_lidar_lands_on_the_rendered_depth(raw: Path, drive: SyntheticDrive) -> None:
    for index in drive.indices:
        path = raw / f"{DATE}_drive_0001_sync/velodyne_points/data/{index:010d}.bin"
        scan = np.fromfile(path, np.float32).reshape(-1, 4)
        assert len(scan) > 300
        assert (scan[:, 3] >= 0).all()
        assert (scan[:, 3] <= 1).all()
        sparse, truth = project(raw, "02", scan, (60, 180)), drive.depth(index)
        hit = sparse > 0
        assert hit.sum() == len(scan)
        offset = calibration(raw / "calib_cam_to_cam.txt")["P_rect_02"][11]  # camera 2 sits this far from camera 0 in z
        np.testing.assert_allclose(sparse[hit], truth[hit], rtol=1e-4, atol=1e-4)
        assert 0 < offset < 0.01
        low = scan[scan[:, 0] < 15, 2].min()
        assert -2.2 < low < -1.2  # the road, seen from the roof


def test_lidar_lands_on_the_right_cameras_depth_too(raw: Path, drive: SyntheticDrive) -> None:
    scan = np.fromfile(raw / f"{DATE}_drive_0001_sync/velodyne_points/data/0000000000.bin", np.float32).reshape(-1, 4)
    sparse, truth = project(raw, "03", scan, (60, 180)), drive.stereo().depth(0)
    both = (sparse > 0) & (truth > 0)
    ratio = np.abs(np.log(sparse[both] / truth[both]))
    assert np.median(ratio) < 0.02  # the rest are edges, hidden from one of the cameras


def test_images_are_the_rendered_ones(raw: Path, drive: SyntheticDrive) -> None:
    for camera, view in (("02", drive), ("03", drive.stereo())):
        path = raw / f"{DATE}_drive_0001_sync/image_{camera}/data/0000000001.png"
        np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], view.image(1))


def test_ground_truth_is_256ths_of_a_meter(raw: Path, drive: SyntheticDrive) -> None:
    path = raw / f"{DATE}_drive_0001_sync/proj_depth/groundtruth/image_02/0000000002.png"
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    truth = drive.depth(2)
    near = (truth > 0) & (truth < 255)
    np.testing.assert_allclose(stored[near] / 256.0, truth[near], atol=1 / 500)
    assert (stored[~near & (truth < 255.9)] == 0).all()


def test_calibration_has_all_of_kittis_keys(raw: Path, drive: SyntheticDrive) -> None:
    cameras = calibration(raw / "calib_cam_to_cam.txt")
    lengths = {"S": 2, "K": 9, "D": 5, "R": 9, "T": 3, "S_rect": 2, "R_rect": 9, "P_rect": 12}
    for camera in range(4):
        for key, length in lengths.items():
            assert cameras[f"{key}_{camera:02d}"].size == length
    K = drive.intrinsics()
    P = cameras["P_rect_02"].reshape(3, 4)
    np.testing.assert_allclose(P[:2, 2] - 1, K[:2, 2], rtol=1e-6)
    np.testing.assert_allclose(P[0, 0], K[0, 0], rtol=1e-6)
    baseline = (cameras["P_rect_02"][3] - cameras["P_rect_03"][3]) / K[0, 0]
    assert baseline == pytest.approx(0.54, rel=1e-5)
    R = cameras["R_rect_00"].reshape(3, 3)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-5)
    assert np.abs(R - np.eye(3)).max() > 0.005  # a reader that forgets it is found out
    assert set(calibration(raw / "calib_velo_to_cam.txt")) == {"R", "T", "delta_f", "delta_c"}
    assert set(calibration(raw / "calib_imu_to_velo.txt")) == {"R", "T"}


def test_kittis_own_calibration_has_the_same_keys(raw: Path, kitti_mini: Path) -> None:
    for name in ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"):
        real, ours = calibration(kitti_mini / "raw" / DATE / name), calibration(raw / name)
        assert list(real) == list(ours)
        assert [v.size for v in real.values()] == [v.size for v in ours.values()]


def test_oxts_tells_the_motion(raw: Path, drive: SyntheticDrive) -> None:
    folder = raw / f"{DATE}_drive_0001_sync/oxts"
    rows = np.array([(folder / f"data/{i:010d}.txt").read_text().split() for i in drive.indices], float)
    assert rows.shape == (3, 30)
    steps = [np.linalg.norm(drive.pose(i + 1)[:3, 3] - drive.pose(i)[:3, 3]) for i in (0, 1)]
    values = dict(zip(DATAFORMAT, rows.T, strict=True))
    speed = np.linalg.norm([values["vf"], values["vl"], values["vu"]], axis=0)
    assert speed[0] == pytest.approx(10 * steps[0], rel=0.05)
    assert (values["vf"] > 0.9 * speed).all()
    assert len((folder / "timestamps.txt").read_text().splitlines()) == 3
    assert len((folder / "dataformat.txt").read_text().splitlines()) == 30


def test_oxts_poses_can_be_had_back() -> None:
    """The development kit's Mercator map and roll-pitch-yaw give the poses that went in."""
    yaw, pitch = 0.3, 0.05
    to_world = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # forward left up -> right down forward
    about_z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    poses = []
    for i in range(3):
        T = np.eye(4)
        T[:3, :3] = to_world @ about_z @ about_y
        T[:3, 3] = 2.0 * i, -0.1 * i, 7.0 * i
        poses.append(T)
    rows = records(poses, 0.1)
    scale = np.cos(np.radians(rows[0, 0]))
    east = scale * 6378137.0 * np.radians(rows[:, 1])
    north = scale * 6378137.0 * np.log(np.tan(np.pi * (90 + rows[:, 0]) / 360))
    np.testing.assert_allclose(east - east[0], [0, 2, 4], atol=1e-5)
    np.testing.assert_allclose(north - north[0], [0, 7, 14], atol=1e-3)
    np.testing.assert_allclose(rows[:, 2] - rows[0, 2], [0, 0.1, 0.2], atol=1e-9)
    np.testing.assert_allclose(rows[:, 4], pitch, atol=1e-9)
    np.testing.assert_allclose(rows[:, 3], 0, atol=1e-9)
    np.testing.assert_allclose(rows[:, 5], np.pi / 2 + yaw, atol=1e-9)
    np.testing.assert_allclose(np.hypot(rows[:, 6], rows[:, 7]), np.hypot(70, 20))
    np.testing.assert_allclose(np.linalg.norm(rows[:, 8:11], axis=1), np.linalg.norm([70, 20, 1]))


def test_odometry_layout(drive: SyntheticDrive, tmp_path: Path) -> None:
    root = tmp_path / "odometry"
    assert write_odometry(root, [drive], right=[drive.stereo()], first_sequence=6) == ["06"]
    sequence = root / "sequences/06"
    assert [p.name for p in sorted((sequence / "image_2").iterdir())] == ["000000.png", "000001.png", "000002.png"]
    np.testing.assert_array_equal(cv2.imread(str(sequence / "image_3/000002.png"))[..., ::-1], drive.stereo().image(2))
    calib = calibration(sequence / "calib.txt")
    assert list(calib) == ["P0", "P1", "P2", "P3"]
    assert calib["P3"][3] == pytest.approx(-0.54 * drive.intrinsics()[0, 0])
    poses = np.loadtxt(root / "poses/06.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(poses[0], np.eye(3, 4), atol=1e-9)
    np.testing.assert_allclose(poses[2], (np.linalg.inv(drive.pose(0)) @ drive.pose(2))[:3], atol=1e-7)
    np.testing.assert_allclose(np.loadtxt(sequence / "times.txt"), [0, 0.1, 0.2])


def test_several_drives_and_jpg(drive: SyntheticDrive, tmp_path: Path) -> None:
    names = write_raw(tmp_path, [drive, drive], first_number=9, image_format="jpg", lidar=False, motion=False)
    assert [n[-9:] for n in names] == ["0009_sync", "0010_sync"]
    folder = tmp_path / names[1]
    assert [p.name for p in folder.iterdir()] == ["image_02"]
    image = cv2.imread(str(folder / "image_02/data/0000000000.jpg"))[..., ::-1]
    assert np.abs(image.astype(float) - drive.image(0)).mean() < 6


def test_a_folder_is_never_overwritten(raw: Path, drive: SyntheticDrive) -> None:
    with pytest.raises(DataError, match="exists and is not overwritten"):
        write_raw(raw.parent, [drive])


class _Broken(SyntheticDrive):
    """A recording whose last frame cannot be had."""

    def image(self, index: int) -> np.ndarray:
        if index == 2:
            raise DataError("the disk caught fire")
        return super().image(index)


class _Blind(SyntheticDrive):
    """A recording without truth."""

    def depth(self, index: int) -> None:  # type: ignore[override]
        return None

    def pose(self, index: int) -> None:  # type: ignore[override]
        return None


@pytest.mark.parametrize("write", [write_raw, write_odometry])
def test_nothing_half_written_is_left(write: object, tmp_path: Path) -> None:
    broken = _Broken(seed=1, frames=3, height=16, width=48)
    with pytest.raises(DataError, match="caught fire"):
        write(tmp_path / "out", [broken])  # type: ignore[operator]
    left = [p for p in tmp_path.rglob("*") if p.name not in ("out",)]
    assert left == []


def test_missing_truth_is_one_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Seen(_Blind):
        def image(self, index: int) -> np.ndarray:
            return np.zeros((16, 48, 3), np.uint8)

    blind = Seen(seed=1, frames=2, height=16, width=48)
    with pytest.raises(DataError, match="has no depth; write it without lidar"):
        write_raw(tmp_path / "a", [blind])
    with pytest.raises(DataError, match="has no pose; write it as raw data without motion"):
        write_raw(tmp_path / "b", [blind], lidar=False)
    with pytest.raises(DataError, match="has no pose"):
        write_odometry(tmp_path / "c", [blind])
    write_raw(tmp_path / "d", [blind], lidar=False, motion=False)
    monkeypatch.setattr(kitti_writer.cv2, "imencode", lambda *_: (False, None))
    with pytest.raises(DataError, match="cannot encode"):
        write_raw(tmp_path / "e", [blind], lidar=False, motion=False)


def test_no_room_to_write_is_one_sentence(drive: SyntheticDrive, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"cannot write .*check the folder"):
        write_raw(tmp_path / "file", [drive])


def test_recordings_that_do_not_fit_are_one_sentence(drive: SyntheticDrive, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no drives to write"):
        write_raw(tmp_path, [])
    with pytest.raises(ConfigError, match="differ in size or intrinsics"):
        write_raw(tmp_path, [drive, SyntheticDrive(seed=1, frames=1, height=32, width=96)])
    with pytest.raises(ConfigError, match="one right for each left"):
        write_raw(tmp_path, [drive], right=[])
    with pytest.raises((ConfigError, TypeCheckError), match=r"image_format is 'bmp'|parameter image_format="):
        write_raw(tmp_path, [drive], image_format="bmp")  # type: ignore[arg-type]
