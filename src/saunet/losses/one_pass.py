"""View synthesis and photometric loss in one pass on a CPU: value and gradient together, one image and scale at a time.

`saunet.geometry.warp` and `saunet.losses.functional` compute the same with separate operations, which keep the maps of
all sources and scales for the gradient. Here the few maps in use stay in the processor's cache:

- A pixel (u, v) of disparity D is seen at (M (u, v, 1) + D m) / w, where w is the third row, M = A R K^-1, m = A t, and
  A is K followed by the scaling to [-1, 1]. Depth is never computed, and only D, M and m get gradients; autograd
  continues from these to poses and intrinsics.
- Box sums replace box means, so C1 and C2 of SSIM are multiplied by 81.
- Masks are numbers, 1.0 or 0.0: on a CPU, selecting by booleans costs ten times as much as a multiplication.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from saunet.geometry import full_precision
from saunet.geometry.warp import BEHIND, BORDER, FAR, MIN_Z
from saunet.types import TrainBatch

_C1, _C2 = 81 * 0.01**2, 81 * 0.03**2
_CENTER = 0.5
"""Subtracted from images before squaring: small variances of bright, flat areas (sky) keep their precision."""
_UNSEEN = 1e6
"""Added to the error of a source that does not count: more than any error."""


@dataclass(frozen=True)
class Choices:
    """Settings of `saunet.losses.terms.Photometric`."""

    ssim_weight: float
    minimum: bool
    automask: bool
    masked: bool
    use_validity: bool


def takes(batch: TrainBatch) -> bool:
    """Return whether a batch can be compared in one pass: on a CPU, without gradients for images."""
    given = batch["loss_target"], batch["loss_sources"]
    large = min(given[0].shape[-2:]) >= 4
    plain = "target_mask" not in batch  # masked pixels need the separate operations
    return plain and large and given[0].device.type == "cpu" and not any(each.requires_grad for each in given)


@full_precision
def photometric(
    poses: Float[Tensor, "b s 4 4"],
    K: Float[Tensor, "b 3 3"],
    target: Float[Tensor, "b 3 h w"],
    sources: Float[Tensor, "b s 3 h w"],
    noise: Float[Tensor, "scales b h w"] | None,
    disparities: Sequence[Float[Tensor, "b 1 h w"]],
    choices: Choices,
) -> tuple[Float[Tensor, " scales"], Float[Tensor, "b 1 h w"], Float[Tensor, "b 1 h w"]]:
    """Return each scale's photometric loss; and of the first scale the error, and 1.0 where it counts.

    Disparities, poses and K get gradients, but no second-order ones. ``noise`` decides ties of the auto-mask.
    """
    images = target.contiguous(), sources.contiguous()
    result: tuple[Tensor, Tensor, Tensor] = _OnePass.apply(  # type: ignore[no-untyped-call]
        *_mappings(K.double(), poses.double(), *target.shape[-2:]), *images, noise, choices, *disparities
    )
    return result


def _mappings(K: Tensor, poses: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return M (b s 3 3) and m (b s 3 1) of all images and sources."""
    zero, one = torch.zeros_like(K[:, 0, 0]), torch.ones_like(K[:, 0, 0])
    fx, skew, cx, fy, cy = (K[:, row, column] for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2)))
    x, y = 2 / max(width - 1, 1), 2 / max(height - 1, 1)
    entries = (x * fx, x * skew, x * cx - 1, zero, y * fy, y * cy - 1, zero, zero, one)
    A = torch.stack(entries, -1).view(-1, 1, 3, 3)
    entries = (1 / fx, -skew / (fx * fy), (skew * cy / fy - cx) / fx, zero, 1 / fy, -cy / fy, zero, zero, one)
    B = torch.stack(entries, -1).view(-1, 1, 3, 3)
    return A @ poses[..., :3, :3] @ B, A @ poses[..., :3, 3:]


class _OnePass(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        M: Tensor,
        m: Tensor,
        target: Tensor,
        sources: Tensor,
        noise: Tensor | None,
        choices: Choices,
        *disparities: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        batch, count, _, height, width = sources.shape
        learns = any(ctx.needs_input_grad)
        to_disparities = [torch.empty_like(each) if learns else each for each in disparities]
        to_M, to_m = (each.new_zeros(len(disparities), *each.shape) for each in (M, m))
        values = target.new_zeros(len(disparities), batch)
        error, counted = target.new_empty(2, batch, 1, height, width)
        cameras, ssim = _Cameras(M, m, height, width), _Comparison(target, count, choices.ssim_weight, learns)
        for image in range(batch):
            ssim.look_at(target[image])
            still = None
            if choices.automask:
                errors = [ssim.error(source) for source in sources[image]]
                still = _combine(errors, None, choices.minimum)[0]
            for scale, disparity in enumerate(disparities):
                warp = cameras.warp(disparity[image, 0], image)
                warped = torch.grid_sampler_2d(sources[image], warp.pixels, 0, 1, True)
                errors = [ssim.error(each, place if learns else None) for place, each in enumerate(warped)]
                best, known, parts = _combine(errors, warp.visible() if choices.use_validity else None, choices.minimum)
                mask = known
                if still is not None:
                    tie = still if noise is None else still + noise[scale, image]
                    mask = torch.lt(best, tie, out=torch.empty_like(best)).mul_(known)
                best *= known
                weight = mask / (mask.sum().clamp(min=1) if choices.masked or still is None else mask.numel())
                values[scale, image] = torch.dot(best.flatten(), weight.flatten())
                if still is not None and not choices.masked:
                    values[scale, image] += ((1 - mask) * still).mean()
                if scale == 0:
                    error[image, 0], counted[image, 0] = best, mask
                if learns:
                    weight /= batch
                    for place, each in enumerate(warped):
                        ssim.slope(each, place, parts[place].mul_(weight))
                    moved = torch.ops.aten.grid_sampler_2d_backward(
                        ssim.gradient, sources[image], warp.pixels, 0, 1, True, [False, True]
                    )[1]
                    to_M[scale, image], to_m[scale, image] = warp.slope(moved, to_disparities[scale][image, 0])
        ctx.save_for_backward(to_M, to_m, *to_disparities)
        ctx.mark_non_differentiable(error, counted)
        return values.mean(1), error, counted

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        to_M, to_m, *to_disparities = ctx.saved_tensors
        M, m = ((grad[:, None, None, None, None] * each).sum(0) for each in (to_M, to_m))
        return M, m, None, None, None, None, *map(torch.mul, to_disparities, grad)


def _combine(
    errors: Sequence[Tensor], seen: Sequence[Tensor] | None, minimum: bool
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Return each pixel's error over its sources, where any counts, and each source's part in its gradient."""
    known = torch.ones_like(errors[0])
    if not minimum:
        parts = [torch.ones_like(each) for each in errors] if seen is None else [each.clone() for each in seen]
        total = torch.stack(parts).sum(0)
        known = total.clamp(max=1)
        parts = [part.div_(total.clamp(min=1)) for part in parts]
        return torch.stack([part * each for part, each in zip(parts, errors, strict=True)]).sum(0), known, parts
    if seen is not None:
        errors = [(1 - each).mul_(_UNSEEN).add_(error) for each, error in zip(seen, errors, strict=True)]
        known = functools.reduce(torch.maximum, seen)
    best = functools.reduce(torch.minimum, errors)
    left, parts = known.clone(), []
    for each in errors:  # of equal errors, the first source counts
        parts.append(torch.eq(each, best, out=torch.empty_like(best)).mul_(left))
        left -= parts[-1]
    return best, known, parts


class _Cameras:
    """The cameras of all images: M and m of every source, in double precision."""

    def __init__(self, M: Tensor, m: Tensor, height: int, width: int) -> None:
        self.M, self.m = M, m
        x, y = 2 / max(width - 1, 1), 2 / max(height - 1, 1)
        self.u, self.v = (torch.arange(size, dtype=torch.float64) for size in (width, height))
        self.limits = 1 + BORDER * x, 1 + BORDER * y
        self.behind = BEHIND * x - 1, BEHIND * y - 1

    def warp(self, disparity: Tensor, image: int) -> _Warp:
        return _Warp(disparity.clamp(min=1 / FAR), self, image)


class _Warp:
    """Where the sources see the pixels of one image, in `grid_sample`'s form: s h w (x y)."""

    def __init__(self, disparity: Tensor, cameras: _Cameras, image: int) -> None:
        self.disparity, self.cameras, self.image = disparity, cameras, image
        M, m = cameras.M[image, ..., None], cameras.m[image].squeeze(-1).tolist()
        across, down = M[:, :, 0] * cameras.u + M[:, :, 2], M[:, :, 1] * cameras.v
        seen = across[:, :, None].to(disparity) + down[..., None].to(disparity)
        for source, row in enumerate(m):
            for axis in range(3):
                seen[source, axis].add_(disparity, alpha=row[axis])
        self.grid, w = seen[:, :2], seen[:, 2]
        nearest = MIN_Z * disparity
        self.front = torch.gt(w, nearest, out=torch.empty_like(w))
        torch.maximum(w, nearest, out=w)
        self.grid.div_(w[:, None])
        lowest: Any = self.front.amin().tolist()
        total: Any = self.grid.sum().tolist()
        if lowest < 1 or not math.isfinite(total):
            for axis, place in enumerate(cameras.behind):  # NaN too, which must not reach the sampler
                self.grid[:, axis].mul_(self.front).add_(place - place * self.front).nan_to_num_(nan=place)
        self.inverse = w.reciprocal_()
        self.pixels = self.grid.permute(0, 2, 3, 1)

    def visible(self) -> list[Tensor]:
        inside = self.grid.abs()
        for axis, limit in enumerate(self.cameras.limits):
            inside[:, axis].le_(limit)
        return list(inside[:, 0].mul_(inside[:, 1]).mul_(self.front))

    def slope(self, moved: Tensor, to_disparity: Tensor) -> tuple[Tensor, Tensor]:
        """Set the gradient of disparity and return those of M and m, given that of ``pixels``, s h w 2."""
        count, height, width, _ = moved.shape
        h = moved.new_empty(count, 3, height, width)
        torch.mul(moved.permute(0, 3, 1, 2), self.inverse[:, None], out=h[:, :2])
        torch.mul(h[:, 0], self.grid[:, 0], out=h[:, 2])
        h[:, 2].addcmul_(h[:, 1], self.grid[:, 1]).neg_()
        to_disparity.zero_()
        for source, row in enumerate(self.cameras.m[self.image].squeeze(-1).tolist()):
            for axis in range(3):
                to_disparity.add_(h[source, axis], alpha=row[axis])
        rows, columns = h.sum(-1).double(), h.sum(-2).double()
        to_M = torch.stack((columns @ self.cameras.u, rows @ self.cameras.v, rows.sum(-1)), -1)
        to_m = torch.mv(h.view(count * 3, -1), self.disparity.flatten()).view(count, 3, 1)
        return to_M, to_m.double()


class _Comparison:
    """SSIM and absolute difference to one image, with the slopes for every source; the image's maps are computed once.

    With x and y about `_CENTER`, X and Y the box sums of these, and A and B those of the images themselves:
    n1 = 2 A B + C1, d1 = A^2 + B^2 + C1, n2 = 18 sum(x y) - 2 X Y + C2, d2 = 9 sum(x^2 + y^2) - X^2 - Y^2 + C2.
    """

    def __init__(self, like: Tensor, count: int, ssim_weight: float, learns: bool) -> None:
        shape = like.shape[1:]
        self.weight = ssim_weight
        self.kept = like.new_empty(count if learns else 1, 4, *shape)  # what each source's gradient needs
        self.stats, self.work = like.new_empty(7, *shape), like.new_empty(7, *shape)
        self.gradient = like.new_empty(count if learns else 0, *shape)
        self.C2 = like.new_full(shape[-1:], _C2 / 9)

    def look_at(self, target: Tensor) -> None:
        """Compare with this image, 3 h w, from now on."""
        self.target = target
        t18, double, twice, first, second, constant, square = self.stats
        y = torch.sub(target, _CENTER, out=self.work[1])
        torch.mul(y, 18, out=t18)
        torch.addcmul(self.C2, y, y, value=9, out=constant)
        Y = _box(y, double, self.work[0])
        torch.mul(Y, Y, out=square)
        B = torch.add(Y, 9 * _CENTER, out=self.work[0])
        torch.mul(B, 2, out=twice)
        torch.mul(twice, 9 * _CENTER, out=first).add_(_C1)
        torch.mul(B, B, out=second).add_(81 * _CENTER**2 + _C1)
        double.mul_(2)

    def error(self, image: Tensor, keep: int | None = None) -> Tensor:
        """Return the error of an image, h w; ``keep`` is the source whose slopes are kept."""
        difference, p, q, a = self.kept[keep or 0]
        product, squares, n1, d1, den, work, x = self.work
        error = torch.abs(torch.sub(image, self.target, out=difference), out=work).sum(0).mul_((1 - self.weight) / 3)
        if self.weight == 0:
            return error
        t18, double, twice, first, second, constant, square = self.stats
        torch.sub(image, _CENTER, out=x)
        X = _box(x, a, work)
        n2 = _box(torch.addcmul(self.C2, x, t18, out=den), product, work).addcmul_(X, double, value=-1)
        d2 = _box(torch.addcmul(constant, x, x, value=9, out=den), squares, work).addcmul_(X, X, value=-1).sub_(square)
        torch.addcmul(first, X, twice, out=n1)
        torch.addcmul(second, X, X, out=d1).add_(X, alpha=18 * _CENTER)
        torch.mul(d1, d2, out=den)
        torch.div(n1, den, out=p)  # SSIM is n1 n2 / (d1 d2). Its slope by the box sum of the products is 18 p,
        similarity = torch.mul(p, n2, out=n1)
        if keep is not None:
            torch.div(similarity, d2, out=q)  # by that of the squares -9 q,
            n2.div_(den)
            torch.div(similarity, d1, out=d1)
            torch.sub(p, n2, out=den).mul_(double).addcmul_(torch.sub(q, d1, out=work), X, value=-2)
            torch.add(den, d1.sub_(n2), alpha=18 * _CENTER, out=a)  # and by that of the image -a
        return error.add_(similarity.clamp_(-1, 1).sum(0).neg_().add_(3), alpha=self.weight / 6)

    def slope(self, image: Tensor, keep: int, grad: Tensor) -> None:
        """Set the ``gradient`` of a source's ``error(image, keep)``, given that of the error, h w."""
        difference, p, q, a = self.kept[keep]
        slope, box, work = self.gradient[keep], *self.work[:2]
        if self.weight == 0:
            slope.zero_()
        else:
            part = grad * (self.weight / 6)
            _box(a.mul_(part), slope, work, adjoint=True)
            slope.addcmul_(self.stats[0], _box(p.mul_(part), box, work, adjoint=True), value=-1)
            _box(q.mul_(part), box, work, adjoint=True)
            slope.addcmul_(image, box, value=18).add_(box, alpha=-18 * _CENTER)
        slope.addcmul_(difference.sign_(), grad, value=(1 - self.weight) / 3)


def _box(x: Tensor, out: Tensor, work: Tensor, adjoint: bool = False) -> Tensor:
    """Sum 3x3 windows with reflection padding into ``out``, or do the adjoint of that."""
    _sum_of_three(x, work, adjoint)
    return _sum_of_three(work.mT, out.mT, adjoint).mT


def _sum_of_three(x: Tensor, out: Tensor, adjoint: bool) -> Tensor:
    """Sum each element with its neighbors along the last dimension, of at least four elements."""
    last = x.shape[-1] - 1
    inner, ends, seconds = slice(1, last), slice(0, None, last), slice(1, last, last - 2)
    torch.add(x[..., :-2], x[..., inner], out=out[..., inner]).add_(x[..., 2:])
    torch.add(x[..., ends], x[..., seconds], alpha=1 if adjoint else 2, out=out[..., ends])
    if adjoint:
        out[..., seconds].add_(x[..., ends])
    return out
