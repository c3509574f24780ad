"""`predict`: depth of an image, a folder, a pattern, a video or a camera, as pictures, points and videos."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from saunet.errors import ConfigError, DataError, checked, one_of, positive, usable_device
from saunet.io.atomic import remove_partial_files
from saunet.io.colormaps import COLORMAPS, RunningRange
from saunet.io.images import IMAGE_SUFFIXES
from saunet.io.video import CODECS, VIDEO_SUFFIXES, VideoReader
from saunet.prediction import sinks
from saunet.prediction.cameras import read_given, with_camera
from saunet.prediction.foreign import NOTHING, ForeignOptions
from saunet.prediction.pointcloud import Camera
from saunet.prediction.prediction import ImagePredictor, load
from saunet.prediction.scaling import apply_scale
from saunet.prediction.sinks import LAYOUTS, OUTPUTS, Sink, Style
from saunet.prediction.sources import Frame, Input, Recording
from saunet.registry import outputs as clip_outputs
from saunet.scale.options import MOTIONS, ScaleOptions
from saunet.weights.locate import locate

if TYPE_CHECKING:
    from saunet.prediction.odometer import Odometer

RUNTIMES: tuple[str, ...] = ("auto", "torch", "openvino", "openvino-bf16", "onnx")


@checked
@dataclass(frozen=True, kw_only=True)
class PredictOptions:
    """Options of `predict`: what it reads, how it predicts, and what it writes.

    Each image gets its own files, and finished ones are skipped, so you can start an interrupted run again. A video, a
    camera or arrays are predicted once, with colors that are stable over the recording.

    Args:
        checkpoint: The model: a checkpoint, an exported folder or file, a shipped model's name, or ``hf://owner/name``.
        input: An image, a folder (with everything below), a pattern (``frames/*.png``), a video, or a live
            camera (its number, ``/dev/video0``, an ``rtsp://`` or ``http://`` address);
            in Python also several images, or RGB arrays h x w x 3.
        output: The folder for the results, created if missing; file names follow the inputs.
        outputs: ``color`` (disparity in colors), ``png16`` (depth x 256), ``npy`` (depth in float32), ``ply`` (points),
            ``pairs`` (images and depth in meters, to train on) for each image; ``mp4`` (image and disparity), ``html``
            (points to orbit), ``trajectory`` (from above, as KITTI poses and, if times are known, for TUM's tools) and
            ``rrd`` (everything for Rerun's viewer) for the whole recording; and what plugins register. By default color
            and png16 for images, mp4 for videos.
        colormap: magma, inferno, viridis, turbo or gray.
        camera: True intrinsics, which ``ply`` and ``html`` need: a camera.yaml; fx, fy, cx, cy in pixels of the first
            image; the nine numbers of K; one number, the horizontal field of view in degrees; or ``checkpoint``, the
            mean focal length that the model's training found (``model.intrinsics``). By default, where one is needed,
            the nearest camera.yaml in or above the folder of the images or the video, up to the input.
        undistort: A camera.yaml with which to undistort and crop the images first, as training on that camera's clips
            does.
        max_depth: Leave out points that are farther, in the unit of depth.
        max_frames: Predict only this many images or frames from the start.
        fps: Frames per second of results; by default a video keeps its times, images those in their names, and others
            get 10.
        layout: Layout of the video: ``stacked`` (disparity below), ``beside``, or ``auto``.
        range_smoothing: Weight of the past in the running color range of a recording, from 0 to below 1.
        codec: Codec of the video: ``h264``, ``mp4v`` (quickest) or ``vp09``.
        flip: Average with the prediction of the mirrored image: twice the time, slightly less error.
        keep_aspect: Keep each image's aspect ratio instead of the training's.
        motion: Source of the camera's motion for ``trajectory``: points ``tracked`` between frames, with ``camera`` set
            and the length from the predicted depth; ``auto`` uses the pose network if the model has one.
        scale: How depth becomes meters.
        foreign: Input and output of another system's ONNX or TorchScript model.
        overwrite: Replace existing results, whatever made them.
        batch_size: Images per run of the network.
        device: Where to predict; ``auto`` uses a GPU if there is one.
        runtime: What runs the network on a CPU: ``torch``, ``openvino`` (extra ``openvino``), ``onnx`` (extra
            ``export``); ``auto`` is the first installed one that is faster than torch and changes depth by at most
            1e-4 (2e-3 in bfloat16), if the number of frames is worth a conversion or one exists already.
            ``openvino-bf16`` computes in bfloat16 even though depth changes more.

    Raises:
        ConfigError: if an option is invalid, or cannot be combined with another.

    Examples:
        >>> saunet.PredictOptions(checkpoint="last.ckpt", input="drive.mp4", output="out").codec
        'h264'
    """

    checkpoint: str | Path = "street"
    input: Input
    output: str | Path
    outputs: Sequence[str] | None = None
    colormap: str = "magma"
    camera: Sequence[float | int] | Camera | str | Path | None = None
    undistort: str | Path | None = None
    max_depth: float | int | None = None
    max_frames: int | None = None
    fps: float | int | None = None
    layout: str = "auto"
    range_smoothing: float | int = 0.95
    codec: str = "h264"
    flip: bool = False
    keep_aspect: bool = False
    motion: str = "auto"
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    foreign: ForeignOptions = NOTHING
    overwrite: bool = False
    batch_size: int = 1
    device: str = "auto"
    runtime: str = "auto"

    def __post_init__(self) -> None:
        if self.outputs is not None:
            known = (*OUTPUTS, *clip_outputs.names())
            for output in self.outputs:
                one_of("outputs", output, known)
            if not self.outputs:
                raise ConfigError(f"outputs is empty; allowed: {', '.join(known)}")
        folder, kinds = Path(self.output), ("npy", "ply", "html", "rrd")
        suffix = folder.suffix.lower()
        if suffix in {*VIDEO_SUFFIXES, *IMAGE_SUFFIXES, *(f".{kind}" for kind in kinds)} and not folder.exists():
            kind = "mp4" if suffix in VIDEO_SUFFIXES else suffix[1:] if suffix[1:] in kinds else "color"
            raise ConfigError(
                f"output is '{folder}', which looks like a file, but output is the folder for the results; set "
                f"output={folder.with_suffix('')} outputs=[{kind}]"
            )
        one_of("colormap", self.colormap, COLORMAPS)
        one_of("layout", self.layout, LAYOUTS)
        one_of("codec", self.codec, CODECS)
        one_of("runtime", self.runtime, RUNTIMES)
        one_of("motion", self.motion, MOTIONS)
        if self.motion != "auto" and "trajectory" not in (self.outputs or ()):
            raise ConfigError(
                f"motion is '{self.motion}', which only affects the camera's path, but outputs has no trajectory; "
                "add outputs=[trajectory], or leave motion out"
            )
        positive("batch_size", self.batch_size)
        for name in ("max_depth", "max_frames", "fps"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))
        RunningRange(self.range_smoothing)
        if self.undistort is not None:
            if self.camera is not None:
                raise ConfigError(
                    "camera and undistort are both set; undistort=FILE has the intrinsics, so leave camera out"
                )
            if self.scale.measures:
                raise ConfigError(
                    f"scale.method={self.scale.method} measures on the original images, so it cannot be combined "
                    "with undistort; measure with saunet evaluate data=video scale.store=true first"
                )


@dataclass(frozen=True, kw_only=True)
class PredictResult:
    """The results of `predict`."""

    output: Path
    unit: str
    """The unit of depth."""
    frames: int
    """Images or frames predicted now."""
    written: tuple[Path, ...] = ()
    """Files of single images written now."""
    skipped: int | None = None
    """Images whose files were all finished before; None if no such files were requested."""
    clips: tuple[Path, ...] = ()
    """Results of the whole recording written now; for files per frame, their folder."""
    finished: tuple[Path, ...] = ()
    """Results of the whole recording that were finished before."""
    missing: int = 0
    """Number of frames missing from a truncated video."""
    failures: tuple[str, ...] = ()
    """One sentence for each image that could not be read, and for each problem of a video."""
    notes: tuple[str, ...] = ()
    """Notes about a live camera, one sentence each: latency, skipped frames, lost connections."""

    @property
    def exit_code(self) -> int:
        """1 if something was missing."""
        return 1 if self.failures else 0

    def __str__(self) -> str:
        lines = []
        if self.skipped is not None:
            before = f", {self.skipped} images were finished before" if self.skipped else ""
            files = "1 file" if len(self.written) == 1 else f"{len(self.written)} files"
            lines.append(f"{files} written{before}: {self.output}")
        count = "1 frame" if self.frames == 1 else f"{self.frames} frames"
        for paths, what in ((self.clips, count), (self.finished, "finished before")):
            if paths:
                lines.append(f"{what}: {', '.join(map(_described, paths))}")
        return "\n".join([*lines, *self.notes])


def _described(path: Path) -> str:
    """Return a result's path, of a video with the size of its pictures and their rate."""
    if path.suffix.lower() not in VIDEO_SUFFIXES or not path.is_file():
        return str(path)
    with VideoReader(path) as video:
        rate = "" if video.fps is None else f", {video.fps:.4g} fps"
        return f"{path} ({video.width}x{video.height}{rate})"


def predict(
    options: PredictOptions, predictor: ImagePredictor | None = None, odometer: Odometer | None = None
) -> PredictResult:
    """Predict depth for everything that an input names; see `PredictOptions`.

    Args:
        options: What to read and write.
        predictor: A model that is loaded already; the checkpoint is then only read for its pose network.
        odometer: Follows the camera; the checkpoint is then not read for it.

    Returns:
        The files written, and any problems.

    Raises:
        ConfigError: for options that do not fit the input, or existing results of unknown origin.
        CheckpointError: if the model cannot be read.
        DataError: if the input, or everything in it, cannot be read, or the results cannot be written.

    Examples:
        >>> options = saunet.PredictOptions(checkpoint="last.ckpt", input="road.png", output="out", device="cpu")
        >>> print(saunet.predict(options))
        depth is ...
        2 files written: out
    """
    folder, store_in = Path(options.output), options.scale.storable(options.checkpoint)
    with contextlib.closing(Recording(options.input, folder, options.fps)) as recording:
        default = ("mp4",) if recording.images is None else ("color", "png16")
        outputs = tuple(dict.fromkeys(options.outputs or default))
        options = with_camera(options, recording, outputs)
        choose: Callable[[ImagePredictor, float | int], ImagePredictor] = _as_it_is
        if predictor is None:
            device = str(usable_device(options.device))
            about = {"flip": options.flip, "keep_aspect": options.keep_aspect}
            predictor = load(options.checkpoint, device=device, foreign=options.foreign, **about)
            if options.runtime != "torch" and device == "cpu":
                choose = functools.partial(_in_runtime, options)
        camera, height = read_given(options, recording, predictor)
        most = min(options.max_frames or math.inf, recording.declared or math.inf)
        if options.scale.measures:  # with the network; otherwise the runtime is chosen once nothing can be refused
            if recording.images is not None:
                later = {"model", "unit", *({"camera"} if camera is None and "trajectory" in outputs else ())}
                style = Style(options.colormap, None, camera, options.max_depth)
                sinks.Manifest(folder, predictor, style, options.overwrite, unknown=later)
            predictor, choose = choose(predictor, most), _as_it_is
        apply_scale(options.scale, predictor, options.input, camera, folder, options.checkpoint, height, store_in)
        print(f"depth is {predictor.unit}")
        if "pairs" in outputs and predictor.scale is None:
            raise ConfigError(
                "outputs has 'pairs', which need depth in meters, but this model's depth is relative; set "
                "scale.method (docs/scale.md), or write outputs=[npy]"
            )
        remove_partial_files(folder)
        if "trajectory" in outputs and odometer is None:
            from saunet.prediction.odometer import Odometer

            path, device = locate(options.checkpoint), str(usable_device(options.device))
            odometer = Odometer.from_model(path, options.motion, predictor.scale, device, options.batch_size)
            if odometer.tracks and camera is None:
                options = with_camera(options, recording, outputs, asked_by="outputs=[trajectory]")
                camera, _ = read_given(options, recording, predictor)
            if odometer.tracks and camera is None:
                why = "motion is 'tracked'" if options.motion == "tracked" else "the model has no pose network"
                raise ConfigError(
                    f"outputs has 'trajectory', and {why}, so points are tracked, which needs the camera: set "
                    "camera=camera.yaml or camera=[fx,fy,cx,cy], or use a model trained on video"
                )
            if odometer.tracks:
                print(f"trajectory: {odometer.told}")
        style = Style(options.colormap, None, camera, options.max_depth)
        clips = _clip_sinks(options, outputs, recording, style, odometer)
        files = tuple(output for output in outputs if output in OUTPUTS)
        if recording.images is not None:
            result = _predict_images(options, predictor, choose, recording, files, clips, style)
        else:
            if files:
                clips.append(sinks.FrameFilesSink(folder / recording.title, files, style))
            for sink in clips:
                _refuse_existing(sink, options.overwrite)
            predictor = choose(predictor, most)
            frames = itertools.islice(recording, options.max_frames)
            total = options.max_frames or recording.declared
            smoothing, batch = options.range_smoothing, options.batch_size
            count = sinks.fill(predictor, frames, clips, smoothing, batch, total, live=recording.live)
            result = PredictResult(
                output=folder,
                unit=predictor.unit,
                frames=count,
                clips=tuple(path for sink in clips for path in sink.paths),
                missing=recording.missing,
                failures=tuple(recording.problems),
                notes=tuple(recording.live.notes) if recording.live else (),
            )
        if "pairs" in outputs and camera is not None:
            sinks.write_pairs_camera(folder, camera, recording.fps if recording.images is None else None)
        return result


def _as_it_is(predictor: ImagePredictor, frames: float | int) -> ImagePredictor:
    """Leave a predictor in its runtime."""
    return predictor


def _in_runtime(options: PredictOptions, predictor: ImagePredictor, frames: float | int) -> ImagePredictor:
    """Return a predictor in the requested runtime; comparing runtimes takes a while."""
    from saunet.prediction.runtimes import choose_runtime

    return choose_runtime(predictor, options.checkpoint, options.runtime, frames)


def _predict_images(
    options: PredictOptions,
    predictor: ImagePredictor,
    choose: Callable[[ImagePredictor, float | int], ImagePredictor],
    recording: Recording,
    outputs: Sequence[str],
    clips: Sequence[Sink],
    style: Style,
) -> PredictResult:
    """Predict images into their own files and into results of the whole; finished and newer files are skipped."""
    folder, again = Path(options.output), options.overwrite
    frames = (recording.images or [])[: options.max_frames]
    smoothing, batch = float(options.range_smoothing), options.batch_size
    look = {"fps": recording.fps, "layout": options.layout, "range_smoothing": smoothing, "codec": options.codec}
    state = _state(frames)
    manifest = sinks.Manifest(folder, predictor, style, again)
    todo, finished = list[Sink](), list[Sink]()
    for sink in clips:
        made = manifest.clips.get(sink.paths[0].name)  # with overwrite, nothing counts as finished
        made = made if isinstance(made, dict) else {}
        ours = look.items() <= made.items()
        if not ours:
            _refuse_existing(sink, again)
        whole = ours and made.get("images") == state and all(path.is_file() for path in sink.paths)
        (finished if whole else todo).append(sink)
    files = sinks.ImageFilesSink(folder, outputs, style, manifest, again)
    unfinished = [frame for frame in frames if files.wanted(frame)]
    failures = list[str]()

    def check() -> None:
        if failures and len(failures) == len(frames):
            rest = len(failures) - 1
            raise DataError(failures[0] + (f" (and {rest} more images cannot be read)" if rest else ""))
        if failures and todo:
            names = ", ".join(path.name for sink in todo for path in sink.paths)
            raise DataError(f"{failures[0]}; {names} would lack it, so only single images were written")
        if todo:  # if this run is killed before it records their images, the next run may replace them
            manifest.write({sink.paths[0].name: {"images": None, **look} for sink in todo})

    count, wanted, into = 0, frames if todo else unfinished, [files, *todo]
    if wanted:
        tolerated, predictor = failures if outputs else None, choose(predictor, len(wanted))
        count = sinks.fill(predictor, wanted, into, smoothing, batch, len(wanted), failures=tolerated, check=check)
    if todo:
        manifest.write({sink.paths[0].name: {"images": state, **look} for sink in todo})
    return PredictResult(
        output=folder,
        unit=predictor.unit,
        frames=count,
        written=tuple(files.written),
        skipped=len(frames) - len(unfinished) if outputs else None,
        clips=tuple(path for sink in todo for path in sink.paths),
        finished=tuple(path for sink in finished for path in sink.paths),
        failures=tuple(failures),
    )


def _clip_sinks(
    options: PredictOptions, outputs: Sequence[str], recording: Recording, style: Style, odometer: Odometer | None
) -> list[Sink]:
    """Return the sinks of the outputs made from a whole recording."""
    clip = sinks.ClipInfo(
        stem=f"{Path(options.output) / recording.title}_",
        title=recording.title,
        fps=recording.fps,
        timed=recording.timed,
        style=style,
        retimed=options.fps is not None,
        layout=options.layout,
        codec=options.codec,
        odometer=odometer if "trajectory" in outputs else None,
    )
    names = [entry.name for entry in clip_outputs.registered() if entry.name in outputs]
    found = {name: clip_outputs.build(name, clip=clip) for name in names}
    for name, sink in found.items():
        if sink is not None and not isinstance(sink, Sink):
            raise ConfigError(f"the output '{name}' is a {type(sink).__name__}; derive it from saunet's Sink")
    return [sink for sink in found.values() if sink is not None]


def _state(frames: Sequence[Frame]) -> str:
    """Return a state that changes when an image is changed, added or removed, whatever the clock says."""
    found = [(frame.stem, frame.image.stat() if frame.image.exists() else None) for frame in frames]
    text = "\n".join(f"{stem} {now and (now.st_size, now.st_mtime_ns)}" for stem, now in found)
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:16]


def _refuse_existing(sink: Sink, overwrite: bool) -> None:
    """Check that a sink would not replace a file or fill a non-empty folder, unless ``overwrite`` is set."""
    for path in sink.paths:
        if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
            raise ConfigError(f"{path} exists; choose another output folder, or set overwrite=true")
