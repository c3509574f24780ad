"""A camera's intrinsics and distortion from pictures of a board, and whether they can be trusted."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from glob import glob
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

from saunet.data.loading.sampling import evenly
from saunet.data.video.camera import CameraFile, Lens
from saunet.data.video.clips import frame_paths
from saunet.data.video.lens_models import fold, rays_of
from saunet.errors import ConfigError, DataError, in_range, one_of, positive, suggest
from saunet.io.images import natural_order, read_image, resize
from saunet.io.video import VideoReader

KINDS = ("chessboard", "charuco", "aprilgrid")
_TAGS = cv2.aruco.DICT_APRILTAG_36h11
_BORDER = 2
"""Width of the black border around a tag's 6x6 modules, as Kalibr prints it."""
_REFINED = 0.1
"""Half the window for refining a tag's corner, relative to its side: smaller than its border and the space."""
_SEARCH_WIDTH = 1280
"""Pictures are reduced to this width to look for the board; corners are then refined in the full picture."""
FEWEST_CORNERS = 8
FEWEST_VIEWS = 8
UNCERTAIN = 0.02
"""A calibration is refused from this relative standard deviation of the focal length on."""
UNCERTAIN_CORNER = 0.005
"""A calibration is refused from this standard deviation of a corner on, relative to the width."""
MAGNIFIED = 50
"""Magnification of drawn residuals."""
_CELLS = (6, 8)
"""Rows and columns of the grid on which coverage is counted."""


@dataclass(frozen=True)
class BoardView:
    """The board as seen in one picture."""

    points: NDArray[np.float32]
    """n x 3, meters on the board, z = 0."""
    pixels: NDArray[np.float32]
    """n x 2; integer coordinates are pixel centers."""
    number: int = 0
    """Number of the picture among those examined."""


class Board:
    """A flat calibration board; see `CalibrateOptions` for the parameters."""

    def __init__(
        self,
        kind: str = "chessboard",
        columns: int = 10,
        rows: int = 7,
        square: float = 0.025,
        marker: float = 0.75,
        dictionary: str = "DICT_4X4_100",
        spacing: float = 0.3,
    ) -> None:
        self.kind, self.spacing = one_of("board", kind, KINDS), spacing
        if kind == "aprilgrid":
            in_range("spacing", spacing, 0.05, 1.0)
            tags = len(cv2.aruco.getPredefinedDictionary(_TAGS).bytesList)
            if min(columns, rows) < 2 or columns * rows > tags:
                raise ConfigError(
                    f"the board has {columns}x{rows} tags; allowed are at least 2x2, and at most {tags} in total"
                )
        elif columns < 4 or rows < 4:
            raise ConfigError(f"the board has {columns}x{rows} squares; it needs at least 4 in both directions")
        self.columns, self.rows = columns, rows
        self.square = float(positive("square", square))
        self._charuco: Any = None
        if kind == "charuco":
            in_range("marker", marker, 0.3, 0.95)
            numbers = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
            if dictionary not in numbers:
                raise ConfigError(f"unknown dictionary '{dictionary}'{suggest(dictionary, numbers)}")
            words, needed = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)), columns * rows // 2
            if needed > len(words.bytesList):
                larger = next((size for size in (50, 100, 250, 1000) if needed <= size), None)
                fix = "use fewer squares; the largest usual dictionaries, such as DICT_4X4_1000, have 1000"
                if larger:
                    fix = f"choose a larger one, such as DICT_4X4_{larger}"
                has = f"dictionary {dictionary} has {len(words.bytesList)} markers but the board needs {needed}"
                raise ConfigError(f"{has}; {fix}")
            self._charuco = cv2.aruco.CharucoBoard((columns, rows), self.square, marker * self.square, words)
            self._detectors = [cv2.aruco.CharucoDetector(self._charuco)]
            if rows % 2 == 0:  # then OpenCV before 4.6 used another layout
                old = cv2.aruco.CharucoBoard((columns, rows), self.square, marker * self.square, words)
                old.setLegacyPattern(True)
                self._detectors.append(cv2.aruco.CharucoDetector(old))
        self.legacy = 0
        """Number of pictures in which only the layout of OpenCV before 4.6 was found."""

    def __str__(self) -> str:
        if self.kind == "aprilgrid":
            return f"aprilgrid of {self.columns}x{self.rows} tags"
        return f"{self.kind} of {self.columns}x{self.rows} squares ({self.columns - 1}x{self.rows - 1} inner corners)"

    def picture(self, pixels_a_square: int = 120) -> UInt8[np.ndarray, "h w"]:
        """Return the board to print, with a white margin of one square."""
        if self.kind == "aprilgrid":
            return self._aprilgrid(pixels_a_square)
        size = (self.columns * pixels_a_square, self.rows * pixels_a_square)
        if self._charuco is not None:
            inner = np.asarray(self._charuco.generateImage(size))
        else:
            parity = np.add.outer(np.arange(self.rows), np.arange(self.columns)) % 2
            inner = np.kron(parity * 255, np.ones((pixels_a_square, pixels_a_square))).astype(np.uint8)
        return np.pad(inner, pixels_a_square, constant_values=255)

    def find(self, image: UInt8[np.ndarray, "h w 3"]) -> BoardView | None:
        """Return the board in an RGB picture; None if it, or enough of it, is not visible."""
        gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        if self.kind == "aprilgrid":
            return self._find_aprilgrid(gray)
        return self._find_charuco(gray) if self._charuco is not None else self._find_chessboard(gray)

    def _aprilgrid(self, side: int) -> UInt8[np.ndarray, "h w"]:
        """Return the board as Kalibr prints it: tag 0 at the bottom left, and squares that make all corners saddles."""
        words, gap = cv2.aruco.getPredefinedDictionary(_TAGS), round(self.spacing * side)
        left, top = (
            [round(n * (1 + self.spacing) * side) for n in range(count + 1)] for count in (self.columns, self.rows)
        )
        drawn = np.full((top[-1] + gap, left[-1] + gap), 255, np.uint8)
        for row in range(self.rows + 1):
            for column in range(self.columns + 1):
                drawn[top[row] : top[row] + gap, left[column] : left[column] + gap] = 0
                if row < self.rows and column < self.columns:
                    number, modules = (self.rows - 1 - row) * self.columns + column, 6 + 2 * _BORDER
                    tag = np.rot90(cv2.aruco.generateImageMarker(words, number, modules, borderBits=_BORDER), 2)
                    large = cv2.resize(np.ascontiguousarray(tag), (side, side), interpolation=cv2.INTER_NEAREST_EXACT)
                    at = (
                        slice(top[row] + gap, top[row] + gap + side),
                        slice(left[column] + gap, left[column] + gap + side),
                    )
                    drawn[at] = large
        return np.pad(drawn, side // 2, constant_values=255)

    def _find_aprilgrid(self, gray: NDArray[np.uint8]) -> BoardView | None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = _BORDER
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(_TAGS), parameters)
        corners, numbers, _ = detector.detectMarkers(gray)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.001)
        points, pixels = list[tuple[float, float, float]](), list[NDArray[np.float32]]()
        for found, number in zip(corners, [] if numbers is None else np.ravel(numbers).tolist(), strict=True):
            if number >= self.columns * self.rows:
                continue
            tag = np.asarray(found, np.float32).reshape(4, 1, 2)
            window = max(2, round(_REFINED * float(np.linalg.norm(tag - np.roll(tag, 1, 0), axis=2).min())))
            refined = np.asarray(cv2.cornerSubPix(gray, tag.copy(), (window, window), (-1, -1), stop))
            row, column = divmod(number, self.columns)
            # OpenCV's tags are Kalibr's upside down: the first corner, its top left, is at the bottom right; y is up.
            for (x, y), at, was in zip(((1, 0), (0, 0), (0, 1), (1, 1)), refined[:, 0], tag[:, 0], strict=True):
                inside = (at > window).all() and (at < np.array(gray.shape[::-1]) - 1 - window).all()
                if inside and 0 < np.linalg.norm(at - was) <= 1.5 * window:  # OpenCV leaves what it cannot refine
                    places = column * (1 + self.spacing) + x, row * (1 + self.spacing) + y
                    points.append((places[0] * self.square, places[1] * self.square, 0.0))
                    pixels.append(at)
        if len(pixels) < 2 * FEWEST_CORNERS:
            return None
        return BoardView(np.array(points, np.float32), np.array(pixels, np.float32))

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
        points = np.mgrid[: inner[0], : inner[1], :1].T.reshape(-1, 3) * self.square
        return BoardView(points.astype(np.float32), pixels)

    def _find_charuco(self, gray: NDArray[np.uint8]) -> BoardView | None:
        for old, detector in enumerate(self._detectors):
            corners, numbers, _, _ = detector.detectBoard(gray)
            if numbers is not None and len(numbers) >= FEWEST_CORNERS:
                self.legacy += old
                break
        else:
            return None
        points = np.asarray(self._charuco.getChessboardCorners())[np.asarray(numbers).ravel()]
        return BoardView(points.astype(np.float32), np.asarray(corners, dtype=np.float32).reshape(-1, 2))


@dataclass(frozen=True)
class Calibration:
    """The result of a calibration."""

    camera: CameraFile
    error: float
    """Root mean square reprojection error in pixels."""
    uncertainty: float
    """Relative standard deviation of the focal length."""
    corner: float
    """Standard deviation in pixels of the picture's least certain corner."""
    coverage: float
    """Fraction of the image in which the board was seen."""
    views: tuple[BoardView, ...]
    misses: tuple[NDArray[np.float64], ...]
    """Residuals of each view, n x 2, in pixels: the camera's projection of a corner minus its detection."""
    looked_at: int
    dropped: int
    """Number of views left out because they do not fit the others."""
    example: UInt8[np.ndarray, "h w 3"]
    """One of the pictures."""
    found: tuple[BoardView, ...] = ()
    """The board in all pictures in which it was found."""


def solve(
    source: str | Path,
    board: Board,
    model: str = "pinhole",
    views: int = 40,
    max_error: float = 1.0,
    advance: Callable[[int, int | None], None] = lambda done, total: None,
    k3: bool = True,
) -> Calibration:
    """Calibrate a camera from a video or a folder of pictures of a board; ``k3`` is the third radial coefficient."""
    most = max(FEWEST_VIEWS, views)
    found: list[BoardView] = []
    looked_at, size, example = 0, (0, 0), None
    for looked_at, (image, total) in enumerate(_pictures(Path(source).expanduser(), 3 * most), start=1):
        if size != (0, 0) and image.shape[:2] != size:
            raise DataError(
                f"{source} mixes pictures of {size[1]}x{size[0]} and {image.shape[1]}x{image.shape[0]}; "
                "calibrate with pictures of one camera in one mode"
            )
        size = (image.shape[0], image.shape[1])
        view = board.find(image)
        if view is not None:
            found.append(replace(view, number=looked_at - 1))
            example = image
        advance(looked_at, total)
    if len(found) < FEWEST_VIEWS or example is None:
        raise DataError(
            f"a {board} was found in {len(found)} of {looked_at} pictures of {source}; "
            f"at least {FEWEST_VIEWS} are required: check columns and rows (they count squares), "
            "keep the whole board in view, sharp and flat"
        )
    chosen = _most_different(found, size, most)
    fit, used = _solve(chosen, size, model, k3)
    # Without fps, also where the source is a video: it is that recording's, and other recordings have their own.
    known = fit.error if fit.error > 0 else None
    camera = CameraFile(Path(source), fit.K, size, tuple(fit.distortion), model, reprojection_error=known)
    covariance = _covariance(fit, used)
    uncertainty = float(np.sqrt(np.diag(covariance)[:2]).max() / fit.K[0, 0])
    problem = _problem(fit.error, uncertainty, max_error, float(fit.K[0, 0]) / size[1])
    corner = np.inf
    if not problem:
        with contextlib.suppress(DataError):  # without an undistorted picture no corner is known
            corner = _corner(fit, covariance, Lens(camera, *size).K, size)
        problem = _outside(fit, used, corner, size)
    if problem:
        raise DataError(f"the calibration from {source} cannot be trusted: {problem}")
    dropped = len(chosen) - len(used)
    coverage, misses = float(_covered(used, size).mean()), tuple(_misses(fit, used))
    return Calibration(
        camera,
        fit.error,
        uncertainty,
        corner,
        coverage,
        tuple(used),
        misses,
        looked_at,
        dropped,
        example,
        tuple(found),
    )


def check_picture(result: Calibration) -> UInt8[np.ndarray, "_ _ 3"]:
    """Return a picture for judging a calibration, beside its undistorted version.

    On the left, each detected corner has a line of `MAGNIFIED` times its residual, and parts never covered by the board
    are dark.
    """
    left, (height, width) = result.example.copy(), result.example.shape[:2]
    seen = cv2.resize(_covered(result.views, (height, width)).astype(np.uint8), (width, height), interpolation=0)
    left = np.where(seen[..., None] > 0, left // 2 + 110, left // 3)
    thick = max(1, width // 640)
    for view, misses in zip(result.views, result.misses, strict=True):
        for at, miss in zip(view.pixels, misses, strict=True):
            ends = [(round(float(x)), round(float(y))) for x, y in (at, at + MAGNIFIED * miss)]
            cv2.circle(left, ends[0], 2 * thick, (0, 90, 255), -1, cv2.LINE_AA)
            cv2.line(left, ends[0], ends[1], (255, 40, 0), thick, cv2.LINE_AA)
    right = Lens(result.camera, height, width)(result.example)
    return np.concatenate([left, right], axis=1)


def _pictures(source: Path, most: int) -> Iterator[tuple[NDArray[np.uint8], int | None]]:
    """Yield (image, number of pictures), evenly spread if there are more than ``most``."""
    if source.is_dir() or (not source.exists() and set("*?[") & set(str(source))):
        paths = frame_paths(source) if source.is_dir() else sorted(map(Path, glob(str(source))), key=natural_order)
        if not paths:
            raise DataError(f"no images in {source}; give a folder or a pattern of pictures of the board, or a video")
        for place in evenly(len(paths), most):
            yield read_image(paths[place]), min(most, len(paths))
        return
    with VideoReader(source) as reader:
        step = max(1, (reader.declared or 0) // most)
        for number, image in enumerate(reader):
            if number % step == 0:
                yield image, (reader.declared or 0) // step or None


def _most_different(found: Sequence[BoardView], size: tuple[int, int], most: int) -> list[BoardView]:
    """Choose views that differ most in place, size and tilt, one after the other."""
    features = np.array([_feature(view, size) for view in found])
    chosen = [0]
    distance = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < min(most, len(found)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return [found[place] for place in sorted(chosen)]


def _feature(view: BoardView, size: tuple[int, int]) -> NDArray[np.float64]:
    pixels = view.pixels / np.array([size[1], size[0]], dtype=np.float64)
    center, spread = pixels.mean(0), pixels.std(0)
    fit, *_ = np.linalg.lstsq(np.c_[view.points[:, :2] / view.points[:, :2].std(), np.ones(len(pixels))], pixels, None)
    return np.concatenate([center, spread, fit[:2].ravel()])


@dataclass(frozen=True)
class _Fit:
    model: str
    K: NDArray[np.float64]
    distortion: list[float]
    error: float
    poses: tuple[tuple[Any, Any], ...]
    """Rotation vector and shift of each view."""

    def project(self, points: NDArray[Any], pose: tuple[Any, Any]) -> tuple[NDArray[Any], ...]:
        """Return n x 2 pixels, and what 2n coordinates change by per fx, fy, cx, cy, distortion, and per pose."""
        numbers, count = np.array(self.distortion), 4 + len(self.distortion)
        flat = points.reshape(-1, 1, 3).astype(np.float64)
        if self.model == "fisheye":
            seen, J = cv2.fisheye.projectPoints(flat, *pose, self.K, numbers)
            return np.reshape(seen, (-1, 2)), np.asarray(J)[:, :count], np.asarray(J)[:, count : count + 6]
        seen, J = cv2.projectPoints(flat, *pose, self.K, numbers)
        return np.reshape(seen, (-1, 2)), np.asarray(J)[:, 6 : 6 + count], np.asarray(J)[:, :6]


def _solve(views: Sequence[BoardView], size: tuple[int, int], model: str, k3: bool) -> tuple[_Fit, list[BoardView]]:
    """Return the fit and the views used, without outliers."""
    used = list(views)
    while True:
        fit = _fisheye(used, size) if model == "fisheye" else _pinhole(used, size, k3)
        errors = np.array([np.sqrt((miss**2).sum(1).mean()) for miss in _misses(fit, used)])
        good = errors <= max(0.5, 3 * float(np.median(errors)))
        if good.all() or int(good.sum()) < FEWEST_VIEWS:
            return fit, used
        used = [view for view, fits in zip(used, good, strict=True) if fits]


def _misses(fit: _Fit, views: Sequence[BoardView]) -> list[NDArray[np.float64]]:
    return [fit.project(view.points, pose)[0] - view.pixels for view, pose in zip(views, fit.poses, strict=True)]


def _pinhole(views: Sequence[BoardView], size: tuple[int, int], k3: bool) -> _Fit:
    points, pixels = [view.points for view in views], [view.pixels for view in views]
    flags = 0 if k3 else cv2.CALIB_FIX_K3
    fit = cv2.calibrateCamera(points, pixels, (size[1], size[0]), None, None, flags=flags)
    error, K, distortion, rotations, shifts = fit
    numbers = np.ravel(distortion)[: 5 if k3 else 4].tolist()
    return _Fit("pinhole", np.asarray(K, np.float64), numbers, float(error), tuple(zip(rotations, shifts, strict=True)))


def _fisheye(views: Sequence[BoardView], size: tuple[int, int]) -> _Fit:
    points = [view.points[None].astype(np.float64) for view in views]
    pixels = [view.pixels[None].astype(np.float64) for view in views]
    flags = _flag("CALIB_RECOMPUTE_EXTRINSIC") | _flag("CALIB_FIX_SKEW")
    height, width = size
    best, problem = None, ""
    for focal in (0.0, 0.25, 0.32, 0.4, 0.65):  # in widths; OpenCV's own guess, 0, fails for many wide lenses
        K = np.array([[focal * width, 0, (width - 1) / 2], [0, focal * width, (height - 1) / 2], [0, 0, 1]])
        guess = _flag("CALIB_USE_INTRINSIC_GUESS") if focal else 0
        try:
            fit = cv2.fisheye.calibrate(points, pixels, (width, height), K, np.zeros((4, 1)), flags=flags | guess)
            best = fit if best is None or fit[0] < best[0] else best
            if best[0] < 0.5:
                break
        except cv2.error as reason:
            problem = problem or str(reason).strip().splitlines()[-1]
    if best is None:
        raise DataError(
            f"the views do not fit a fisheye lens ({problem}); hold the board closer to the middle and tilt it less, "
            "or use lens=pinhole"
        )
    error, K, distortion, rotations, shifts = best
    poses = tuple(zip(rotations, shifts, strict=True))
    return _Fit("fisheye", np.asarray(K, np.float64), np.ravel(distortion).tolist(), float(error), poses)


def _covariance(fit: _Fit, views: Sequence[BoardView]) -> NDArray[np.float64]:
    """Return the covariance of fx, fy, cx, cy and the distortion, with the poses of the board left free."""
    count = 4 + len(fit.distortion)
    normal, squares, rows = np.zeros((count, count)), 0.0, -count - 6 * len(views)
    for view, pose in zip(views, fit.poses, strict=True):
        seen, inner, outer = fit.project(view.points, pose)
        normal += inner.T @ inner - inner.T @ outer @ np.linalg.pinv(outer) @ inner
        squares, rows = squares + float(((seen - view.pixels) ** 2).sum()), rows + 2 * len(seen)
    return np.asarray(squares / rows * np.linalg.inv(normal))


def _corner(fit: _Fit, covariance: NDArray[np.float64], straight: NDArray[np.float64], size: tuple[int, int]) -> float:
    """Return the standard deviation in pixels of where the least known corner of the straight picture is recorded."""
    corners = np.array([(x, y) for x in (0.0, size[1] - 1) for y in (0.0, size[0] - 1)])
    _, J, _ = fit.project(rays_of(straight, corners), (np.zeros(3), np.zeros(3)))
    J = J.reshape(4, 2, -1)
    return float(np.sqrt(np.linalg.eigvalsh(J @ covariance @ J.transpose(0, 2, 1))[:, -1].max()))


def _flag(name: str) -> int:
    """Return a flag of OpenCV's fisheye calibration, which moved between its versions 4 and 5."""
    return int(getattr(cv2.fisheye if hasattr(cv2.fisheye, name) else cv2, name))


def _problem(error: float, uncertainty: float, max_error: float, focal: float) -> str | None:
    if not error <= max_error:
        return (
            f"the reprojection error is {error:.2f} pixels and at most {max_error:g} is accepted; "
            "use sharp pictures, a flat board and the right number of squares, or raise max_error"
        )
    remedy = "the views are too similar: tilt the board by up to 45 degrees in all directions, near and far"
    if not 0.2 < focal < 10:
        return f"a focal length of {focal:.1f} picture widths is impossible; {remedy}"
    if uncertainty > UNCERTAIN:
        return f"the focal length is only known to within {uncertainty:.1%}; {remedy}"
    return None


def _outside(fit: _Fit, views: Sequence[BoardView], corner: float, size: tuple[int, int]) -> str | None:
    """Return what is wrong with the model outside the area where the board was seen; None if nothing is."""
    center, (height, width) = fit.K[:2, 2], size
    seen = max(float(np.linalg.norm(view.pixels - center, axis=1).max()) for view in views)
    far = float(np.linalg.norm(np.maximum(center, [width - 1, height - 1] - center)))
    remedy = (
        f"the board was seen up to {seen:.0f} pixels from the center but the picture reaches {far:.0f}: film it "
        "along the edges and in all four corners too"
    )
    _, radius = fold(fit.model, fit.distortion, fit.K, height, width)
    if corner == np.inf:
        what = (
            f"folds back {radius:.0f} pixels from the center" if np.isfinite(radius) else "gives no undistorted picture"
        )
        return f"the lens model {what}; {remedy}"
    if not corner <= UNCERTAIN_CORNER * width:
        return f"the picture's corners are only known to within {corner:.0f} pixels; {remedy}"
    return None


def _covered(views: Sequence[BoardView], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the cells of the picture in which the board was seen."""
    seen = np.zeros(_CELLS, dtype=bool)
    for view in views:
        cells = (view.pixels[:, ::-1] / np.array(size) * np.array(_CELLS)).astype(int)
        seen[tuple(np.clip(cells, 0, np.array(_CELLS) - 1).T)] = True
    return seen
