"""The box filter against pooling, and its derivatives."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from saunet.losses.functional import box_mean


@pytest.mark.parametrize("size", [(2, 2), (2, 5), (3, 4), (7, 9)])
def test_equals_pooling_with_reflection(size: tuple[int, int]) -> None:
    x = torch.rand(2, 3, *size, dtype=torch.float64).requires_grad_()
    expected = F.avg_pool2d(F.pad(x, (1, 1, 1, 1), mode="reflect"), 3, stride=1)
    found = box_mean(x)
    torch.testing.assert_close(found, expected)
    weight = torch.rand_like(x)
    grads = [torch.autograd.grad((weight * out).sum(), x)[0] for out in (found, expected)]
    torch.testing.assert_close(*grads)


def test_gradcheck() -> None:
    x = torch.rand(2, 4, 5, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(box_mean, x)
    assert torch.autograd.gradgradcheck(box_mean, x)


def test_input_is_not_touched_whatever_its_layout() -> None:
    x = torch.rand(4, 5, 2).permute(2, 0, 1)
    before = x.clone(memory_format=torch.contiguous_format)
    assert before.stride() != x.stride()
    torch.testing.assert_close(box_mean(x), box_mean(before))
    assert torch.equal(x, before)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_same_on_a_gpu() -> None:
    x = torch.rand(2, 3, 7, 9)
    torch.testing.assert_close(box_mean(x.cuda()).cpu(), box_mean(x))
