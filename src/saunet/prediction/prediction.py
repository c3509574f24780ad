"""From any image to depth at its own size: predictions, and all of predicting except the network; no torch."""

from __future__ import annotations

import abc
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from saunet.errors import CheckpointError, ConfigError, DataError, checked, divisible, positive
from saunet.io.atomic import write_bytes
from saunet.io.colormaps import colorize
from saunet.io.display import display
from saunet.io.images import IMAGE_SUFFIXES, as_rgb_bytes, encode_png, network_input, read_image, write_image
from saunet.runs.record import Scale, unit_of
from saunet.weights.locate import locate

if TYPE_CHECKING:
    from saunet.prediction.foreign import ForeignOptions
    from saunet.prediction.pointcloud import Camera, PointCloud

ImageLike = Any
"""A path, an h x w x 3 RGB array (bytes; gray, RGBA and 16-bit too), a PIL image, or a 3 x h x w tensor."""


@checked
@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Depth of one image, at that image's size; a notebook shows the picture beside its depth.

    Args:
        depth: Depth along the camera's z axis; see ``unit``.
        disparity: Its inverse.
        image: The image it belongs to, RGB.
        scale: The factor that has been applied to get meters; None if depth is only relative.
        name: Where the image came from, such as a file name.

    Examples:
        >>> prediction = saunet.load("last.ckpt").predict("road.png")
        >>> prediction.depth.shape, prediction.color().shape
        ((96, 160), (96, 160, 3))
        >>> prediction.save("road_depth.html")  # depth under the cursor; .png has colors, .npy the numbers
        >>> prediction.point_cloud(90).save("road.ply")  # a camera that sees 90 degrees from left to right
    """

    depth: Float32[np.ndarray, "h w"]
    disparity: Float32[np.ndarray, "h w"]
    image: UInt8[np.ndarray, "h w 3"] = field(repr=False)
    scale: Scale | None = None
    name: str = "image"

    @property
    def metric(self) -> bool:
        """Whether ``depth`` is in meters."""
        return self.scale is not None

    @property
    def unit(self) -> str:
        """The unit of ``depth``, in words."""
        return unit_of(self.scale)

    def color(self, limits: tuple[float, float] | None = None, colormap: str = "magma") -> UInt8[np.ndarray, "h w 3"]:
        """Return the disparity as an RGB picture, bright where it is near; see `saunet.io.colormaps.colorize`."""
        return colorize(self.disparity, limits, colormap)

    @property
    def range(self) -> tuple[float, float]:
        """Depth that 1 % of the pixels are nearer than, and depth that 1 % are farther than."""
        low, high = np.quantile(self.depth[np.isfinite(self.depth)], (0.01, 0.99))
        return float(low), float(high)

    def point_cloud(
        self,
        camera: Camera | Sequence[float | int] | float | int | str | Path,
        max_depth: float | int | None = None,
        edge: float | int = 0.1,
    ) -> PointCloud:
        """Return the pixels as colored points in space.

        Pixels at depth edges that would float between a near and a far surface are left out, about a twentieth of a
        street scene.

        Args:
            camera: The camera's intrinsics: a camera.yaml; fx, fy, cx, cy in pixels of this image; the nine numbers of
                K; or one number, the horizontal field of view in degrees.
            max_depth: Leave out points that are farther, in the unit of ``depth``.
            edge: Leave out points whose depth differs by more than this fraction from the surfaces on both sides of an
                edge; 0 keeps all.

        Returns:
            The points, n x 3; `PointCloud.save` writes them.

        Raises:
            ConfigError: if the camera cannot belong to this image.
            DataError: if camera.yaml cannot be read.
        """
        from saunet.prediction.pointcloud import camera_of, point_cloud

        return point_cloud(self, camera_of(camera, *self.depth.shape), max_depth=max_depth, edge=edge)

    def save(self, path: str | Path) -> None:
        """Write depth as float32 (``.npy``), disparity in colors (``.png``, ``.jpg``, ...), or a page (``.html``).

        The page shows image and disparity, and the depth under the cursor; it needs nothing but a browser.

        Raises:
            ConfigError: for any other suffix.
        """
        suffix = Path(path).suffix.lower()
        if suffix == ".npy":
            buffer = io.BytesIO()
            np.save(buffer, self.depth)
            write_bytes(path, buffer.getvalue())
        elif suffix == ".html":
            from saunet.prediction.page import depth_page

            write_bytes(path, depth_page(self).encode())
        elif suffix in (".ply", ".pcd"):
            raise ConfigError(f"{path} is for points; use .point_cloud(camera).save('{Path(path).stem}.ply')")
        elif suffix not in IMAGE_SUFFIXES:
            allowed = ", ".join((".npy", ".html", *sorted(IMAGE_SUFFIXES)))
            raise ConfigError(f"the suffix of {Path(path).name} is '{suffix}', allowed: {allowed}")
        else:
            write_image(path, self.color())

    def __repr__(self) -> str:
        height, width = self.depth.shape
        low, high = np.nanmin(self.depth), np.nanmax(self.depth)
        name = f"{self.name}: " if self.name else ""
        return f"Prediction({name}{width} x {height}, depth {low:.3g} to {high:.3g}, {self.unit})"

    def show(self) -> None:
        """Show image and disparity in the notebook; elsewhere open the page of `save` in the browser."""
        from saunet.prediction.page import depth_page

        display(self, lambda: depth_page(self))

    def _repr_png_(self) -> bytes:
        pair = np.concatenate([self.image, self.color()], axis=0)
        return encode_png(pair)

    def _repr_html_(self) -> str:
        from saunet.prediction.page import depth_figure

        return depth_figure(self)


class ImagePredictor(abc.ABC):
    """Predicts depth for images of any size: resized in, restored out.

    Args:
        height: Height of the network's input in pixels.
        width: Width of the network's input in pixels.
        scale: Factor to meters; None leaves depth relative.
        keep_aspect: Keep each image's aspect ratio, at about height x width pixels instead of exactly that size.
        size_divisor: The sides of the network's input must be multiples of this.
    """

    undistort: Callable[[UInt8[np.ndarray, "_ _ 3"]], UInt8[np.ndarray, "_ _ 3"]] | None = None
    """Applied to every image first; predictions are of the image that it returns."""
    undistorted_by: str | None = None
    """The camera to undistort; None without one."""
    source: str = ""
    """The file it was loaded from."""

    def __init__(
        self, height: int, width: int, scale: Scale | None = None, keep_aspect: bool = False, size_divisor: int = 1
    ) -> None:
        positive("height", height)
        positive("width", width)
        divisible(height, width, size_divisor, what="network input")
        self.height, self.width, self.scale = height, width, scale
        self.keep_aspect, self.size_divisor = keep_aspect, size_divisor

    def __repr__(self) -> str:
        source = f"{self.source}: " if self.source else ""
        facts = [f"input {self.width} x {self.height}", self.unit.partition(" (")[0], str(getattr(self, "device", ""))]
        return f"{type(self).__name__}({source}{', '.join(filter(None, facts))})"

    @abc.abstractmethod
    def disparity(self, images: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b h w"]:
        """Run the network: RGB in [0, 1] to disparity at the same size, before any scale."""

    @property
    @abc.abstractmethod
    def fingerprint(self) -> str:
        """A short text that changes with the weights and with everything that changes results."""

    @property
    def unit(self) -> str:
        """The unit of predicted depth, in words."""
        return unit_of(self.scale)

    def predict(self, image: ImageLike, name: str | None = None) -> Prediction:
        """Predict the depth of one image.

        Args:
            image: A path, an h x w x 3 RGB array of bytes, a PIL image, or a 3 x h x w tensor (bytes, or floats in
                [0, 1]).
            name: Name of the image; the path by default.

        Raises:
            DataError: if the image cannot be read, or its shape or type is not that of an image.
            CheckpointError: if the network's output is not finite.
        """
        return self.predict_batch([image], [name] if name is not None else None)[0]

    def predict_batch(self, images: Sequence[ImageLike], names: Sequence[str] | None = None) -> list[Prediction]:
        """Predict images, each at its own size, in as few runs of the network as possible; see `predict`."""
        arrays = [as_image(image) for image in images]
        if self.undistort is not None:
            arrays = [self.undistort(array) for array in arrays]
        titles = names or [str(image) if isinstance(image, str | Path) else "image" for image in images]
        groups: dict[tuple[int, int], list[int]] = {}
        for index, array in enumerate(arrays):
            groups.setdefault(self.input_size(*array.shape[:2]), []).append(index)
        results: dict[int, Prediction] = {}
        for size, members in groups.items():
            batch = np.stack([network_input(arrays[index], *size) for index in members])
            for index, disparity in zip(members, self.disparity(batch), strict=True):
                results[index] = self._restore(disparity, arrays[index], titles[index])
        return [results[index] for index in range(len(arrays))]

    def input_size(self, height: int, width: int) -> tuple[int, int]:
        """Return the (height, width) at which the network gets an image of this size."""
        if not self.keep_aspect:
            return self.height, self.width
        zoom, step = math.sqrt(self.height * self.width / (height * width)), self.size_divisor
        longest = 4 * max(self.height, self.width)  # a 1 x 1000 image must not become a kilometer of pixels
        rows, columns = (min(longest, max(step, step * round(side * zoom / step))) for side in (height, width))
        return rows, columns

    def _restore(
        self, disparity: Float32[np.ndarray, "_ _"], image: UInt8[np.ndarray, "h w 3"], name: str
    ) -> Prediction:
        if not np.isfinite(disparity).all():
            raise CheckpointError(
                f"the network's output for {name} is not finite; the weights are damaged, or the training diverged"
            )
        # Linear interpolation in disparity: the network's own quantity, and the one in which planes are linear.
        full = cv2.resize(disparity, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
        full = full.reshape(image.shape[:2]).astype(np.float32)
        factor = np.float32(self.scale.factor if self.scale else 1.0)
        return Prediction(factor / full, full / factor, image, self.scale, name)


def as_image(image: ImageLike) -> UInt8[np.ndarray, "h w 3"]:
    """Return RGB bytes from a path, an array, a PIL image or a tensor."""
    if isinstance(image, str | Path):
        return read_image(image)
    if isinstance(image, np.ndarray):
        if image.ndim == 3 and image.shape[0] == 3 and image.shape[2] not in (1, 3, 4):
            raise DataError(
                f"the image array has shape {image.shape}; arrays are h x w x 3, use image.transpose(1, 2, 0)"
            )
        return as_rgb_bytes(image, "the image array")
    if hasattr(image, "getbands"):  # a PIL image; Pillow defines its class
        from PIL import ImageOps

        image = ImageOps.exif_transpose(image)  # as for files
        return as_rgb_bytes(np.asarray(image if image.mode.startswith("I;16") else image.convert("RGB")), "the image")
    if not hasattr(image, "detach"):
        raise DataError(f"an image is a path, an array, a PIL image or a tensor, got {type(image).__name__}")
    values = image.detach().cpu().numpy()
    if values.ndim != 3 or values.shape[0] != 3:
        raise DataError(f"the image tensor has shape {tuple(values.shape)}; a tensor must be one image, 3 x h x w")
    if values.dtype.kind == "f":
        if values.size and not (values.min() >= 0 and values.max() <= 1):
            raise DataError(
                f"the image tensor has values from {values.min():g} to {values.max():g}; floating-point values must "
                "lie in [0, 1]"
            )
        values = np.round(values * 255).astype(np.uint8)
    return as_rgb_bytes(values.transpose(1, 2, 0), "the image tensor")


def load(
    source: str | Path,
    *,
    device: str = "cpu",
    flip: bool = False,
    keep_aspect: bool = False,
    foreign: ForeignOptions | None = None,
) -> ImagePredictor:
    """Load a trained model in any format; see `saunet.load`. ONNX runs without even importing torch."""
    predictor = _load(locate(source), device, flip, keep_aspect, foreign)
    predictor.source = str(source)
    return predictor


def _load(path: Path, device: str, flip: bool, keep_aspect: bool, foreign: ForeignOptions | None) -> ImagePredictor:
    from saunet.prediction.foreign import NOTHING, SCRIPT_SUFFIXES, ForeignPredictor, is_foreign

    if (foreign is not None and foreign.given) or is_foreign(path):
        if path.suffix.lower() not in (".onnx", *SCRIPT_SUFFIXES):
            raise ConfigError(f"foreign.* is for ONNX and TorchScript files of other systems, but {path} is neither")
        return ForeignPredictor(path, foreign or NOTHING, device, flip, keep_aspect)
    if path.is_dir() and (path / "model.onnx").is_file() and not (path / "model.safetensors").is_file():
        path = path / "model.onnx"
    if path.suffix.lower() == ".onnx":
        from saunet.exporting.onnx import OnnxPredictor

        if keep_aspect:
            raise ConfigError(
                f"{path} is ONNX and takes images of one size; leave keep_aspect out, or load a checkpoint"
            )
        return OnnxPredictor(path, device=device, flip=flip)
    if path.suffix.lower() == ".pt2":
        raise CheckpointError(f"{path} runs with torch alone; load the folder, its model.onnx or model.safetensors")
    from saunet.prediction.predictor import Predictor

    return Predictor.from_checkpoint(path, device, flip, keep_aspect)
