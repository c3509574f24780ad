"""Predictions of other systems, read from files, so that the same code scores them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from saunet.errors import DataError, one_of
from saunet.io.images import natural_order, read_depth
from saunet.types import EvalBatch

SUFFIXES: tuple[str, ...] = (".npy", ".png")
"""Files of a folder that are read: arrays, and 16-bit PNG with depth x 256 (KITTI's format)."""


class ForeignArray:
    """One array of predictions in a known order, such as Monodepth2's ``disps_eigen_split.npy``.

    Args:
        path: A ``.npy`` file, images x height x width (a channel of 1 is accepted); it is read as needed, never whole.
        names: The image of each entry; some of them need not be evaluated (for want of ground truth).
        values: ``disparity`` (up to scale), or ``depth``.

    Raises:
        ConfigError: for other ``values``.
        DataError: if the file cannot be read, has another shape, or another number of images.
    """

    def __init__(self, path: Path, names: Sequence[str], values: Literal["disparity", "depth"] = "disparity") -> None:
        self.path, self.values = path, one_of("values", values, ("disparity", "depth"))
        array = _load_array(path)
        if array.ndim == 4 and array.shape[1] == 1:
            array = array[:, 0]
        if array.ndim != 3:
            raise DataError(f"'{path}' holds shape {array.shape}; predictions are images x height x width")
        self._array, self._place = array, _places(path, len(array), names)

    def __call__(self, batch: EvalBatch) -> Float[Tensor, "b 1 h w"]:
        """Return the disparity of the batch's images.

        Raises:
            DataError: if one is not among the names, a depth is not positive, or a disparity is nowhere.
        """
        places = [_place(self._place, name, self.path) for name in batch["name"]]
        maps = [np.array(self._array[place], dtype=np.float32) for place in places]
        return torch.stack([_disparity(one, self.values, self.path) for one in maps])


class ForeignFolder:
    """A folder with one file an image: ``.npy`` (height x width) or 16-bit ``.png`` (depth x 256).

    Args:
        folder: The folder.
        names: The images in the order of the files in the order of their numbers, for ``match="order"``.
        values: What ``.npy`` files hold; ``.png`` always holds depth.
        match: ``order``, or ``name``: look for the `file_stem` of each image's name.

    Raises:
        ConfigError: for another word.
        DataError: if the folder is missing, holds no such file, or another number of them.
    """

    def __init__(
        self,
        folder: Path,
        names: Sequence[str] = (),
        values: Literal["disparity", "depth"] = "depth",
        match: Literal["order", "name"] = "name",
    ) -> None:
        self.folder, self.values = folder, one_of("values", values, ("disparity", "depth"))
        self.match = one_of("match", match, ("order", "name"))
        if not folder.is_dir():
            raise DataError(f"there is no folder '{folder}'; give the folder that holds the predictions")
        files = (file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
        self._files = sorted(files, key=natural_order)
        if not self._files:
            raise DataError(f"'{folder}' holds no prediction; its files must end in {' or '.join(SUFFIXES)}")
        self._stems = {file.stem: file for file in self._files}
        self._place = _places(folder, len(self._files), names) if match == "order" else {}

    def __call__(self, batch: EvalBatch) -> Float[Tensor, "b 1 h w"]:
        """Return the disparity of the batch's images; they must be of one size.

        Raises:
            DataError: if a prediction is missing, cannot be read, or differs in size from others of the batch.
        """
        maps = [self._read(file) for file in self._choose(batch["name"])]
        if len({one.shape for one in maps}) > 1:
            raise DataError(f"predictions of one batch in '{self.folder}' differ in size; evaluate with batch size 1")
        return torch.stack(maps)

    def _choose(self, names: Sequence[str]) -> list[Path]:
        if self.match == "order":
            return [self._files[_place(self._place, name, self.folder)] for name in names]
        for name in names:
            if file_stem(name) not in self._stems:
                raise DataError(
                    f"'{self.folder}' has no file '{file_stem(name)}.npy' or '.png' for image '{name}'; "
                    "name the files so, or let them follow the order of the images (match=order)"
                )
        return [self._stems[file_stem(name)] for name in names]

    def _read(self, file: Path) -> Float[Tensor, "1 h w"]:
        if file.suffix.lower() == ".png":
            return _disparity(read_depth(file), "depth", file)
        array = np.squeeze(np.array(_load_array(file), dtype=np.float32))
        if array.ndim != 2:
            raise DataError(f"'{file}' holds shape {array.shape}; a prediction is height x width")
        return _disparity(array, self.values, file)


def file_stem(name: str) -> str:
    """Return the file name, without ending, that stands for an image: all but letters, digits, - and . become ``_``."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", name)


def _load_array(path: Path) -> ndarray:
    try:
        array: ndarray = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"cannot read '{path}' as a numpy array ({error}); give a .npy file of numbers") from error
    if not isinstance(array, ndarray) or array.dtype.kind != "f":
        raise DataError(f"'{path}' does not hold floating-point numbers; give a .npy file of disparity or depth")
    return array


def _disparity(values: ndarray, kind: str, path: Path) -> Float[Tensor, "1 h w"]:
    if kind == "disparity":
        if (values <= 0).all():  # it would score like depth that is the same everywhere
            raise DataError(
                f"'{path}' has disparity that is nowhere above 0 in an image; disparity is 1/depth, so give positive "
                "numbers (predicted=depth for depth)"
            )
        return torch.from_numpy(values)[None]
    if not (values > 0).all():
        raise DataError(f"'{path}' has pixels without depth (0, negative or NaN); predictions must be dense")
    return torch.from_numpy(1 / values)[None]


def _places(path: Path, found: int, names: Sequence[str]) -> dict[str, int]:
    if found != len(names):
        raise DataError(
            f"'{path}' holds {found} predictions for {len(names)} images; give one for each, in the same order"
        )
    return {name: place for place, name in enumerate(names)}


def _place(places: Mapping[str, int], name: str, path: Path) -> int:
    if name not in places:
        raise DataError(f"'{path}' has no prediction for image '{name}'; it belongs to another split")
    return places[name]


def foreign_predictor(
    path: Path, names: Sequence[str], values: str | None = None, match: str = "order"
) -> ForeignArray | ForeignFolder:
    """Return the predictor that belongs to a path: an array for a ``.npy`` file, else a folder.

    Args:
        path: File or folder.
        names: The images in the order of the predictions.
        values: ``disparity`` or ``depth``; by default disparity in an array and depth in a folder.
        match: How files of a folder find their image, ``order`` or ``name``.

    Raises:
        ConfigError: for another word.
        DataError: if there is nothing at the path, or it does not fit the images.
    """
    one_of("match", match, ("order", "name"))
    if values is not None:
        one_of("values", values, ("disparity", "depth"))
    if path.is_dir():
        return ForeignFolder(path, names, values or "depth", match)  # type: ignore[arg-type]
    if not path.exists():
        raise DataError(f"no predictions at '{path}'; give a .npy array or a folder of .npy or .png files")
    return ForeignArray(path, names, values or "disparity")  # type: ignore[arg-type]
