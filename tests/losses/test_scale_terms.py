"""Terms about scale: distance traveled, and depth that agrees between frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from saunet.errors import ConfigError
from saunet.geometry.pose import pose_matrix
from saunet.losses.objectives import Monodepth2Objective, SaunetObjective
from saunet.losses.terms import Consistency, TrackedMotion, Velocity
from saunet.types import DepthPyramid

Make = Callable[..., Any]
EMPTY = DepthPyramid(sigmoid=(), disparity=(), depth=())


def test_velocity_is_the_difference_in_meters() -> None:
    translation = torch.tensor([[[3.0, 0.0, 4.0], [0.0, 0.0, -1.0]], [[0.0, 2.0, 0.0], [9.0, 9.0, 9.0]]])
    poses = pose_matrix(torch.randn(2, 2, 3), translation)
    batch: Any = {"distance": torch.tensor([[4.0, 1.0], [5.0, torch.nan]])}
    torch.testing.assert_close(Velocity()(batch, EMPTY, poses, ()).value, torch.tensor(((1 + 0) / 2 + 3) / 2))


def test_velocity_takes_true_motion_where_there_is_no_speed() -> None:
    true = pose_matrix(torch.randn(2, 2, 3), torch.tensor([3.0, 0.0, 4.0]).expand(2, 2, 3))
    predicted = pose_matrix(torch.zeros(2, 2, 3), torch.tensor([0.0, 0.0, 4.0]).expand(2, 2, 3))
    batch: Any = {"T_src_tgt": true}
    torch.testing.assert_close(Velocity()(batch, EMPTY, predicted, ()).value, torch.tensor(1.0))


def test_velocity_has_a_gradient_of_zero_at_zero_motion() -> None:
    translation = torch.zeros(1, 2, 3, requires_grad=True)
    batch: Any = {"distance": torch.ones(1, 2)}
    Velocity()(batch, EMPTY, pose_matrix(torch.zeros(1, 2, 3), translation), ()).value.backward()
    assert translation.grad is not None
    assert (translation.grad == 0).all()


def test_tracked_motion_is_angle_and_way_where_they_are_known() -> None:
    predicted = pose_matrix(
        torch.tensor([[[0.0, 0.3, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]]),
        torch.tensor([[[0.0, 3.0, 2.0], [3.0, 0.0, 0.0], [1.0, 2.0, 3.0]]]),
    ).requires_grad_()
    tracked = pose_matrix(torch.zeros(1, 3, 3), torch.tensor([[[0.0, 3.0, 4.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]]))
    tracked[:, 2] = torch.nan
    batch: Any = {"T_predicted": predicted, "T_tracked": tracked}
    value = TrackedMotion(angle=2.0)(batch, EMPTY, predicted, ()).value
    chord = lambda angle: 2 * math.sin(angle / 2)
    torch.testing.assert_close(value, torch.tensor(2 * (chord(0.3) + chord(0.1)) / 2 + 2 / 5))
    value.backward()
    assert predicted.grad is not None
    assert predicted.grad.isfinite().all()
    assert (predicted.grad[:, 2] == 0).all()


@pytest.mark.parametrize(("scale", "expected"), [(1.0, 0.0), (1.5, 0.2), (0.5, 1 / 3)])
def test_consistency_of_a_wall(scale: float, expected: float) -> None:
    depth = torch.full((1, 1, 12, 16), 5.0)
    pyramid = DepthPyramid(sigmoid=(depth,), disparity=(1 / depth,), depth=(depth,))
    K = torch.tensor([[[20.0, 0.0, 7.5], [0.0, 20.0, 5.5], [0.0, 0.0, 1.0]]])
    poses = pose_matrix(torch.zeros(1, 2, 3), torch.tensor([[[0.0, 0.0, -1.0], [0.3, 0.0, 2.0]]]))
    truth = torch.tensor([4.0, 7.0]).reshape(1, 2, 1, 1, 1).expand(1, 2, 1, 12, 16)  # moving ahead, the wall is nearer
    batch: Any = {"K": K, "source_depth": scale * truth}
    value = Consistency()(batch, pyramid, poses, ()).value
    torch.testing.assert_close(value, torch.tensor(expected), rtol=1e-5, atol=1e-6)


def test_consistency_teaches_both_frames_and_motion(make_inputs: Make) -> None:
    inputs = make_inputs()
    inputs.batch["source_depth"].requires_grad_()
    Consistency()(*inputs).value.backward()
    for leaf in (inputs.batch["source_depth"], inputs.sigmoid[0], inputs.axisangle, inputs.translation):
        assert leaf.grad is not None
        assert leaf.grad.abs().sum() > 0


def test_objectives_say_whether_they_need_source_depth() -> None:
    assert not SaunetObjective().needs_source_depth
    assert not Monodepth2Objective().needs_source_depth
    assert SaunetObjective(extra={"consistency": {"weight": 0.1}}).needs_source_depth
    assert not SaunetObjective(extra={"consistency": {"weight": 0.0}}).needs_source_depth


@pytest.mark.parametrize(
    ("term", "key", "message"),
    [
        (Velocity(), "distance", "the velocity term needs 'distance' in the batch, which the data do not provide; set"),
        (TrackedMotion(), "T_tracked", "the tracked_motion term needs 'T_tracked' in the batch.*track_motion"),
        (Consistency(), "source_depth", "the consistency term needs 'source_depth' in the batch"),
    ],
)
def test_missing_input_is_one_sentence(term: Any, key: str, message: str, make_inputs: Make) -> None:
    inputs = make_inputs()
    inputs.batch.pop(key, None)
    with pytest.raises(ConfigError, match=message) as raised:
        term(*inputs)
    assert "\n" not in str(raised.value)
