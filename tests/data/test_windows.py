from __future__ import annotations

import numpy as np
import pytest
import torch
from drives import NumberDrive

from saunet.data.loading.windows import DRAWS, Item, Selection, WindowDataset, collate, find_windows, reach, sample_name
from saunet.errors import ConfigError, DataError
from saunet.fingerprint import fingerprint


def dataset(drives, frames=range(8), offsets=(-1, 1), **options):
    selections = [Selection(drive, frames) for drive in drives]
    windows, _ = find_windows(selections, offsets)
    return WindowDataset(drives, windows, offsets=offsets, **{"height": 10, "width": 15, **options})


def test_only_frames_with_all_neighbors_are_used_and_the_rest_is_counted():
    drive = NumberDrive(indices=[0, 1, 2, 4, 5, 6])
    windows, usage = find_windows([Selection(drive, range(8), {"static": 3})], (-1, 1))
    assert windows == [(0, 1), (0, 5)]
    assert usage[0].used == 2
    assert usage[0].left_out == {"static": 3, "without neighbor": 4, "missing": 2}
    assert str(usage[0]) == "day/drive l: 2 frames used; left out: 3 static, 4 without neighbor, 2 missing"


def test_single_frames_need_no_neighbor():
    windows, _ = find_windows([Selection(NumberDrive(indices=[3]), [3])], ())
    assert windows == [(0, 3)]


def test_sample_holds_target_first_then_sources_in_order_of_offsets():
    sample = dataset([NumberDrive()], offsets=(2, -1))[0]
    assert sample["frames"].shape == (3, 3, 10, 15)
    assert sample["frames"].dtype == torch.uint8
    assert sample["frames"][:, 0, 0, 0].tolist() == [1, 3, 0]
    assert sample["name"] == "day/drive 0000000001 l"
    assert "draws" not in sample


def test_intrinsics_follow_the_resize():
    drive = NumberDrive()
    K = dataset([drive])[0]["K"].double().numpy()
    native = drive.intrinsics(0)
    assert K[0, 0] == pytest.approx(native[0, 0] / 2)
    assert K[0, 2] == pytest.approx((native[0, 2] + 0.5) / 2 - 0.5)
    assert K[1, 2] == pytest.approx((native[1, 2] + 0.5) / 2 - 0.5)


def test_margin_makes_the_frames_larger_and_intrinsics_follow():
    sample = dataset([NumberDrive()], margin=(2, 3))[0]
    assert sample["frames"].shape == (3, 3, 12, 18)
    assert sample["K"][0, 0] == pytest.approx(30 * 18 / 30)


def test_truth_comes_at_native_and_at_frame_size():
    drive = NumberDrive(truth_size=(40, 61))
    sample = dataset([drive], with_depth=True, with_target_depth=True, with_pose=True)[1]
    assert sample["depth"].shape == (1, 40, 61)
    assert sample["target_depth"].shape == (1, 10, 15)
    assert (sample["target_depth"] == 3).all()
    # the camera moves forward by 1 and right by .1, so a point lies further away from the earlier camera
    assert sample["T_src_tgt"][0, :3, 3].tolist() == pytest.approx([0.1, 0, 1])
    assert sample["T_src_tgt"][1, :3, 3].tolist() == pytest.approx([-0.1, 0, -1])


def test_a_drive_without_truth_gives_an_empty_target_depth_and_no_depth():
    sample = dataset([NumberDrive(truth=False)], with_depth=True, with_target_depth=True)[0]
    assert "depth" not in sample
    assert sample["target_depth"].sum() == 0


def test_a_missing_pose_is_named():
    with pytest.raises(DataError, match=r"'day/drive l' has no pose for frame 1"):
        dataset([NumberDrive(truth=False)], with_pose=True)[0]


def test_frames_of_different_sizes_are_refused():
    drive = NumberDrive()
    drive.image = lambda index: np.zeros((20, 30 + index, 3), np.uint8)
    with pytest.raises(DataError, match=r"frame 0 of 'day/drive l' has shape \(20, 30, 3\)"):
        dataset([drive])[0]


@pytest.mark.parametrize("offsets", [(0, 1), (1, 1)])
def test_impossible_offsets_are_refused(offsets):
    with pytest.raises(ConfigError, match="distinct and not 0"):
        WindowDataset([], [], offsets=offsets, height=1, width=1)


def test_draws_depend_on_the_seed_alone():
    data = dataset([NumberDrive()])
    first, second = data[[Item(0, 7), Item(3, 7)]]
    assert torch.equal(first["draws"], second["draws"])
    assert first["draws"].shape == (DRAWS,)
    assert not torch.equal(first["draws"], data[Item(0, 8)]["draws"])


def test_collate_pads_truth_of_different_sizes():
    drives = [NumberDrive(truth_size=(4, 9)), NumberDrive("b r", truth_size=(6, 5)), NumberDrive("c", truth=False)]
    data = dataset(drives, frames=[2], with_depth=True)
    batch = collate([data[0], data[1], data[2]])
    assert batch["frames"].shape == (3, 3, 3, 10, 15)
    assert batch["depth"].shape == (3, 1, 6, 9)
    assert batch["depth_size"].tolist() == [[4, 9], [6, 5], [1, 1]]
    assert batch["depth"][0, 0, :4].eq(3).all()
    assert batch["depth"].sum() == 3 * (36 + 30)
    assert batch["name"] == ["day/drive 0000000002 l", "b 0000000002 r", "c 0000000002"]


def test_collate_takes_one_sample_too():
    assert collate(dataset([NumberDrive()])[0])["frames"].shape[0] == 1


def test_names_and_fingerprint():
    assert sample_name("2011_09_26/2011_09_26_drive_0001_sync l", 5).endswith("drive_0001_sync 0000000005 l")
    assert sample_name("my clip", 5) == "my clip 0000000005"
    assert fingerprint(["b", "a"]) == fingerprint(["a", "b"]) != fingerprint(["a"])


@pytest.mark.parametrize(("offsets", "frames"), [((-1, 1), 2), ((1,), 1), ((-3, -1), 3), ((), 0)])
def test_reach_of_a_window(offsets, frames):
    assert reach(offsets) == frames
