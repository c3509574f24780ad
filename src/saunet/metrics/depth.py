"""The depth errors as one torchmetrics metric of plain sums, so results are exact for any split over processes."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torchmetrics import Metric

from saunet.errors import DataError, checked
from saunet.metrics.functional import ERROR_NAMES
from saunet.metrics.protocols import Protocol, evaluate_image
from saunet.metrics.protocols import protocol as named_protocol


@checked
class DepthMetrics(Metric):
    """Mean over images of the seven depth errors (Eigen et al., 2014) under a protocol.

    An image without ground-truth pixels to compare is counted (``images_without_truth``) but does not affect the means.

    Examples:
        >>> metrics = saunet.DepthMetrics("synthetic")
        >>> metrics.update(torch.full((1, 1, 4, 6), 0.5), torch.full((1, 1, 8, 12), 10.0), torch.tensor([[8, 12]]))
        >>> {name: round(value.item(), 3) for name, value in metrics.compute().items() if name in ("abs_rel", "scale")}
        {'abs_rel': 0.0, 'scale': 5.0}

    Args:
        protocol: A protocol or the name of one.

    Raises:
        ConfigError: for an unknown protocol name.
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    error_sum: Tensor
    ratio_sum: Tensor
    ratio_square_sum: Tensor
    images: Tensor
    images_without_truth: Tensor

    def __init__(self, protocol: Protocol | str = "eigen_camera_z") -> None:
        super().__init__()
        self.protocol = named_protocol(protocol) if isinstance(protocol, str) else protocol
        for name, size in (("error_sum", (7,)), ("ratio_sum", ()), ("ratio_square_sum", ())):
            self.add_state(name, torch.zeros(size, dtype=torch.float64), dist_reduce_fx="sum")
        for name in ("images", "images_without_truth"):
            self.add_state(name, torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(
        self, disparity: Float[Tensor, "b 1 h w"], depth: Float[Tensor, "b 1 hg wg"], depth_size: Int[Tensor, "b 2"]
    ) -> None:
        """Add the images of a batch.

        Args:
            disparity: Predicted inverse depth at network size.
            depth: Ground truth in meters, 0 where unknown, padded to a common size.
            depth_size: Native (height, width) of each ground truth inside the padding; (0, 0) for an image without any.

        Raises:
            DataError: if the number of ground truths differs from that of images, or a native size exceeds the padded
                one.
        """
        for prediction, truth in zip(disparity, native_depths(depth, depth_size, len(disparity)), strict=True):
            image = evaluate_image(prediction[0], truth, self.protocol)
            # Not in place: states made under inference mode (trainer.validate) must be usable in training afterwards.
            if image.pixels == 0:
                self.images_without_truth = self.images_without_truth + 1
                continue
            self.images = self.images + 1
            self.error_sum = self.error_sum + image.errors
            self.ratio_sum = self.ratio_sum + image.ratio
            self.ratio_square_sum = self.ratio_square_sum + image.ratio.square()

    def compute(self) -> dict[str, Float[Tensor, ""]]:
        """Return the mean of each error, float64, and further statistics.

        Keys are `ERROR_NAMES`, then ``scale`` and ``scale_std`` (mean and standard deviation over images of the factor
        on the depth; without alignment, of median(truth)/median(prediction)), ``images`` and ``images_without_truth``.
        Means over no images are NaN.
        """
        count = self.images.double()
        errors = self.error_sum / count
        scale = self.ratio_sum / count
        variance = self.ratio_square_sum / count - scale.square()
        return {
            **dict(zip(ERROR_NAMES, errors.unbind(), strict=True)),
            "scale": scale,
            "scale_std": variance.clamp(min=0).sqrt(),
            "images": count,
            "images_without_truth": self.images_without_truth.double(),
        }


def native_depths(
    depth: Float[Tensor, "b 1 hg wg"], depth_size: Int[Tensor, "b 2"], images: int
) -> list[Float[Tensor, "_ _"]]:
    """Cut each ground truth of a batch out of its padding (bottom and right)."""
    if len(depth) != images or len(depth_size) != images:
        raise DataError(
            f"got {images} predictions, {len(depth)} ground truths and {len(depth_size)} sizes; give one of each for "
            "every image"
        )
    cut = []
    for padded, (height, width) in zip(depth[:, 0], depth_size.tolist(), strict=True):
        if not (0 <= height <= padded.shape[0] and 0 <= width <= padded.shape[1]):
            raise DataError(
                f"ground truth size {height}x{width} (height x width) does not fit into its padded map "
                f"{padded.shape[0]}x{padded.shape[1]}; give depth_size as (height, width)"
            )
        cut.append(padded[:height, :width])
    return cut
