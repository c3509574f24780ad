"""Calibration boards: chessboard and ChArUco, printed, found in pictures, as matched points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.errors import ConfigError, in_range, one_of, positive, suggest
from saunet.io.images import resize

KINDS = ("chessboard", "charuco")
_SEARCH_WIDTH = 1280
"""Pictures are made this narrow to look for the board; corners are then refined in the picture itself."""
_FEWEST_CORNERS = 8


@dataclass(frozen=True)
class BoardView:
    """The board as seen in one picture."""

    points: NDArray[np.float32]
    """n x 3, meters on the board, z = 0."""
    pixels: NDArray[np.float32]
    """n x 2; integer coordinates are pixel centers."""


class Board:
    """A flat calibration board; see `CalibrateOptions` for the parameters.

    ``square`` decides nothing but the unit of the poses.
    """

    def __init__(
        self,
        kind: str = "chessboard",
        columns: int = 10,
        rows: int = 7,
        square: float = 0.025,
        marker: float = 0.75,
        dictionary: str = "DICT_4X4_100",
    ) -> None:
        self.kind = one_of("board", kind, KINDS)
        if columns < 4 or rows < 4:
            raise ConfigError(f"the board has {columns}x{rows} squares; it needs at least 4 in both directions")
        self.columns, self.rows = columns, rows
        self.square = float(positive("square", square))
        self._charuco: Any = None
        if kind == "charuco":
            in_range("marker", marker, 0.3, 0.95)
            numbers = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
            if dictionary not in numbers:
                raise ConfigError(f"unknown dictionary '{dictionary}'{suggest(dictionary, numbers)}")
            words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
            if columns * rows // 2 > len(words.bytesList):
                raise ConfigError(
                    f"dictionary {dictionary} has {len(words.bytesList)} markers and the board needs "
                    f"{columns * rows // 2}; {_larger(columns * rows // 2)}"
                )
            self._charuco = cv2.aruco.CharucoBoard((columns, rows), self.square, marker * self.square, words)
            self._detector = cv2.aruco.CharucoDetector(self._charuco)

    def __str__(self) -> str:
        return f"{self.kind} of {self.columns}x{self.rows} squares ({self.columns - 1}x{self.rows - 1} inner corners)"

    def picture(self, pixels_a_square: int = 120) -> UInt8[np.ndarray, "h w"]:
        """Return the board to print, with a white margin of one square."""
        size = (self.columns * pixels_a_square, self.rows * pixels_a_square)
        if self._charuco is not None:
            inner = np.asarray(self._charuco.generateImage(size))
        else:
            parity = np.add.outer(np.arange(self.rows), np.arange(self.columns)) % 2
            inner = np.kron(parity * 255, np.ones((pixels_a_square, pixels_a_square))).astype(np.uint8)
        return np.pad(inner, pixels_a_square, constant_values=255)

    def find(self, image: UInt8[np.ndarray, "h w 3"]) -> BoardView | None:
        """Return the board in an RGB picture; None where it is not, or not enough of it."""
        gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        return self._find_charuco(gray) if self._charuco is not None else self._find_chessboard(gray)

    def _find_chessboard(self, gray: NDArray[np.uint8]) -> BoardView | None:
        scale = min(1.0, _SEARCH_WIDTH / gray.shape[1])
        small = resize(gray, round(gray.shape[0] * scale), round(gray.shape[1] * scale))
        inner = (self.columns - 1, self.rows - 1)
        found, corners = cv2.findChessboardCornersSB(small, inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return None
        factors = np.array([gray.shape[1] / small.shape[1], gray.shape[0] / small.shape[0]])
        pixels = ((corners.reshape(-1, 2) + 0.5) * factors - 0.5).astype(np.float32)
        if scale < 1:
            stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.001)
            pixels = np.asarray(cv2.cornerSubPix(gray, pixels[:, None], (7, 7), (-1, -1), stop)).reshape(-1, 2)
        grid = np.mgrid[: inner[0], : inner[1]].T.reshape(-1, 2)
        points = np.concatenate([grid, np.zeros((len(grid), 1))], axis=1) * self.square
        return BoardView(points.astype(np.float32), pixels)

    def _find_charuco(self, gray: NDArray[np.uint8]) -> BoardView | None:
        corners, numbers, _, _ = self._detector.detectBoard(gray)
        if numbers is None or len(numbers) < _FEWEST_CORNERS:
            return None
        points = np.asarray(self._charuco.getChessboardCorners())[np.asarray(numbers).ravel()]
        return BoardView(points.astype(np.float32), np.asarray(corners, dtype=np.float32).reshape(-1, 2))


def _larger(markers: int) -> str:
    """Say what to do for a board of so many markers: the smallest of OpenCV's usual dictionaries that has them."""
    for size in (50, 100, 250, 1000):
        if markers <= size:
            return f"choose a larger one, such as DICT_4X4_{size}"
    return "use fewer squares; the largest usual dictionaries, such as DICT_4X4_1000, have 1000"
