"""The calibration tool: print a board, or make ``camera.yaml`` from pictures of it or from another tool's file."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from saunet.data.video.calibrations import EXPORTS, SUFFIXES, export_camera, export_rig, split_name
from saunet.data.video.camera import CameraFile, Lens, read_camera, write_camera
from saunet.data.video.clips import frame_paths
from saunet.data.video.focal import STEP, WINDOW, estimate_focal, refusal, small_gray
from saunet.data.video.lens_models import WIDEST
from saunet.errors import ConfigError, DataError, checked, in_range, one_of, positive
from saunet.io.atomic import check_folder
from saunet.io.images import read_image, write_image
from saunet.io.progress import bar
from saunet.io.video import VideoReader
from saunet.tools.calibrate.rig import place
from saunet.tools.calibrate.solve import MAGNIFIED, Board, Calibration, check_picture, solve


@checked
@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """Options of `calibrate`: what it reads and writes; ``columns`` and ``rows`` count the board's squares.

    Raises:
        ConfigError: for an impossible board, another invalid value, or neither ``input`` nor ``print_board``.

    Examples:
        >>> saunet.CalibrateOptions(input="board.mp4", columns=8, rows=6).output
        'camera.yaml'
    """

    input: str | None = None
    """A video, a folder or a pattern (``photos/*.jpg``) of pictures of the board in many positions and tilts; or
    another tool's calibration ``FILE[:camera]`` to convert."""
    video: str | None = None
    """Instead of ``input``: a driving video with turns, or a folder of its frames. Gives the focal length, the center
    and the distortion (division model), if they can be estimated."""
    output: str = "camera.yaml"
    """The camera file to write; a picture for checking it is written beside it."""
    rig: Sequence[str] = ()
    """Videos or pictures of the same board from further cameras of a rig, taken at the same moments as ``input``. The
    pose of each camera relative to the previous one goes into a Kalibr camchain beside ``output``."""
    board: Literal["chessboard", "charuco", "aprilgrid"] = "chessboard"
    """A ``charuco`` board or a Kalibr ``aprilgrid`` has markers and may be partly hidden."""
    columns: int = 10
    """Number of squares (aprilgrid: tags) from left to right."""
    rows: int = 7
    """Number of squares (aprilgrid: tags) from top to bottom."""
    square: float = 0.025
    """Side of a square, or of a tag with its black border, in meters."""
    spacing: float = 0.3
    """Space between the tags of an aprilgrid, relative to their side."""
    marker: float = 0.75
    """Side of a ChArUco marker as a fraction of the square."""
    dictionary: str = "DICT_4X4_100"
    """Name of the markers' ArUco dictionary."""
    lens: Literal["pinhole", "fisheye"] = "pinhole"
    """The lens: ``pinhole`` has five distortion coefficients, ``fisheye`` four. It is ``model`` in ``camera.yaml``."""
    views: int = 40
    """Largest number of pictures to use: those that differ most."""
    max_error: float = 1.0
    """Largest accepted reprojection error in pixels."""
    camera_height: float | None = None
    """Height of the camera above the road in meters, for the camera file."""
    condition: str | None = None
    """Weather or light, for the camera file."""
    fov: float | None = None
    """Horizontal degrees of the undistorted picture, for the camera file; None for the widest possible."""
    export: Literal["ros", "kalibr", "colmap", "opencv"] | None = None
    """Also write the camera in this tool's format, beside ``output``."""
    print_board: str | None = None
    """Write a picture of the board to this file, and do nothing else."""
    overwrite: bool = False
    """Replace ``output`` if it exists."""

    def __post_init__(self) -> None:
        self.target()
        if self.print_board:
            return
        if (self.input is None) == (self.video is None):
            raise ConfigError(
                "set one of input and video: input=board.mp4 (a video or a folder of pictures of a board), "
                "video=drive.mp4 (a driving video), or print_board=..."
            )
        if self.export is not None:
            one_of("export", self.export, EXPORTS)
        if self.fov is not None:
            in_range("fov", self.fov, 1.0, WIDEST)
        if self.rig and self.input is None:
            raise ConfigError("rig names further cameras that filmed the board of input; set input too")
        for path in filter(None, (Path(self.output), self.exported(), *self.rig_files())):
            if path.exists() and not self.overwrite:
                raise ConfigError(f"{path} exists; choose another output, or set overwrite=true")
        one_of("lens", self.lens, ("pinhole", "fisheye"))
        positive("views", self.views)
        positive("max_error", self.max_error)
        if self.camera_height is not None:
            positive("camera_height", self.camera_height)

    def exported(self) -> Path | None:
        """Return the file for another tool; None if not requested."""
        output = Path(self.output)
        return output.with_name(output.stem + EXPORTS[self.export]) if self.export else None

    def rig_files(self) -> list[Path]:
        """Return the camchain and the camera files of a rig's further cameras; nothing without a rig."""
        output = Path(self.output)
        names = ["rig", *map(str, range(1, len(self.rig) + 1))] if self.rig else []
        return [output.with_name(f"{output.stem}_{name}{output.suffix}") for name in names]

    def target(self) -> Board:
        """Return the board."""
        return Board(self.board, self.columns, self.rows, self.square, self.marker, self.dictionary, self.spacing)


@dataclass(frozen=True)
class CalibrateResult:
    """The result of `calibrate`; ``print`` shows it."""

    written: Path
    """The camera file, or the picture of the board."""
    summary: str
    calibration: Calibration | None = None
    """None if a board was printed or a file converted."""

    def __str__(self) -> str:
        return self.summary


def calibrate(
    options: CalibrateOptions, *, advance: Callable[[int, int | None], None] | None = None
) -> CalibrateResult:
    """Find a board in pictures, solve for the camera, report the quality, and write ``camera.yaml``.

    Args:
        options: What to read, the board, and where to write.
        advance: Called with the number of pictures examined and their total; a progress bar if None.

    Returns:
        The calibration, the file, and a summary.

    Raises:
        DataError: if the pictures cannot be read, show too little of the board, or the result cannot be trusted.

    Examples:
        >>> print(saunet.calibrate(saunet.CalibrateOptions(print_board="board.png", columns=8)))
        chessboard of 8x7 squares (7x6 inner corners): board.png; print it, glue it to something flat, ...
    """
    board = options.target()
    if options.print_board:
        write_image(options.print_board, board.picture())
        how = "print it, glue it to something flat, and measure a square"
        return CalibrateResult(Path(options.print_board), f"{board}: {options.print_board}; {how}")
    check_folder(Path(options.output).parent)
    result, more = None, list[Calibration]()
    if options.video is not None:
        camera, note = _from_driving(options.video)
    elif split_name(str(options.input))[0].suffix.lower() in SUFFIXES:
        camera = read_camera(str(options.input))
        note = f"from {options.input}"
    else:
        with bar() as shown:
            task = shown.add_task("looking for the board", total=None)
            advance = advance or (lambda done, total: shown.update(task, completed=done, total=total))
            k3 = options.export != "kalibr" and not options.rig  # Kalibr has no such coefficient
            settings = board, options.lens, options.views, options.max_error, advance, k3
            result, *more = (solve(source, *settings) for source in (str(options.input), *options.rig))
        camera = result.camera
        note = f"from {len(result.views)} views of a {board} in {Path(str(options.input)).name}"
    own: dict[str, Any] = {"camera_height": options.camera_height, "condition": options.condition, "fov": options.fov}
    camera = replace(camera, **{key: value for key, value in own.items() if value is not None})
    if camera.image_size:
        Lens(camera, *camera.image_size)  # a lens that cannot be undistorted is refused before anything is written
    output, exported, K = Path(options.output), options.exported(), camera.K
    told = _write_rig(options, [result, *more]) if result and more else []
    if exported and options.export:
        export_camera(exported, camera, options.export)
    write_camera(output, camera, f"saunet calibrate: {note}")
    known = f"fx {K[0, 0]:.2f}, fy {K[1, 1]:.2f}, cx {K[0, 2]:.2f}, cy {K[1, 2]:.2f}"
    files = f"camera: {output}" + (f" and {exported}" if exported else "")
    if result is None:
        model = f"{camera.model}, " if options.video is None else ""  # the note has it
        return CalibrateResult(output, f"{note}: {model}{known}\n{files}")
    picture = output.with_name(f"{output.stem}_check.png")
    write_image(picture, check_picture(replace(result, camera=camera)))
    lines = [
        f"{note} ({result.looked_at} examined, {result.dropped} left out as outliers)",
        f"reprojection error {result.error:.3f} px; focal length known to within {result.uncertainty:.2%}, the "
        f"picture's corners to {result.corner:.2f} px",
        known,
    ]
    if board.legacy:
        lines.append("the board has the layout of OpenCV before 4.6 (legacy pattern)")
    if result.coverage < 0.6:
        lines.append(f"the board was seen in only {result.coverage:.0%} of the image: hold it in the corners too")
    lines += told
    drawn = f"on the left, residuals are magnified {MAGNIFIED} times, and parts without the board are dark"
    lines.append(f"{files}; check {picture}: straight lines must be straight on its right side; {drawn}")
    return CalibrateResult(output, "\n".join(lines), result)


def _write_rig(options: CalibrateOptions, results: Sequence[Calibration]) -> list[str]:
    """Write the further cameras of a rig and the camchain; report the pose of each camera."""
    chain, *files = options.rig_files()
    places = [place(before, after) for before, after in itertools.pairwise(results)]
    export_rig(chain, [each.camera for each in results], [each.T for each in places])
    lines = []
    for number, (file, found, placed) in enumerate(zip(files, results[1:], places, strict=True), start=1):
        write_camera(file, found.camera, f"saunet calibrate: camera {number} of a rig, see {chain.name}")
        lines.append(f"camera {number} ({file}), seen from camera {number - 1}: {placed}")
        lines.append(
            f"  its own reprojection error {found.error:.3f} px, corners known to within {found.corner:.2f} px"
        )
    return [*lines, f"rig: {chain} (Kalibr camchain)"]


def _from_driving(source: str) -> tuple[CameraFile, str]:
    """Estimate the focal length from a drive; an error if it cannot be estimated."""
    path, size = Path(source).expanduser(), list[tuple[int, int]]()

    def pictures() -> Iterator[NDArray[np.uint8]]:
        if path.is_dir():
            yield from map(read_image, frame_paths(path))
        else:
            with VideoReader(path) as reader:
                yield from (frame.image for frame in reader.frames(1 / STEP))

    def windows() -> Iterator[list[NDArray[np.uint8]]]:
        frames = deque[NDArray[np.uint8]](maxlen=WINDOW)
        for number, image in enumerate(pictures()):
            size[:] = [(image.shape[0], image.shape[1])]
            frames.append(small_gray(image))
            if len(frames) == WINDOW and number % (WINDOW // 2) == 0:
                yield list(frames)

    found = estimate_focal(windows())
    if found is None or not found.is_known:
        raise DataError(refusal(found, source))
    height, width = size[0]
    K = found.intrinsics(height, width, width)
    about = (
        f"from {found.windows} windows of {WINDOW} frames of {path.name}: focal length known to within "
        f"{found.uncertainty:.2%}"
    )
    lens = ((found.distortion,), "division") if found.bend else ()
    return CameraFile(path, K, size[0], *lens), f"{about}; {found.assumed}"
