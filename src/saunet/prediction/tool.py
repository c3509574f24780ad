"""`predict`: depth of an image, a folder, a pattern, a video or a camera, as pictures, points and videos."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from saunet.errors import ConfigError, DataError, checked, one_of, positive, usable_device
from saunet.io.atomic import remove_partial_files
from saunet.io.colormaps import COLORMAPS, RunningRange
from saunet.io.images import IMAGE_SUFFIXES
from saunet.io.video import CODECS, VIDEO_SUFFIXES
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
    """What `predict` reads, how it predicts, and what it writes.

    Images are predicted into files of their own, and finished ones are skipped, so that an interrupted run can be
    started again. A video, a camera or arrays are predicted once, with colors that are stable over the recording.

    Args:
        checkpoint: The model: a checkpoint, an exported folder or file, a shipped model's name, or ``hf://owner/name``.
        input: An image, a folder (with everything below), a pattern (``frames/*.png``), a video, or a live
            camera (its number, ``/dev/video0``, an ``rtsp://`` or ``http://`` address);
            in Python also several images, or RGB arrays h x w x 3.
        output: The folder of the results, made if missing; names follow the inputs.
        outputs: ``color`` (disparity in colors), ``png16`` (depth x 256), ``npy`` (depth in float32), ``ply`` (points),
            ``pairs`` (images and depth in meters, to train on) for each image; ``mp4`` (image and disparity), ``html``
            (points to orbit), ``trajectory`` (from above, as KITTI poses, and where times are known for TUM's tools)
            and ``rrd`` (all of it for Rerun's viewer) for the whole; and what plugins register. By default color and
            png16 of images, mp4 of videos.
        colormap: magma, inferno, viridis, turbo or gray.
        camera: True intrinsics, which ``ply`` and ``html`` need: a camera.yaml; fx, fy, cx, cy in pixels of the first
            image; the nine numbers of K; one number, the horizontal field of view in degrees; or ``checkpoint`` for the
            mean focal length that the model's training found (``model.intrinsics``). By default, where one is needed,
            the nearest camera.yaml in or above the folder of the images or the video, up to the input.
        undistort: A camera.yaml: undistort and crop the images first, as training on that camera's clips does.
        max_depth: Leave out points that are farther, in the unit of depth.
        max_frames: Predict the first so many images or frames only.
        fps: Frames per second of results; by default a video keeps its times, images those in their names, and others
            have 10.
        layout: Of the video: ``stacked`` (disparity below), ``beside``, or ``auto``.
        range_smoothing: Weight of the past in the running color range of a recording, from 0 to below 1.
        codec: Of the video: ``h264``, ``mp4v`` (quickest) or ``vp09``.
        flip: Average with the prediction of the mirrored image: twice the time, a little less error.
        keep_aspect: Feed each image at its own aspect ratio.
        motion: Where the camera's motion of a ``trajectory`` comes from: from points ``tracked`` between frames, which
            needs ``camera``, its length from the predicted depth; ``auto`` takes the pose network if the model has one.
        scale: How depth becomes meters.
        foreign: What an ONNX or TorchScript model of another system takes and gives.
        overwrite: Replace results that are already there, whoever made them.
        batch_size: Images that go through the network together.
        device: Where to predict; ``auto`` takes a GPU if there is one.
        runtime: What runs the network on a CPU: ``torch``, ``openvino`` (extra ``openvino``), ``onnx`` (extra
            ``export``); ``auto`` is the first installed one that is faster than torch and changes depth by at most
            1e-4 (2e-3 in bfloat16), where the number of frames is worth a conversion or there has been one.
            ``openvino-bf16`` computes in bfloat16 although depth changes more.

    Raises:
        ConfigError: if an option cannot work, or not beside another one.

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
                f"output is '{folder}', which ends like a file, and it names the folder of the results; "
                f"set output={folder.with_suffix('')} outputs=[{kind}]"
            )
        one_of("colormap", self.colormap, COLORMAPS)
        one_of("layout", self.layout, LAYOUTS)
        one_of("codec", self.codec, CODECS)
        one_of("runtime", self.runtime, RUNTIMES)
        one_of("motion", self.motion, MOTIONS)
        if self.motion != "auto" and "trajectory" not in (self.outputs or ()):
            raise ConfigError(
                f"motion is '{self.motion}', which decides the camera's path, and no path is asked for; "
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
                    "camera and undistort are both set; undistort=FILE has the intrinsics, leave camera out"
                )
            if self.scale.measures:
                raise ConfigError(
                    f"scale.method={self.scale.method} measures on the images as they are, so it does not go with "
                    "undistort; measure with saunet evaluate data=video scale.store=true first"
                )


@dataclass(frozen=True, kw_only=True)
class PredictResult:
    """What `predict` did."""

    output: Path
    unit: str
    """What one unit of depth is."""
    frames: int
    """Images or frames predicted now."""
    written: tuple[Path, ...] = ()
    """Files of single images written now."""
    skipped: int | None = None
    """Images whose files were all finished before; None if no such files were asked for."""
    clips: tuple[Path, ...] = ()
    """Results of the whole recording written now; for files of its frames, their folder."""
    finished: tuple[Path, ...] = ()
    """Results of the whole recording that were finished before."""
    missing: int = 0
    """Frames that a truncated video lacks."""
    failures: tuple[str, ...] = ()
    """One sentence for each image that could not be read, and for what was wrong with a video."""
    notes: tuple[str, ...] = ()
    """How it went with a live camera: latency, frames passed over, connections lost; a sentence each."""

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
                lines.append(f"{what}: {', '.join(map(str, paths))}")
        return "\n".join([*lines, *self.notes])


def predict(
    options: PredictOptions, predictor: ImagePredictor | None = None, odometer: Odometer | None = None
) -> PredictResult:
    """Predict depth for everything that an input names; see `PredictOptions`.

    Args:
        options: What to read and write.
        predictor: A model that is loaded already; then the checkpoint is read for its pose network only.
        odometer: What follows the camera; then the checkpoint is not read for it.

    Returns:
        What was written, and what was wrong.

    Raises:
        ConfigError: for options that do not fit the input, or results that are there already and not known to be these.
        CheckpointError: if the model cannot be read.
        DataError: if the input cannot be read, nothing in it can, or the system refuses to write.

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
        if predictor is None:
            device = str(usable_device(options.device))
            about = {"flip": options.flip, "keep_aspect": options.keep_aspect}
            predictor = load(options.checkpoint, device=device, foreign=options.foreign, **about)
            if options.runtime != "torch" and device == "cpu":
                from saunet.prediction.runtimes import choose_runtime

                most = min(options.max_frames or math.inf, recording.declared or math.inf)
                predictor = choose_runtime(predictor, options.checkpoint, options.runtime, most)
        camera, height = read_given(options, recording, predictor)
        apply_scale(options.scale, predictor, options.input, camera, folder, options.checkpoint, height, store_in)
        print(f"depth is {predictor.unit}")
        if "pairs" in outputs and predictor.scale is None:
            raise ConfigError(
                "outputs has 'pairs', whose depth is in meters, and this model's is relative; set scale.method "
                "(docs/scale.md), or write outputs=[npy]"
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
                    f"outputs has 'trajectory', and {why}; tracked points tell the path "
                    "with the camera: set camera=camera.yaml or camera=[fx,fy,cx,cy], or use a model trained on video"
                )
            if odometer.tracks:
                print(f"trajectory: {odometer.told}")
        style = Style(options.colormap, None, camera, options.max_depth)
        clips = _clip_sinks(options, outputs, recording, style, odometer)
        files = tuple(output for output in outputs if output in OUTPUTS)
        if recording.images is not None:
            result = _predict_images(options, predictor, recording, files, clips, style)
        else:
            if files:
                clips.append(sinks.FrameFilesSink(folder / recording.title, files, style))
            for sink in clips:
                _refuse_existing(sink, options.overwrite)
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


def _predict_images(
    options: PredictOptions,
    predictor: ImagePredictor,
    recording: Recording,
    outputs: Sequence[str],
    clips: Sequence[Sink],
    style: Style,
) -> PredictResult:
    """Predict images into files of their own, and into results of the whole; what is finished and newer is skipped."""
    folder, again = Path(options.output), options.overwrite
    frames = (recording.images or [])[: options.max_frames]
    smoothing, batch = float(options.range_smoothing), options.batch_size
    look = {"fps": recording.fps, "layout": options.layout, "range_smoothing": smoothing, "codec": options.codec}
    state = _state(frames)
    manifest = sinks.Manifest(folder, predictor, style, again)
    todo, finished = list[Sink](), list[Sink]()
    for sink in clips:
        made = manifest.clips.get(sink.paths[0].name)  # with overwrite, nothing counts as made
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
            raise DataError(f"{failures[0]}; {names} would lack it, so nothing but single images was written")
        if todo:  # a run that is killed before it notes which images they show may replace them
            manifest.write({sink.paths[0].name: {"images": None, **look} for sink in todo})

    count, wanted, into = 0, frames if todo else unfinished, [files, *todo]
    if wanted:
        tolerated = failures if outputs else None
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
    """Return what takes the outputs that are made of a recording as a whole."""
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
    """Return what changes when an image does, or joins or leaves, whatever the clock says."""
    found = [(frame.stem, frame.image.stat() if frame.image.exists() else None) for frame in frames]
    text = "\n".join(f"{stem} {now and (now.st_size, now.st_mtime_ns)}" for stem, now in found)
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:16]


def _refuse_existing(sink: Sink, overwrite: bool) -> None:
    """Check that a sink would not replace a file, or fill a folder that holds some, unless it is told to."""
    for path in sink.paths:
        if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
            raise ConfigError(f"{path} exists; choose another output folder, or set overwrite=true")
