from __future__ import annotations

import colorsys
import pickle

import pytest
import torch

from saunet.data.loading.transforms import Augment, Prepare, flip_motion, jitter_color
from saunet.errors import DataError

H, W = 8, 12


def frame_batch(b=3, s=2, margin=(0, 0), **draws):
    frames = torch.randint(0, 256, (b, 1 + s, 3, H + margin[0], W + margin[1]), dtype=torch.uint8)
    numbers = torch.full((b, 8), 0.5)
    for name, value in draws.items():
        numbers[:, ["top", "left", "flip", "color"].index(name)] = torch.as_tensor(value)
    K = torch.tensor([[10.0, 0, 5], [0, 11, 4], [0, 0, 1]]).repeat(b, 1, 1)
    return {"frames": frames, "K": K, "name": [f"sample {i}" for i in range(b)], "draws": numbers}


def test_nothing_drawn_changes_nothing_but_the_type():
    batch = frame_batch()
    out = Augment(H, W, flip_prob=0.0, color_jitter_prob=0.0)(batch)
    assert torch.equal(out["target"], batch["frames"][:, 0].float() / 255)
    assert torch.equal(out["sources"], batch["frames"][:, 1:].float() / 255)
    assert torch.equal(out["loss_target"], out["target"])
    assert torch.equal(out["K"], batch["K"])
    assert out["name"] == batch["name"]
    assert "draws" not in out


def test_window_and_principal_point_move_together():
    batch = frame_batch(margin=(4, 6), top=[0.0, 0.5, 0.999], left=[0.999, 0.0, 0.3])
    batch["target_depth"] = torch.rand(3, 1, H + 4, W + 6)
    out = Augment(H, W, flip_prob=0.0, color_jitter_prob=0.0)(batch)
    for i, (top, left) in enumerate([(0, 6), (2, 0), (4, 2)]):
        window = (..., slice(top, top + H), slice(left, left + W))
        assert torch.equal(out["target"][i], batch["frames"][i, 0][window].float() / 255)
        assert torch.equal(out["sources"][i], batch["frames"][i, 1:][window].float() / 255)
        assert torch.equal(out["target_depth"][i], batch["target_depth"][i][window])
        assert out["K"][i, 0, 2] == 5 - left
        assert out["K"][i, 1, 2] == 4 - top
        assert out["K"][i, 0, 0] == 10


def test_flip_mirrors_images_depth_intrinsics_and_motion_of_its_samples_only():
    batch = frame_batch(flip=[0.1, 0.9, 0.4])
    batch["target_depth"] = torch.rand(3, 1, H, W)
    batch["T_src_tgt"] = torch.rand(3, 2, 4, 4)
    out = Augment(H, W, flip_prob=0.5, color_jitter_prob=0.0)(batch)
    original = batch["frames"].float() / 255
    assert torch.equal(out["target"][0], original[0, 0].flip(-1))
    assert torch.equal(out["loss_sources"][2], original[2, 1:].flip(-1))
    assert torch.equal(out["target"][1], original[1, 0])
    assert torch.equal(out["target_depth"][0], batch["target_depth"][0].flip(-1))
    assert torch.equal(out["target_depth"][1], batch["target_depth"][1])
    assert out["K"][:, 0, 2].tolist() == [W - 1 - 5, 5, W - 1 - 5]
    mirror = torch.diag(torch.tensor([-1.0, 1, 1, 1]))
    assert torch.allclose(out["T_src_tgt"][0], mirror @ batch["T_src_tgt"][0] @ mirror)
    assert torch.equal(out["T_src_tgt"][1], batch["T_src_tgt"][1])


def test_mirrored_motion_moves_mirrored_points():
    T = torch.eye(4)[None, None].repeat(1, 1, 1, 1)
    T[0, 0, :3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]]))
    T[0, 0, :3, 3] = torch.tensor([0.5, -0.2, 1])
    point = torch.tensor([1.0, 2, 3, 1])
    mirror = torch.tensor([-1.0, 1, 1, 1])
    moved = flip_motion(T, torch.tensor([True]))[0, 0] @ (mirror * point)
    assert torch.allclose(moved, mirror * (T[0, 0] @ point), atol=1e-6)


def test_colors_change_alike_in_all_frames_and_not_in_the_loss_images():
    batch = frame_batch(color=[0.1, 0.9, 0.1])
    batch["frames"] = batch["frames"][:, :1].expand(-1, 3, -1, -1, -1).contiguous()  # three equal frames stay equal
    batch["draws"][:, 4:] = torch.rand(3, 4)
    out = Augment(H, W, flip_prob=0.0, color_jitter_prob=0.5)(batch)
    original = batch["frames"].float() / 255
    assert torch.allclose(out["sources"], out["target"][:, None].expand(-1, 2, -1, -1, -1), atol=1e-6)
    assert not torch.allclose(out["target"][0], original[0, 0], atol=1e-2)
    assert torch.equal(out["target"][1], original[1, 0])
    assert torch.equal(out["loss_target"], original[:, 0])
    assert torch.equal(out["loss_sources"], original[:, 1:])
    assert out["target"].min() >= 0
    assert out["target"].max() <= 1


def test_contrast_turns_around_one_gray_for_all_frames():
    frames = torch.stack([torch.full((3, 4, 4), 0.2), torch.full((3, 4, 4), 0.6)])[None]
    one = torch.ones(1)
    out = jitter_color(frames, one.bool(), one, 0.5 * one, one, 0 * one)
    assert out[0, 0].mean() == pytest.approx(0.3, abs=1e-5)  # halfway from 0.2 to the common mean 0.4
    assert out[0, 1].mean() == pytest.approx(0.5, abs=1e-5)


def test_neutral_jitter_is_the_identity():
    frames = torch.rand(2, 2, 3, 6, 6)
    one = torch.ones(2)
    assert torch.allclose(jitter_color(frames, one.bool(), one, one, one, 0 * one), frames, atol=1e-5)


def test_evaluation_cuts_the_middle_and_keeps_the_truth():
    batch = frame_batch(margin=(4, 6))
    del batch["draws"]
    batch |= {"depth": torch.rand(3, 1, 30, 40), "depth_size": torch.tensor([[30, 40]] * 3)}
    out = Prepare(H, W)(batch)
    assert torch.equal(out["target"], batch["frames"][:, 0, :, 2:-2, 3:-3].float() / 255)
    assert out["K"][0, 0, 2] == 5 - 3
    assert out["K"][0, 1, 2] == 4 - 2
    assert torch.equal(out["depth"], batch["depth"])
    assert torch.equal(out["depth_size"], batch["depth_size"])


def test_single_frames_give_no_sources():
    batch = frame_batch(s=0)
    del batch["draws"]
    assert Prepare(H, W)(batch)["sources"].shape == (3, 0, 3, H, W)


@pytest.mark.parametrize("transform", [Augment(H + 1, W), Prepare(H, W + 1)])
def test_too_small_frames_are_refused(transform):
    with pytest.raises(DataError, match=r"frames of 8x12 are smaller than"):
        transform(frame_batch())


def test_transforms_pickle():
    batch = frame_batch(margin=(2, 2))
    transform = Augment(H, W)
    again = pickle.loads(pickle.dumps(transform))
    assert torch.equal(transform(batch)["target"], again(batch)["target"])


@pytest.mark.parametrize(("drawn", "degrees"), [(0.0, -36), (0.25, -18), (0.75, 18), (1 - 1e-6, 36)])
def test_hue_turns_by_a_tenth_of_the_circle_at_most(drawn, degrees):
    batch = frame_batch(b=1)
    batch["frames"][:] = torch.tensor([200, 60, 60], dtype=torch.uint8)[:, None, None]  # red: hue 0
    batch["draws"][:] = 0.5
    batch["draws"][0, 3], batch["draws"][0, 7] = 0.0, drawn
    red, green, blue = (float(c) for c in Augment(H, W, color_jitter_prob=1.0)(batch)["target"][0, :, 0, 0])
    hue = colorsys.rgb_to_hsv(red, green, blue)[0] * 360
    assert (hue + 180) % 360 - 180 == pytest.approx(degrees, abs=1)
