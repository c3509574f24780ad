"""From decoded bytes to network input, on the device: crop, flip and color; intrinsics and ground truth follow.

The random numbers come with the batch (``draws``): a sample is augmented the same way with any number of devices or
workers, and nothing here waits for the device.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int, Shaped
from kornia.enhance import adjust_hue
from kornia.enhance.adjust import (
    adjust_brightness_accumulative,
    adjust_contrast_with_mean_subtraction,
    adjust_saturation_with_gray_subtraction,
)
from torch import Tensor, nn

from saunet.errors import DataError
from saunet.geometry.camera import crop_intrinsics, flip_intrinsics
from saunet.types import EvalBatch, FrameBatch, TrainBatch

Target = Literal["target_depth", "target_teacher", "target_mask"]
TARGETS: tuple[Target, ...] = ("target_depth", "target_teacher", "target_mask")
"""Maps at the size of the frames, which follow crops and flips."""
JITTER = 0.2  # factors of brightness, contrast and saturation are drawn from 1 ± this
HUE = 0.1  # largest change of hue, as a fraction of the color circle


def crop(
    maps: Shaped[Tensor, "b n c h w"], left: Int[Tensor, " b"], top: Int[Tensor, " b"], height: int, width: int
) -> Shaped[Tensor, "b n c {height} {width}"]:
    """Cut one window out of each sample's maps."""
    rows = top[:, None] + torch.arange(height, device=maps.device)
    columns = left[:, None] + torch.arange(width, device=maps.device)
    batch = torch.arange(len(maps), device=maps.device)
    picked = maps[batch[:, None, None], :, :, rows[:, :, None], columns[:, None, :]]  # b h w n c
    return picked.permute(0, 3, 4, 1, 2).contiguous()


def flip_some(maps: Shaped[Tensor, "b n c h w"], which: Bool[Tensor, " b"]) -> Shaped[Tensor, "b n c h w"]:
    """Mirror the chosen samples left to right."""
    return torch.where(which[:, None, None, None, None], maps.flip(-1), maps)


def flip_motion(T: Float[Tensor, "b s 4 4"], which: Bool[Tensor, " b"]) -> Float[Tensor, "b s 4 4"]:
    """Motion of the mirrored world, M T M with M = diag(-1, 1, 1, 1), for the chosen samples."""
    mirror = torch.ones(4, device=T.device, dtype=T.dtype)
    mirror[0] = -1
    return torch.where(which[:, None, None, None], T * mirror[:, None] * mirror, T)


def jitter_color(
    frames: Float[Tensor, "b n 3 h w"],
    which: Bool[Tensor, " b"],
    brightness: Float[Tensor, " b"],
    contrast: Float[Tensor, " b"],
    saturation: Float[Tensor, " b"],
    hue: Float[Tensor, " b"],
) -> Float[Tensor, "b n 3 h w"]:
    """Change the colors (RGB in [0, 1]) of the chosen samples; all frames of a sample change in the same way.

    Brightness, contrast and saturation are factors; hue is a rotation of the color circle, in radians. The frames of a
    sample are treated as one tall picture, so they even share the mean gray that contrast is relative to.
    """
    b, n, c, h, w = frames.shape
    tall = frames.transpose(1, 2).reshape(b, c, n * h, w)
    tall = adjust_brightness_accumulative(tall, brightness)
    tall = adjust_contrast_with_mean_subtraction(tall, contrast)
    tall = adjust_saturation_with_gray_subtraction(tall, saturation)
    tall = adjust_hue(tall, hue).clamp(0, 1)
    jittered = tall.reshape(b, c, n, h, w).transpose(1, 2)
    return torch.where(which[:, None, None, None, None], jittered, frames).contiguous()


class Augment(nn.Module):
    """`FrameBatch` with ``draws`` -> `TrainBatch`: random window, flip and colors, the same for all frames of a sample.

    The images for the loss keep their colors.
    """

    def __init__(self, height: int, width: int, flip_prob: float = 0.5, color_jitter_prob: float = 0.5) -> None:
        super().__init__()
        self.height, self.width = height, width
        self.flip_prob, self.color_jitter_prob = flip_prob, color_jitter_prob

    @torch.no_grad()
    def forward(self, batch: FrameBatch) -> TrainBatch:
        draws = batch["draws"]
        margin_y, margin_x = _margin(batch["frames"], self.height, self.width)
        top = (draws[:, 0] * (margin_y + 1)).long().clamp(max=margin_y)
        left = (draws[:, 1] * (margin_x + 1)).long().clamp(max=margin_x)
        mirrored = draws[:, 2] < self.flip_prob
        frames = flip_some(crop(batch["frames"], left, top, self.height, self.width), mirrored).float() / 255
        K = crop_intrinsics(batch["K"], left.float(), top.float())
        K = torch.where(mirrored[:, None, None], flip_intrinsics(K, self.width), K)
        signed = 2 * draws[:, 4:8] - 1
        brightness, contrast, saturation = (1 + JITTER * signed[:, :3]).unbind(1)
        jittered = draws[:, 3] < self.color_jitter_prob
        seen = jitter_color(frames, jittered, brightness, contrast, saturation, 2 * torch.pi * HUE * signed[:, 3])
        out = _split(seen, frames, K, batch["name"])
        for key in TARGETS:
            if key in batch:
                depth = crop(batch[key][:, None], left, top, self.height, self.width)
                out[key] = flip_some(depth, mirrored)[:, 0]
        if "T_src_tgt" in batch:
            out["T_src_tgt"] = flip_motion(batch["T_src_tgt"], mirrored)
        if "T_tracked" in batch:
            out["T_tracked"] = flip_motion(batch["T_tracked"], mirrored)
            points = batch["track_points"] - torch.stack([left, top, torch.zeros_like(top)], -1)[:, None, None]
            mirror = points.new_tensor([self.width - 1, 0, 0]) + points * points.new_tensor([-1, 1, 1])
            out["track_points"] = torch.where(mirrored[:, None, None, None], mirror, points)
        if "T_stereo_tgt" in batch:  # the other view of a mirrored image is on the other side
            out["T_stereo_tgt"] = flip_motion(batch["T_stereo_tgt"][:, None], mirrored)[:, 0]
        if "distance" in batch:
            out["distance"] = batch["distance"]
        return out  # type: ignore[return-value]


class Prepare(nn.Module):
    """`FrameBatch` -> `EvalBatch`: the central window, nothing random; ground truth stays at its native size."""

    def __init__(self, height: int, width: int) -> None:
        super().__init__()
        self.height, self.width = height, width

    @torch.no_grad()
    def forward(self, batch: FrameBatch) -> EvalBatch:
        margin_y, margin_x = _margin(batch["frames"], self.height, self.width)
        top, left = margin_y // 2, margin_x // 2
        window = (..., slice(top, top + self.height), slice(left, left + self.width))
        frames = batch["frames"][window].float() / 255
        out = _split(frames, frames, crop_intrinsics(batch["K"], left, top), batch["name"])
        for target in TARGETS:
            if target in batch:
                out[target] = batch[target][window].contiguous()
        if "track_points" in batch:
            out["track_points"] = batch["track_points"] - batch["K"].new_tensor([left, top, 0])
        for key in ("T_src_tgt", "T_tracked", "T_stereo_tgt", "distance", "depth", "depth_size"):
            if key in batch:
                out[key] = batch[key]
        return out  # type: ignore[return-value]


def _margin(frames: Tensor, height: int, width: int) -> tuple[int, int]:
    rows, columns = frames.shape[-2:]
    if rows < height or columns < width:
        raise DataError(
            f"frames of {rows}x{columns} are smaller than the {height}x{width} images to cut from them; load them "
            "larger"
        )
    return rows - height, columns - width


def _split(seen: Tensor, compared: Tensor, K: Tensor, name: list[str]) -> dict[str, Any]:
    return {
        "target": seen[:, 0],
        "sources": seen[:, 1:],
        "loss_target": compared[:, 0],
        "loss_sources": compared[:, 1:],
        "K": K,
        "name": name,
    }
