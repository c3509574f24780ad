"""Prediction with PyTorch: ``Predictor.from_checkpoint("last.ckpt").predict("road.png").depth``."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from saunet.errors import checked, usable_device
from saunet.metrics.functional import flip_blend
from saunet.models.depth import DepthNet
from saunet.prediction.prediction import ImagePredictor
from saunet.runs.record import Scale
from saunet.weights.files import read_model


@checked
class Predictor(ImagePredictor):
    """Predicts depth with a depth network; the network is moved to ``device`` and set to evaluation.

    Args:
        depth_net: The network.
        height: Height of the network's input in pixels.
        width: Width of the network's input in pixels.
        device: Where to run, such as ``"cpu"`` or ``"cuda"``.
        scale: Factor to meters; None leaves depth relative.
        flip: Average with the prediction of the mirrored image (twice the time, slightly less error).
        keep_aspect: Keep each image's aspect ratio, at about height x width pixels instead of exactly that size.

    Examples:
        >>> saunet.Predictor.from_checkpoint("last.ckpt").predict("road.png").disparity.dtype
        dtype('float32')
    """

    def __init__(
        self,
        depth_net: DepthNet,
        height: int,
        width: int,
        device: str | torch.device = "cpu",
        scale: Scale | None = None,
        flip: bool = False,
        keep_aspect: bool = False,
    ) -> None:
        super().__init__(height, width, scale, keep_aspect, depth_net.size_divisor)
        self.device = usable_device(device)
        self.network = depth_net.to(self.device).eval()
        self.flip = flip

    @classmethod
    def from_checkpoint(
        cls, path: str | Path, device: str | torch.device = "cpu", flip: bool = False, keep_aspect: bool = False
    ) -> Predictor:
        """Load a trained model, a checkpoint or an exported folder; no code in the file is run.

        Args:
            path: A checkpoint file, or a folder that ``saunet export`` wrote.
            device: Where the network runs.
            flip: Also predict the mirrored image and blend: slower and slightly better.
            keep_aspect: Keep the shape of images instead of stretching them to the size of the training.

        Raises:
            CheckpointError: if the file is missing, broken, or not a saunet checkpoint.
            ConfigError: if the device does not exist.
        """
        checkpoint = read_model(path)
        depth, _ = checkpoint.networks()
        record = checkpoint.record
        return cls(depth, record.height, record.width, device, record.scale, flip, keep_aspect)

    def disparity(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b h w"]:
        """Run the network: RGB in [0, 1] to disparity at the same size, before any scale."""
        with torch.inference_mode():
            batch = torch.from_numpy(images).to(self.device)
            disparity = self.network(batch).disparity[0].float()
            if self.flip:
                disparity = flip_blend(disparity, self.network(batch.flip(-1)).disparity[0].float())
            return np.asarray(disparity[:, 0].cpu().numpy())

    @functools.cached_property
    def weights_hash(self) -> str:
        """The SHA-256 of the weights."""
        digest = hashlib.sha256()
        for name, value in sorted(self.network.state_dict().items()):
            digest.update(name.encode())
            digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())
        return digest.hexdigest()

    @property
    def fingerprint(self) -> str:
        """A short hash of the weights and of all settings that change results, including the scale."""
        factor = self.scale.factor if self.scale else None
        settings = (self.weights_hash, self.height, self.width, self.flip, self.keep_aspect, factor)
        return hashlib.sha256(repr(settings).encode()).hexdigest()[:16]
