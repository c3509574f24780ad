"""The stereo view as a source: exact geometry through loading, cropping and mirroring, in every data set."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drives import NumberDrive

from saunet.data.kitti.module import KittiDataModule
from saunet.data.kitti.odometry import KittiOdometryDataModule, OdometrySequence
from saunet.data.kitti.raw import KittiRaw
from saunet.data.loading.windows import Selection, WindowDataset, collate, find_windows, measured_distance, other_view
from saunet.data.synthetic import SyntheticDataModule
from saunet.errors import ConfigError, DataError
from saunet.geometry.warp import synthesize
from saunet.synthetic import SyntheticDrive
from saunet.synthetic.kitti_writer import write_odometry, write_raw

SIZE = {"height": 48, "width": 96}


@pytest.fixture(scope="module")
def street() -> SyntheticDrive:
    drive = SyntheticDrive(seed=5, frames=3, **SIZE)
    drive.render()
    drive.stereo().render()
    return drive


@pytest.fixture(scope="module")
def kitti_root(street: SyntheticDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("kitti")
    write_raw(root / "raw", [street], right=[street.stereo()])
    write_odometry(root / "odometry", [street], right=[street.stereo()])
    return root


def unexplained(target: torch.Tensor, source: torch.Tensor, depth: torch.Tensor, K: torch.Tensor, T: Any) -> float:
    """Median difference between the target and the source warped into it, where the source sees the point."""
    view = synthesize(source[None, None], depth[None], K[None], T[None, None])
    difference = (view.image[0, 0] - target).abs().mean(0)
    return float(difference[view.valid[0, 0, 0] & (depth[0] > 0)].median())


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("camera", ["left", "right"])
def test_true_depth_warps_the_stereo_view_onto_the_target_also_when_mirrored(
    street: SyntheticDrive, camera: str, mirrored: bool
) -> None:
    drive = street if camera == "left" else street.stereo()
    data = WindowDataset([drive], [(0, 1)], offsets=(), stereo=True, with_target_depth=True, **SIZE)
    batch: Any = collate([data[0]])
    batch["draws"] = torch.zeros(1, 8)
    batch["draws"][:, 3:] = 1.0  # no colors
    batch["draws"][:, 2] = 0.0 if mirrored else 1.0
    out: Any = SyntheticDataModule(**SIZE).augment(batch)
    side = (-1 if camera == "left" else 1) * (-1 if mirrored else 1)  # where points move in the other's camera
    torch.testing.assert_close(out["T_stereo_tgt"][0, :3, 3], torch.tensor([side * 0.54, 0.0, 0.0]))
    target, source, depth, K = out["loss_target"][0], out["loss_sources"][0, 0], out["target_depth"][0], out["K"][0]
    right = unexplained(target, source, depth, K, out["T_stereo_tgt"][0])
    wrong_side = out["T_stereo_tgt"][0].clone()
    wrong_side[0, 3] *= -1
    assert right < 0.012
    assert unexplained(target, source, depth, K, wrong_side) > 3 * right


def test_mirroring_is_exact_in_a_world_of_numbers() -> None:
    """A wall at z m shifts the other by f b / z whole pixels; mirrored, by as many the other way."""
    image = torch.rand(1, 3, 6, 16)
    K = torch.tensor([[[8.0, 0.0, 6.3], [0.0, 8.0, 2.5], [0.0, 0.0, 1.0]]])
    depth = torch.full((1, 1, 6, 16), 4.0)  # 8 px x 1 m / 4 m = 2 px
    other = torch.zeros_like(image)
    other[..., :-2] = image[..., 2:]
    T = torch.eye(4)
    T[0, 3] = -1.0
    batch: Any = {
        "frames": (255 * torch.stack([image, other], 1)).round().to(torch.uint8),
        "K": K,
        "name": ["wall"],
        "T_stereo_tgt": T[None],
        "draws": torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]]),
    }
    out: Any = SyntheticDataModule(height=6, width=16).augment(copy.copy(batch))
    assert out["T_stereo_tgt"][0, 0, 3] == 1.0
    torch.testing.assert_close(out["loss_target"], batch["frames"][:, 0].flip(-1) / 255)
    view = synthesize(out["loss_sources"], depth, out["K"], out["T_stereo_tgt"][:, None])
    seen = view.valid[0, 0, 0]
    torch.testing.assert_close(seen[0], torch.arange(16) < 14)
    torch.testing.assert_close(view.image[0, 0][:, seen], out["loss_target"][0][:, seen], rtol=0, atol=1e-5)


def test_the_stereo_view_comes_last_and_its_motion_with_the_others(street: SyntheticDrive) -> None:
    data = WindowDataset(
        [street], [(0, 1)], offsets=(-1, 1), stereo=True, with_pose=True, odometer=measured_distance, **SIZE
    )
    sample = data[0]
    assert sample["frames"].shape == (4, 3, 48, 96)
    np.testing.assert_array_equal(sample["frames"][3].permute(1, 2, 0), street.stereo().image(1))
    torch.testing.assert_close(sample["T_src_tgt"][2], sample["T_stereo_tgt"])
    torch.testing.assert_close(sample["distance"][:2], torch.linalg.vector_norm(sample["T_src_tgt"][:2, :3, 3], dim=-1))
    assert sample["distance"][2].isnan()


def test_the_twin_is_one_object_and_knows_the_way_back(street: SyntheticDrive) -> None:
    twin = street.stereo()
    assert twin is street.stereo()
    assert twin.stereo() is street
    np.testing.assert_allclose(twin.T_stereo_cam @ street.T_stereo_cam, np.eye(4))
    np.testing.assert_allclose(np.linalg.inv(twin.pose(1)) @ street.pose(1), street.T_stereo_cam, atol=1e-12)


@pytest.mark.parametrize("kind", ["raw", "odometry"])
def test_kittis_calibration_places_the_stereo_view(kitti_root: Path, street: SyntheticDrive, kind: str) -> None:
    drive: Any
    if kind == "raw":
        drive = KittiRaw(kitti_root / "raw").drive("2011_09_26/2011_09_26_drive_0001_sync")
    else:
        drive = OdometrySequence(kitti_root / "odometry", "00")
    np.testing.assert_allclose(drive.T_stereo_cam, street.T_stereo_cam, atol=1e-5)
    np.testing.assert_allclose(drive.stereo().T_stereo_cam, -drive.T_stereo_cam + 2 * np.eye(4), atol=1e-9)
    np.testing.assert_array_equal(drive.stereo().image(1), street.stereo().image(1))
    assert measured_distance(drive, 0, 2) == pytest.approx(street.distance(0, 2), rel=0.02)


@pytest.mark.parametrize("offsets", [(), (-1, 1)])
def test_modules_deliver_stereo_sources(kitti_root: Path, offsets: tuple[int, ...]) -> None:
    common: dict[str, Any] = {"offsets": offsets, "batch_size": 1, "workers": 0, "stereo": True, **SIZE}
    modules: list[Any] = [
        KittiDataModule(root=str(kitti_root / "raw"), split="all", val_share=0.0, cameras=["left"], **common),
        KittiOdometryDataModule(root=str(kitti_root / "odometry"), train_sequences=["00"], val_share=0.0, **common),
        SyntheticDataModule(train_drives=1, val_drives=1, frames_per_drive=3, **common),
    ]
    for data in modules:
        data.setup("fit")
        batch = data.on_after_batch_transfer(next(iter(data.train_dataloader())), 0)
        assert batch["sources"].shape[1] == len(offsets) + 1
        assert batch["T_stereo_tgt"].shape == (1, 4, 4)
        assert abs(float(batch["T_stereo_tgt"][0, 0, 3])) == pytest.approx(0.54, abs=1e-4)


def test_frames_without_a_stereo_view_are_left_out_and_counted(kitti_root: Path, tmp_path: Path) -> None:
    write_raw(tmp_path / "raw", [SyntheticDrive(seed=5, frames=3, **SIZE)], lidar=False)
    drive = KittiRaw(tmp_path / "raw").drive("2011_09_26/2011_09_26_drive_0001_sync")
    windows, usage = find_windows([Selection(drive, drive.indices)], (), stereo=True)
    assert windows == []
    assert usage[0].left_out == {"without stereo view": 3}
    data = KittiDataModule(
        root=str(tmp_path / "raw"), split="all", val_share=0.0, cameras=["left"], stereo=True, offsets=(), **SIZE
    )
    with pytest.raises(DataError, match=r"3 without stereo view.*; frames need a stereo view: check"):
        data.setup("fit")


def test_one_camera_alone_has_no_stereo_view() -> None:
    drive = NumberDrive()
    with pytest.raises(DataError, match=r"'day/drive l' comes from one camera.*set data.stereo=false"):
        other_view(drive)
    assert math.isnan(measured_distance(NumberDrive(truth=False), 0, 1))


def test_cameras_of_different_intrinsics_are_refused(street: SyntheticDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(street.stereo(), "intrinsics", lambda index: 2 * street.intrinsics(index))
    data = WindowDataset([street], [(0, 1)], offsets=(), stereo=True, **SIZE)
    with pytest.raises(DataError, match="have different intrinsics"):
        data[0]


def test_unknown_calibration_of_the_other_camera_is_one_sentence(kitti_root: Path) -> None:
    drive = KittiRaw(kitti_root / "raw").drive("2011_09_26/2011_09_26_drive_0001_sync")
    with pytest.raises(DataError, match="has no P_rect_07; cameras in it: 00, 01, 02, 03"):
        drive.calibration.T_cam_cam(7, 2)


def test_the_other_camera_of_a_sequence_that_has_one_only(tmp_path: Path) -> None:
    write_odometry(tmp_path / "odometry", [SyntheticDrive(seed=5, frames=2, **SIZE)])
    drive = OdometrySequence(tmp_path / "odometry", "00")
    with pytest.raises(DataError, match="image_3 holds no images; cameras of sequence '00' there: color_left"):
        drive.stereo()


def test_assembling_needs_a_source() -> None:
    from saunet.registry import Spec
    from saunet.training.tool import ModelOptions, TrainOptions, assemble

    nothing = Spec({})
    model = ModelOptions(encoder=nothing, decoder=nothing)
    options = TrainOptions(data=nothing, model=model, objective=nothing, output_dir="unused")
    with pytest.raises(ConfigError, match=r"data\.offsets is empty and data\.stereo is false"):
        assemble(options, SyntheticDataModule(offsets=(), **SIZE))
