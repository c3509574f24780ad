"""`evaluate`: score a checkpoint, or predictions made elsewhere, beside predictors that use no image."""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, get_args, runtime_checkable

import torch
from torch import Tensor, nn

from saunet.data.drive import Drive
from saunet.data.loading.module import surroundings
from saunet.data.loading.stored import cache_truths
from saunet.data.loading.windows import measured_distance, recording_of, tracked_poses
from saunet.errors import ConfigError, DataError, checked, one_of, usable_device
from saunet.evaluation.files import image_size, read_rows, write_results
from saunet.evaluation.predictors import (
    ExportingPredictor,
    FilePredictor,
    Motion,
    NetworkPredictor,
    Predictor,
    PredictorNetwork,
    existing,
)
from saunet.evaluation.result import EvaluationResult
from saunet.evaluation.rows import sizes_told
from saunet.evaluation.scoring import Buckets, Shapes, score, score_views
from saunet.evaluation.statistics import with_statistics
from saunet.evaluation.team import Team, joined
from saunet.geometry.camera import zoom_intrinsics
from saunet.io.atomic import check_folder
from saunet.io.speeds import read_speeds
from saunet.metrics.baselines import ConstantDepth, MeanDepthMap
from saunet.metrics.protocols import Protocol as Rules
from saunet.metrics.protocols import protocol
from saunet.models.depth import DepthNet
from saunet.prediction.foreign import NOTHING, ForeignOptions, ForeignPredictor, is_foreign
from saunet.prediction.prediction import load
from saunet.registry import Spec
from saunet.runs.folder import read_mapping
from saunet.runs.record import Intrinsics, ModelRecord
from saunet.scale.estimate import MetricDepth, MetricMotion, estimate_scale, keep_scale
from saunet.scale.options import MOTIONS, ScaleOptions
from saunet.types import EvalBatch
from saunet.weights.files import read_model
from saunet.weights.locate import locate

STAGES = {"test": "test", "val": "validate"}
"""Splits that can be evaluated, with the stage that sets each up."""


@runtime_checkable
class EvaluationData(Protocol):
    """The interface that an evaluation needs from a data module."""

    ground_truth: str
    neighbors: Sequence[str]

    @property
    def datasets(self) -> Mapping[str, Any]:
        """Data sets of the splits that are set up."""

    @property
    def protocols(self) -> Sequence[str]:
        """Names of the protocols that fit it, its own first."""

    def setup(self, stage: str | None = None) -> None: ...

    def batches(
        self, split: str, device: str | torch.device, place: tuple[int, int] | None = None
    ) -> Iterator[EvalBatch]: ...

    def listed(self, split: str) -> list[str]:
        """Return the names of a split's images, in the order of its list."""

    def ground_truths(self, split: str) -> Iterator[torch.Tensor]:
        """Yield true depth maps of a split, 1 h w."""


@checked
@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Options of `evaluate`: what to score, on which images, and how.

    Args:
        data: The data module; its image size follows the checkpoint.
        checkpoint: A trained model. Give either it or ``predictions``.
        predictions: Another system's predictions: a ``.npy`` array, or a folder of ``.npy`` or 16-bit ``.png`` files.
        predicted: ``disparity`` or ``depth``, the content of ``predictions``; by default disparity for an array and
            depth for a folder.
        match: How files of a folder are assigned to images: by ``order`` or ``name``.
        protocols: Names of protocols, each with the ground truth it needs; the data set's own by default.
        split: ``test`` or ``val``.
        motion: Source of the camera's motion on data without ground truth: points ``tracked`` between frames, with the
            length from the predicted depth; ``auto`` uses the pose network if the model has one.
        flip: Blend with the prediction of the mirrored image (Monodepth's post-processing).
        baselines: Also score predictors that use no image.
        scale: How depth becomes meters.
        foreign: Input and output of another system's ONNX or TorchScript model.
        buckets: Also report errors by distance, image region and at depth edges.
        distances: Limits of the distance ranges in meters, ascending.
        boundaries: Also measure the distance between depth edges and true ones, in pixels, if ground truth is dense.
        cloud: Also compare point clouds: the fraction of points with a true point within this many meters, such as 0.1.
        intervals: Level of the bootstrap intervals of the means; None for none.
        compare: Folder of another evaluation of the same images, to compare with.
        truth_cache: Folder for keeping projected LiDAR ground truth.
        export: Folder for the predictions as 16-bit PNG, meters x 256.
        device: Where to predict; ``auto`` uses a GPU if there is one.
        output_dir: Folder for the results; None, the default in Python, writes none.

    Raises:
        ConfigError: if an option is invalid, or cannot be combined with another.

    Examples:
        >>> data = saunet.Spec.of("data", "synthetic_tiny")
        >>> saunet.EvaluateOptions(data=data, checkpoint="best.ckpt").split
        'test'
    """

    data: Spec
    checkpoint: str | Path | None = None
    predictions: str | None = None
    predicted: str | None = None
    match: str = "order"
    protocols: tuple[str, ...] | None = None
    split: str = "test"
    motion: str = "auto"
    flip: bool = False
    baselines: bool = True
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    foreign: ForeignOptions = NOTHING
    buckets: bool = False
    distances: tuple[float, ...] = (0.0, 10.0, 20.0, 30.0, 50.0, 80.0)
    boundaries: bool = False
    cloud: float | None = None
    intervals: float | None = 0.95
    compare: str | None = None
    truth_cache: str | None = None
    export: str | None = None
    device: str = "auto"
    output_dir: str | Path | None = None

    def __post_init__(self) -> None:
        if (self.checkpoint is None) == (self.predictions is None):
            raise ConfigError(
                "give checkpoint=FILE to score a model, or predictions=FILE_OR_FOLDER to score another system's "
                f"predictions; {'neither is' if self.checkpoint is None else 'both are'} set"
            )
        if self.intervals and not 0 < self.intervals < 1:
            raise ConfigError(f"intervals is {self.intervals:g}; it must lie between 0 and 1, such as intervals=0.95")
        one_of("split", self.split, STAGES)
        one_of("motion", self.motion, MOTIONS)
        one_of("match", self.match, ("order", "name"))
        if self.predicted is not None:
            one_of("predicted", self.predicted, ("disparity", "depth"))
        for name in self.protocols or ():
            protocol(name)
        Buckets(tuple(self.distances))
        Shapes(self.boundaries, self.cloud)
        if self.predictions is not None and self.flip:
            raise ConfigError("flip=true blends two predictions of a model, so leave it out with predictions=...")
        if self.predictions is not None and self.scale.method != "auto":
            raise ConfigError("scale.method measures the scale of a model, so leave it out with predictions=...")


def evaluate(options: EvaluateOptions) -> EvaluationResult:
    """Score a model or the predictions of another system, and write the results.

    Args:
        options: What to score, and how.

    Returns:
        The errors of each image with their means and tables; `EvaluationResult.show` prints them.

    Raises:
        ConfigError: if a protocol does not fit the data, or needs motion and there is none.
        CheckpointError: if the checkpoint cannot be read.
        DataError: if there is no image, none has ground truth, or files cannot be read or written.

    Examples:
        >>> data = saunet.Spec.of("data", "synthetic_tiny")
        >>> evaluate(EvaluateOptions(data=data, checkpoint="best.ckpt")).show()  # doctest: +SKIP
    """
    with joined() as team:
        return evaluate_with(options, team)


def evaluate_with(options: EvaluateOptions, team: Team) -> EvaluationResult:
    """Evaluate with the processes of a team; each returns the complete result."""
    store_in = options.scale.storable(str(options.checkpoint))
    earlier = read_rows(Path(options.compare)) if options.compare else None
    device = team.device(usable_device(options.device))
    folder, first = None if options.output_dir is None else check_folder(options.output_dir), team.rank == 0
    settings: dict[str, object] = {"data": options.data.name}
    model, pose, found = None, None, None
    if options.checkpoint is not None and runs_alone(options):
        loaded = load(options.checkpoint, device=str(device), flip=options.flip, foreign=options.foreign)
        size = {"height": loaded.height, "width": loaded.width}
        shifted = isinstance(loaded, ForeignPredictor) and loaded.shifted
        passes = _passes(options, options.data.changed(**size), motion=not shifted, shifted=shifted)
        model = NetworkPredictor(PredictorNetwork(loaded))
        about = {key: value for key, value in asdict(options.foreign).items() if value is not None}
        settings |= {"checkpoint": str(options.checkpoint), **({"foreign": about} if options.foreign.given else {})}
        settings["size"] = [loaded.height, loaded.width]
    elif options.checkpoint is not None:
        checkpoint = read_model(options.checkpoint)
        networks, found = checkpoint.networks(), checkpoint.record.intrinsics
        passes = _passes(options, _resized(options.data, checkpoint.record), motion=True)
        _set_up(passes[0][0], options.split)  # the scale is measured once: other ground truth has the same images
        if store_in is not None:
            _check_one_camera(passes[0][0], options.split)
        depth, pose, scale = _scaled(options, checkpoint.record, networks, passes[0][0], device, first, store_in)
        model = NetworkPredictor(depth, options.flip)
        settings |= {"checkpoint": str(options.checkpoint), "scale": scale}
        settings["size"] = [checkpoint.record.height, checkpoint.record.width]
    else:
        passes = _passes(options, options.data.changed(batch_size=1), motion=False)  # files may differ in size
        existing(Path(str(options.predictions)))
        settings |= {"predictions": options.predictions, "match": options.match}
    settings |= {"split": options.split, "post_processing": "monodepth blend of two flips" if options.flip else None}
    result, exported = _score_passes(options, passes, model, pose, device, team, found)
    sources = tuple(options.data.get("sources") or ())
    result = replace(result, settings={**settings, **result.settings}, sources=sources, folder=folder, notes=exported)
    if folder is not None and earlier is not None and first:
        write_results(result, folder)  # so that an evaluation that cannot be compared is not lost
    result = with_statistics(result, options.intervals, earlier, options.compare)
    without_truth = {view.protocol for view in result.views}
    if options.compare and any(each.protocol in without_truth for each in result.comparisons):
        result = replace(result, notes=(*result.notes, *_sizes_apart(Path(options.compare), settings)))
    if folder is not None and first:
        write_results(result, folder)
    return result


def _sizes_apart(earlier: Path, settings: Mapping[str, object]) -> list[str]:
    """Return a note if an earlier evaluation without ground truth was of images of another size."""
    folder = earlier if earlier.is_dir() else earlier.parent
    before = image_size(read_mapping(folder / "metrics.json").get("settings"))
    now = image_size(settings)
    return [sizes_told(str(earlier), before, "this model", now)] if before and now and before != now else []


def runs_alone(options: EvaluateOptions) -> bool:
    """Return whether the checkpoint is a file to run directly: ONNX, or TorchScript of another system."""
    path = locate(str(options.checkpoint))
    alone = options.foreign.given or path.suffix.lower() == ".onnx" or is_foreign(path)
    if alone and options.scale.method not in ("auto", "none"):
        raise ConfigError(
            f"scale.method={options.scale.method} needs a saunet checkpoint, but '{options.checkpoint}' is not one; "
            "leave it out"
        )
    return alone


def evaluate_network(
    network: nn.Module,
    data: EvaluationData,
    others: Mapping[str, Predictor] = MappingProxyType({}),
    shapes: Shapes | None = None,
) -> EvaluationResult:
    """Score a depth network, on its device, beside other and trivial predictors on test images of its size."""
    _set_up(data, "test")
    predictors: dict[str, Predictor] = {"model": NetworkPredictor(network), **others, **trivial(data)}
    batches = data.batches("test", next(network.parameters()).device)
    rules = [protocol(name) for name in _fitting(data, motion=False)]
    total = len(data.datasets["test"])
    return score(predictors, batches, rules, ground_truth=data.ground_truth, shapes=shapes, total=total)


def _resized(data: Spec, record: ModelRecord) -> Spec:
    """Return the data at the size of a model, with the neighbors that its pose network uses, and its camera."""
    wanted: dict[str, object] = {"height": record.height, "width": record.width}
    if record.pose:
        wanted["offsets"] = list(record.offsets)
    if record.intrinsics:
        wanted["guess_camera"] = True
    return data.fitted(**wanted)


def _set_up(data: EvaluationData, split: str) -> None:
    if split not in data.datasets:
        data.setup(STAGES[split])


def _fitting(data: EvaluationData, motion: bool) -> list[str]:
    """Return the data set's own protocols, without those that need motion if there is none."""
    return [name for name in data.protocols if motion or protocol(name).ground_truth != "none"] or list(data.protocols)


def _passes(
    options: EvaluateOptions, spec: Spec, motion: bool, shifted: bool = False
) -> list[tuple[EvaluationData, list[Rules]]]:
    """Return the data modules to evaluate, not set up, one per ground truth, with the protocols for each."""
    spare: list[EvaluationData] = [spec.build()]
    own, choice = spare[0].ground_truth, spec.parameters.get("depth")
    kinds = tuple(dict.fromkeys([own, *get_args(choice.annotation if choice else None)]))
    fitting = [f"{name}/least_squares_disparity" if shifted else name for name in _fitting(spare[0], motion)]
    rules = [protocol(name) for name in options.protocols or fitting]
    for rule in rules if shifted else ():
        if rule.alignment != "least_squares_disparity":
            raise ConfigError(
                f"protocol '{rule.name}' aligns at most by a factor, but the model's disparity also has an unknown "
                f"shift; use {rule.name.partition('/')[0]}/least_squares_disparity, or set foreign.factor and "
                "foreign.shift"
            )
    found = []
    for kind, each in passes(rules, own).items():
        if kind not in ("none", *kinds):
            raise ConfigError(
                f"protocols names '{each[0].name}', which is defined on '{kind}' ground truth, but these data give "
                f"{' or '.join(kinds)}; choose other protocols or data"
            )
        if kind == "none" and not motion:
            raise ConfigError(
                f"protocol '{each[0].name}' needs the motion of the camera, with its length from a model's depth "
                "(without an unknown shift); evaluate such a model, or choose a protocol with ground truth"
            )
        truth = {} if kind in (own, "none") else {"depth": kind}
        data = spare.pop() if spare and not truth else spec.build(**truth)
        if kind == "none":
            data.neighbors = (*data.neighbors, options.split)
        found.append((data, each))
    return found


def passes(protocols: Sequence[Rules], own: str) -> dict[str, list[Rules]]:
    """Group protocols by the ground truth to load for them: the data set's own if possible."""
    found: dict[str, list[Rules]] = {}
    for rules in protocols:
        found.setdefault(own if rules.accepts(own) else rules.ground_truth, []).append(rules)
    return found


def _score_passes(
    options: EvaluateOptions,
    passes: Sequence[tuple[EvaluationData, list[Rules]]],
    model: NetworkPredictor | None,
    pose: nn.Module | None,
    device: torch.device,
    team: Team,
    found: Intrinsics | None,
) -> tuple[EvaluationResult, tuple[str, ...]]:
    """Go through the images once for each ground truth; return the result and the export."""
    split, name, exporter = options.split, "model" if model else "predictions", None
    motion = _tracked if pose is None or options.motion == "tracked" else _predicted_by(pose)
    buckets = Buckets(tuple(options.distances)) if options.buckets else None
    shapes = Shapes(options.boundaries, options.cloud) if options.boundaries or options.cloud else None
    results: list[EvaluationResult] = []
    for data, rules in passes:
        _set_up(data, split)
        if options.truth_cache:
            cache_truths(data.datasets[split].drives, options.truth_cache)
        predictor: Predictor = model or FilePredictor(
            Path(str(options.predictions)), data.listed(split), options.predicted, options.match
        )
        if options.export and exporter is None:  # in the first pass, with the first protocol's truth
            predictor = exporter = ExportingPredictor(predictor, Path(options.export), rules[0])
        share = {} if team.place is None else {"place": team.place}
        batches, total = data.batches(split, device, **share), len(data.datasets[split])
        if rules[0].ground_truth == "none":
            pair = {name: (predictor, motion)}
            group_of = _conditions(data, split)
            batches = _refined(batches, found)
            results += [score_views(pair, batches, rule, group_of=group_of, total=total, team=team) for rule in rules]
        else:
            predictors = {name: predictor, **(trivial(data, options.truth_cache) if options.baselines else {})}
            truth = data.ground_truth
            measured: dict[str, Any] = {"buckets": buckets, "shapes": shapes}
            results.append(score(predictors, batches, rules, ground_truth=truth, total=total, team=team, **measured))
    whole = functools.reduce(EvaluationResult.joined, results)
    if exporter is not None:
        exporter.written, exporter.left_out = (
            sum(team.everyones(count)) for count in (exporter.written, exporter.left_out)
        )
    asked = [protocol(name) for name in options.protocols or [rule.name for _, rules in passes for rule in rules]]
    notes = [str(exporter)] if exporter else []
    if whole.views and motion is _tracked:
        whole = replace(whole, settings={**whole.settings, "motion": "tracked"})
        notes.append(_told(whole, asked_for=pose is not None))
    return replace(whole, protocols=tuple(asked)), tuple(notes)


def _tracked(batch: EvalBatch, depth: Tensor) -> Tensor:
    """Return the motion of tracked points; see `Motion`."""
    return tracked_poses(batch["target"], batch["sources"], batch["K"], depth)


def _predicted_by(pose: nn.Module) -> Motion:
    return lambda batch, depth: pose(batch["target"], batch["sources"])


def _told(result: EvaluationResult, asked_for: bool) -> str:
    """Describe the source of the motion, and how many images have none."""
    unknown = sum(math.isnan(row.warped) for row in result.views)
    rest = f"; left out: {unknown} of {len(result.views)} images with too few points to track" if unknown else ""
    why = "requested by motion=tracked" if asked_for else "the model has no pose network"
    return f"motion: from tracked points ({why}), with its length from the predicted depth{rest}"


def _conditions(data: EvaluationData, split: str) -> Callable[[str], str]:
    """Return how images are grouped: by the condition that their recording names, or else by recording."""
    dataset = data.datasets[split]
    conditions = {
        dataset.name(place): dataset.drives[position].condition for place, (position, _) in enumerate(dataset.windows)
    }
    return lambda image: conditions.get(image) or recording_of(image, with_side=False)


def trivial(data: EvaluationData, truth_cache: str | None = None) -> dict[str, Predictor]:
    """Return constant depth and, if the training split has depth, its mean map; report if it has none."""
    found: dict[str, Predictor] = {"constant depth": NetworkPredictor(ConstantDepth())}
    mean = MeanDepthMap()
    try:
        data.setup("fit")
        if truth_cache:
            cache_truths(data.datasets["train"].drives, truth_cache)
        for depth in data.ground_truths("train"):
            mean.update(depth[None], torch.tensor([depth.shape[-2:]]))
        if not mean.count.any():
            raise DataError("the training frames have no ground truth")
        found["mean depth map"] = NetworkPredictor(mean)
    except DataError as reason:
        print(f"no mean-depth baseline: {reason}", file=sys.stderr)
    return found


def _scaled(
    options: EvaluateOptions,
    record: ModelRecord,
    networks: tuple[DepthNet, nn.Module | None],
    data: Any,
    device: torch.device,
    first: bool,
    store_in: Path | None = None,
) -> tuple[nn.Module, nn.Module | None, dict[str, object]]:
    """Return depth and pose network on the device, in meters if requested, and what to report about that."""
    depth, pose = networks[0].to(device).eval(), None if networks[1] is None else networks[1].to(device).eval()
    method, scale, report = options.scale.method, record.scale, dict[str, object]()
    if options.scale.measures:
        batches = surroundings(
            data,
            options.split,
            device,
            offsets=record.offsets if method == "speed" else (),
            stereo=method == "stereo",
            odometer=_odometer(options, data) if method == "speed" else None,
            most=options.scale.frames,
        )
        height = data.camera_height if options.scale.camera_height is None else options.scale.camera_height
        batches = _refined(batches, record.intrinsics)
        estimate = estimate_scale(method, batches, lambda image: depth(image).depth[0], pose, height)
        report = {key: value for key, value in estimate.as_json().items() if key != "per_frame"}  # scale.json has it
        folder = None if options.output_dir is None else Path(options.output_dir)
        scale = keep_scale(estimate, str(options.checkpoint), store_in, folder) if first else estimate.scale()
    scale = options.scale.chosen(scale)
    if scale is None:
        return depth, pose, {"method": method, "factor": None}
    report = {"method": method, **(report or {"source": scale.source, "factor": scale.factor})}
    return MetricDepth(depth, scale), None if pose is None else MetricMotion(pose, scale), report


def _check_one_camera(data: EvaluationData, split: str) -> None:
    """Check that one factor can be right for all recordings of a split."""
    names = dict[str | None, str]()
    for drive in data.datasets[split].drives:
        names.setdefault(drive.camera_id, drive.name)
    if len(names) > 1:
        first, second, *_ = names.values()
        raise ConfigError(
            f"scale.store=true stores one factor, which belongs to one camera, and the clips '{first}' and '{second}' "
            f"have different ones; evaluate the clips of one camera, such as data.test_clips=[{first}], or leave "
            "scale.store out"
        )


def _refined(batches: Iterable[EvalBatch], found: Intrinsics | None) -> Iterator[EvalBatch]:
    """Yield batches with the focal lengths that the training found, if it did."""
    for batch in batches:
        if found is not None:
            width, own = batch["target"].shape[-1], batch["K"][:, 0, 0].tolist()
            focals = [found.focal(recording_of(name), fx / width) for name, fx in zip(batch["name"], own, strict=True)]
            factors = torch.tensor([width * focal / fx for focal, fx in zip(focals, own, strict=True)])
            batch = {**batch, "K": zoom_intrinsics(batch["K"], factors)}
        yield batch


def _odometer(options: EvaluateOptions, data: EvaluationData) -> Callable[[Drive, int, int], float]:
    """Return the odometer of the recordings, or of a table of speeds, which uses recorded frame numbers."""
    if options.scale.align:
        raise ConfigError(
            "scale.align=true is for saunet predict; for clips with a speeds.csv, set data.align_speeds=true"
        )
    if not options.scale.speeds:
        return measured_distance
    table = read_speeds(options.scale.speeds)
    table.check_drives([drive.name for drive in data.datasets[options.split].drives])

    def distance(drive: Drive, first: int, second: int) -> float:
        start, *ends = (drive.time(index) for index in (drive.indices[0], first, second))
        if table.unit == "time" and options.scale.fps is None and start is not None:
            low, high = sorted(each - table.start(start, drive.name) for each in ends if each is not None)
            return table.mean(low, high, drive.name) * (high - low)
        fps = options.scale.fps or drive.fps or 10.0
        return table.distance(drive.name, drive.recorded(first), drive.recorded(second), fps)

    return distance
