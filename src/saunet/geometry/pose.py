"""Rigid motions, without matrix products: on a GPU these may run in TF32 (ten bits), which moves pixels visibly."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from saunet.geometry import full_precision

_SMALL_ANGLE_SQUARED = 1e-2
_FAR_OFF = 1.0
"""Points with a larger logarithm of the depth ratio do not count."""


@full_precision
def axisangle_to_matrix(axisangle: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotations of axis-angle vectors, also exact near angle 0, where the textbook formula is 0 / 0."""
    squared = axisangle.square().sum(-1)
    small = squared < _SMALL_ANGLE_SQUARED
    # The branch not taken must be finite too: its gradient is multiplied by zero, and 0 * inf is NaN.
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    series = torch.where(small, squared, torch.zeros_like(squared))
    sin_over_angle = torch.where(
        small, 1 - series / 6 * (1 - series / 20 * (1 - series / 42 * (1 - series / 72))), angle.sin() / angle
    )
    # (1 - cos a) / a^2 = 2 sin^2(a/2) / a^2, which does not cancel.
    versine = torch.where(
        small,
        0.5 - series / 24 * (1 - series / 30 * (1 - series / 56 * (1 - series / 90))),
        2 * (angle / 2).sin().square() / angle.square(),
    )
    x, y, z = axisangle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), dim=-1).reshape(*x.shape, 3, 3)
    outer = axisangle[..., :, None] * axisangle[..., None, :]
    eye = torch.eye(3, dtype=axisangle.dtype, device=axisangle.device)
    cosine = (1 - versine * squared)[..., None, None]
    rotation: Tensor = cosine * eye + sin_over_angle[..., None, None] * cross + versine[..., None, None] * outer
    return rotation


@full_precision
def pose_matrix(
    axisangle: Float[Tensor, "*b 3"], translation: Float[Tensor, "*b 3"], invert: bool = False
) -> Float[Tensor, "*b 4 4"]:
    """Rigid motion that rotates, by Rodrigues' formula, then translates.

    Args:
        axisangle: Axis times angle, radians.
        translation: Meters (up to the scale ambiguity of monocular training).
        invert: Return the inverse motion instead.

    Returns:
        4x4 matrices.

    Examples:
        >>> forward = saunet.pose_matrix(torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        >>> forward @ torch.tensor([0.0, 0.0, 5.0, 1.0])
        tensor([0., 0., 6., 1.])
    """
    pose = _assemble(axisangle_to_matrix(axisangle), translation)
    return invert_pose(pose) if invert else pose


@full_precision
def invert_pose(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Inverse of rigid motions: ``T_src_tgt`` becomes ``T_tgt_src``.

    Args:
        T: 4x4 rigid motions (rotation and translation only).

    Returns:
        Their inverses.

    Examples:
        >>> T = saunet.pose_matrix(torch.tensor([0.0, 0.1, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
        >>> torch.allclose(saunet.invert_pose(T) @ T, torch.eye(4))
        True
    """
    rotation, translation = T[..., :3, :3], T[..., :3, 3]
    return _assemble(rotation.transpose(-1, -2), -(rotation * translation[..., :, None]).sum(-2))


@full_precision
def scaled_motion(
    T: Float[Tensor, "b s 4 4"], points: Float[Tensor, "b s n 3"], depth: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b s 4 4"]:
    """Scale translations of length 1 so that points move as a depth map says.

    The length is the one whose parallax, length / depth, best fits that of the points, 1 / z: near points count most,
    as in images. Points with a ratio far from the median do not count (Tukey's weights). The length is differentiable
    in depth, so a depth map times a factor explains images equally well: otherwise depth would chase the motion and
    keep shrinking.

    Args:
        T: Motions T_src_tgt, NaN where unknown.
        points: Pixel column and row in the target, and depth in lengths of the translation; NaN if missing.
        depth: Depth of the target, which defines the unit.

    Returns:
        Motions in the unit of ``depth``; NaN where T is NaN, or no point with a depth lies in the picture.
    """
    height, width = depth.shape[-2:]
    column, row, z = points.unbind(-1)
    inside = (column > -0.5) & (column < width - 0.5) & (row > -0.5) & (row < height - 0.5)  # false for NaN
    place = torch.where(inside, row.round() * width + column.round(), 0).long()
    found = depth.flatten(1)[:, None].expand(-1, points.shape[1], -1).gather(-1, place)
    found, z = torch.where(inside, found, 1.0), torch.where(inside, z, 1.0)
    ratio = torch.where(inside, (found / z).log(), torch.nan).detach()
    off = (ratio - ratio.nanmedian(-1, keepdim=True).values) / _FAR_OFF
    weight = (1 - off.square()).clamp(min=0).square().where(inside, 0.0)
    parallax = (weight / found**2).sum(-1)
    told = parallax > 0
    length = (weight / (found * z)).sum(-1) / parallax.where(told, 1.0)
    still, known = (T[..., :3, 3] == 0).all(-1), T.isfinite().flatten(-2).all(-1)
    # NaN must not multiply anything learned: a gradient of 0 times NaN is NaN.
    T = torch.where(known[..., None, None], T, 0.0)
    scaled = _assemble(T[..., :3, :3], T[..., :3, 3] * length.where(told & ~still, 0.0)[..., None])
    return torch.where((known & (told | still))[..., None, None], scaled, torch.nan)


def _assemble(rotation: Tensor, translation: Tensor) -> Tensor:
    top = torch.cat((rotation, translation[..., None]), dim=-1)
    zeros = torch.zeros_like(rotation[..., :1, :])  # built on the device: copying constants there would wait for it
    last = torch.cat((zeros, torch.ones_like(zeros[..., :1])), dim=-1)
    return torch.cat((top, last), dim=-2)
