"""Predictors to score: a depth network, or another system's predictions in files; and exporting predictions."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor, nn

from saunet.errors import DataError
from saunet.io.colormaps import depth_to_png16
from saunet.io.images import natural_order, read_depth, write_image
from saunet.io.plain import read_array
from saunet.metrics.depth import native_depths
from saunet.metrics.functional import flip_blend
from saunet.metrics.protocols import Protocol, aligned_depth, resize_disparity, sample_image
from saunet.prediction.foreign import ForeignPredictor
from saunet.prediction.prediction import ImagePredictor
from saunet.types import DepthPyramid, EvalBatch

Predictor: TypeAlias = Callable[[EvalBatch], Tensor]
"""Gives the disparity (1/meter up to scale) of a batch, b x 1 x any height x any width."""
Motion: TypeAlias = Callable[[EvalBatch, Tensor], Tensor]
"""Gives ``T_src_tgt`` of a batch's sources, b x s x 4 x 4, in the unit of its predicted depth, b x 1 x h x w; NaN where
unknown."""
SUFFIXES: tuple[str, ...] = (".npy", ".png")
"""Files that are read from a folder: arrays, and 16-bit PNG with values x 256 (KITTI's format)."""


class NetworkPredictor:
    """Make a depth network or a trivial predictor scorable; it is put into evaluation mode.

    ``flip`` also predicts the mirrored image and blends: slower and slightly better.
    """

    def __init__(self, network: nn.Module, flip: bool = False) -> None:
        self.network, self.flip = network.eval(), flip

    @torch.inference_mode()
    def __call__(self, batch: EvalBatch) -> Tensor:
        image = batch["target"]
        disparity = self._disparity(image)
        return flip_blend(disparity, self._disparity(image.flip(-1))) if self.flip else disparity

    def _disparity(self, image: Tensor) -> Tensor:
        output = self.network(image)
        return output.disparity[0] if isinstance(output, DepthPyramid) else output


class PredictorNetwork(nn.Module):
    """A predictor of single images, such as one that runs an ONNX file, as a network of disparity in its unit.

    Images of another size are first resized to the predictor's, as when it predicts a file; disparity has that size.
    """

    def __init__(self, predictor: ImagePredictor) -> None:
        super().__init__()
        self.predictor = predictor

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 _ _"]:
        predictor, size = self.predictor, self.predictor.input_size(*image.shape[-2:])
        if image.shape[-2:] != size:
            image = F.interpolate(image.float(), size, mode="bilinear", antialias=True)
        images = image.float().cpu().numpy()
        raw = predictor.raw_disparity if isinstance(predictor, ForeignPredictor) else predictor.disparity
        disparity = raw(images)
        factor = predictor.scale.factor if predictor.scale else 1.0
        return torch.from_numpy(disparity / np.float32(factor))[:, None].to(image.device)


class FilePredictor:
    """Predictions of another system, read from files when needed.

    Args:
        path: A ``.npy`` array, images x height x width (a channel of 1 is accepted), such as Monodepth2's
            ``disps_eigen_split.npy``; or a folder with one file per image, ``.npy`` (height x width) or 16-bit ``.png``
            (values x 256).
        names: The images in the order of the predictions; those without ground truth are not evaluated.
        values: ``disparity`` (up to scale) or ``depth``; by default disparity in an array and depth in a folder.
        match: How files of a folder are assigned to images: ``order`` sorts them by the numbers in their names,
            ``name`` looks for the `file_stem` of each image's name.
    """

    def __init__(self, path: Path, names: Sequence[str] = (), values: str | None = None, match: str = "order") -> None:
        found: Sequence[Path] | ndarray = _files(path) if existing(path).is_dir() else _images(path)
        self.path, self.values = path, values or ("depth" if path.is_dir() else "disparity")
        self._by_stem = path.is_dir() and match == "name"
        if not self._by_stem and len(found) != len(names):
            raise DataError(
                f"'{path}' holds {len(found)} predictions for {len(names)} images; give one for each image, in the "
                "same order"
            )
        keys = [file.stem for file in found] if self._by_stem else names
        self._found: dict[str, Path | ndarray] = dict(zip(keys, found, strict=True))

    def __call__(self, batch: EvalBatch) -> Float[Tensor, "b 1 h w"]:
        """Return the disparity of the batch's images; they must be of one size."""
        maps = [self._read(name) for name in batch["name"]]
        if len({one.shape for one in maps}) > 1:
            raise DataError(f"predictions of one batch in '{self.path}' differ in size; evaluate with batch size 1")
        return torch.stack(maps)

    def _read(self, name: str) -> Float[Tensor, "1 h w"]:
        stem = file_stem(name)
        source = self._found.get(stem if self._by_stem else name)
        if source is None and self._by_stem:
            raise DataError(
                f"'{self.path}' has no file '{stem}.npy' or '.png' for image '{name}'; rename the files, or use the "
                "order of the images (match=order)"
            )
        if source is None:
            raise DataError(f"'{self.path}' has no prediction for image '{name}'; it belongs to another split")
        if not isinstance(source, Path):
            return self._disparity(np.array(source, dtype=np.float32), self.path)
        if source.suffix.lower() == ".png":
            return self._disparity(read_depth(source), source)
        array = np.squeeze(np.array(_load_array(source), dtype=np.float32))
        if array.ndim != 2:
            raise DataError(f"'{source}' holds shape {array.shape}; a prediction is height x width")
        return self._disparity(array, source)

    def _disparity(self, values: ndarray, path: Path) -> Float[Tensor, "1 h w"]:
        if self.values == "disparity":
            if (values <= 0).all():  # it would score like constant depth
                raise DataError(
                    f"'{path}' has an image without disparity above 0; disparity is 1/depth, so give positive "
                    "numbers (predicted=depth for depth)"
                )
            return torch.from_numpy(values)[None]
        if not (values > 0).all():
            raise DataError(f"'{path}' has pixels without valid depth (0, negative or NaN); predictions must be dense")
        return torch.from_numpy(1 / values)[None]


class ExportingPredictor:
    """A predictor that also writes its predictions, one 16-bit PNG per image (KITTI's format), named by `file_stem`.

    The folder can be scored again (``predictions=FOLDER match=name``) with the same result, up to the PNG's 1/256 m.
    The protocol's factor, alignment and limits turn disparity into depth. An alignment needs ground truth, so images
    without any are not written.
    """

    def __init__(self, predict: Predictor, folder: Path, protocol: Protocol) -> None:
        self.predict, self.folder, self.protocol = predict, folder, protocol
        self.written = self.left_out = 0

    def __call__(self, batch: EvalBatch) -> Float[Tensor, "b 1 h w"]:
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
        rest = f", {self.left_out} left out because they have no ground truth for scaling" if self.left_out else ""
        return f"export: {self.written} images, scaled as in '{self.protocol.name}'{rest}; in {self.folder}"

    def _depth(self, disparity: Float[Tensor, "h w"], truth: Float[Tensor, "hg wg"]) -> Float[Tensor, "_ _"] | None:
        rules = self.protocol
        sample = sample_image(disparity, truth, rules)
        if rules.alignment != "none" and sample.target.numel() == 0:
            return None
        size = (truth.shape[0], truth.shape[1]) if truth.numel() > 1 else (disparity.shape[0], disparity.shape[1])
        return aligned_depth(resize_disparity(disparity, size).double(), sample.ratio, sample.shift, rules)


def truths_of(batch: EvalBatch) -> list[Float[Tensor, "_ _"]]:
    """Return the ground truth of each image at its native size, meters, 0 where unknown; one such pixel without any."""
    if "depth" not in batch:
        return [batch["target"].new_zeros(1, 1) for _ in batch["name"]]
    if "depth_size" not in batch:
        raise DataError(f"image '{batch['name'][0]}' comes with depth but without depth_size; give its (height, width)")
    return native_depths(batch["depth"], batch["depth_size"], len(batch["name"]))


def existing(path: Path) -> Path:
    if not path.exists():
        raise DataError(f"no predictions at '{path}'; give a .npy array or a folder of .npy or .png files")
    return path


def file_stem(name: str) -> str:
    """Return an image's file name without ending: everything but letters, digits, - and . becomes ``_``."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", name)


def _files(folder: Path) -> list[Path]:
    files = sorted((file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES), key=natural_order)
    if not files:
        raise DataError(f"'{folder}' holds no prediction; its files must end in {' or '.join(SUFFIXES)}")
    return files


def _images(path: Path) -> ndarray:
    array = _load_array(path)
    if array.ndim == 4 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != 3:
        raise DataError(f"'{path}' holds shape {array.shape}; predictions are images x height x width")
    return array


def _load_array(path: Path) -> ndarray:
    try:
        array: ndarray = read_array(path, mapped=True)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"cannot read '{path}' as a numpy array ({error}); give a .npy file of numbers") from error
    if not isinstance(array, ndarray) or array.dtype.kind != "f":
        raise DataError(f"'{path}' does not contain floating-point numbers; give a .npy file of disparity or depth")
    return array
