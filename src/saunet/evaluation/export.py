"""Predictions as the KITTI benchmark wants them: 16-bit PNG, meters x 256, at the size of the original image."""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from saunet.evaluation.foreign import file_stem
from saunet.evaluation.runner import Predictor, truths_of
from saunet.io.colormaps import depth_to_png16
from saunet.io.images import write_image
from saunet.metrics.protocols import Protocol, resize_disparity, sample_image
from saunet.types import EvalBatch


class ExportingPredictor:
    """A predictor that also writes what it predicts, one PNG an image, named by its `file_stem`.

    The folder can be scored again (``predictions=FOLDER match=name``) with the same result, up to the PNG's 1/256 m.

    Args:
        predict: The predictor.
        folder: Where files go; made if missing.
        protocol: Its factor, its scaling and its limits make depth of disparity. With median scaling an image needs
            ground truth, and one that has none is not written.
    """

    def __init__(self, predict: Predictor, folder: Path, protocol: Protocol) -> None:
        self.predict, self.folder, self.protocol = predict, folder, protocol
        self.written = self.left_out = 0

    def __call__(self, batch: EvalBatch) -> Float[Tensor, "b 1 h w"]:
        """Return the disparity of the batch's images, having written their depth.

        Raises:
            DataError: if a file cannot be written.
        """
        disparity = self.predict(batch)
        for name, image, truth in zip(batch["name"], disparity[:, 0].cpu(), truths_of(batch), strict=True):
            depth = self._depth(image, truth.cpu())
            if depth is None:
                self.left_out += 1
                continue
            write_image(self.folder / f"{file_stem(name)}.png", depth_to_png16(depth.numpy()))
            self.written += 1
        return disparity

    def __str__(self) -> str:
        rest = f", {self.left_out} left out that have no ground truth to be scaled by" if self.left_out else ""
        return f"export: {self.written} images as '{self.protocol.name}' scales them{rest}; in {self.folder}"

    def _depth(self, disparity: Float[Tensor, "h w"], truth: Float[Tensor, "hg wg"]) -> Float[Tensor, "_ _"] | None:
        rules = self.protocol
        sample = sample_image(disparity, truth, rules)
        if rules.scaling == "median" and sample.target.numel() == 0:
            return None
        size = (truth.shape[0], truth.shape[1]) if truth.numel() > 1 else (disparity.shape[0], disparity.shape[1])
        factor = rules.factor * (float(sample.ratio) if rules.scaling == "median" else 1.0)
        depth = factor / resize_disparity(disparity, size).double()
        return torch.clamp(depth, rules.min_depth, rules.max_depth)
