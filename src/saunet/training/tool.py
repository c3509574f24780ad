"""Train: typed options in, a run's folder out. Everything is checked before anything is written."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lightning import Callback, Trainer, seed_everything
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_info

from saunet import plugins
from saunet.data.drive import camera_files
from saunet.data.loading.module import DepthDataModule
from saunet.errors import ConfigError, SaunetError, checked, divisible, in_range, one_of, positive, suggest
from saunet.io.atomic import remove_partial_files
from saunet.io.said import say
from saunet.metrics.depth import DepthMetrics
from saunet.metrics.functional import ERROR_NAMES
from saunet.metrics.protocols import protocol
from saunet.models.systems import ModelOptions
from saunet.registry import Spec
from saunet.runs.checkpoint import build_networks, read_checkpoint
from saunet.runs.folder import Describe, locked, read, recording
from saunet.runs.record import ModelRecord, Scale
from saunet.training.callbacks import AtomicCheckpointIO, BestCheckpoint
from saunet.training.intrinsics import focal_lengths
from saunet.training.loop import EpochLoop, total_steps
from saunet.training.module import SelfSupervisedDepth
from saunet.training.optim import Recipe
from saunet.training.resume import check_resume, check_unused, keep_rows, resume_path, validation_due, warm_start
from saunet.training.speed import Speed
from saunet.training.stopping import way_on
from saunet.weights.locate import run_of

PRECISIONS = ("32-true", "32", "16-mixed", "16", "bf16-mixed", "bf16")
"""Allowed precisions; images and losses stay in float32."""
TRAINER: Mapping[str, Any] = {
    "accelerator": "auto",
    "devices": 1,
    "max_epochs": 80,
    "log_every_n_steps": 10,
    "num_sanity_val_steps": 0,
    "enable_model_summary": False,
    "use_distributed_sampler": False,  # our samplers are sharded already, and exact: no sample is repeated or dropped
}
"""Arguments of the trainer unless the options say otherwise."""
CALLBACKS: Mapping[str, tuple[str, dict[str, str]]] = {
    "progress": ("callbacks.Progress", {}),
    "best": ("callbacks.BestCheckpoint", {"folder": "checkpoints"}),
    "last": ("callbacks.LastCheckpoint", {"folder": "checkpoints"}),  # knows the best of the epoch it closes
    "stop": ("stopping.GracefulStop", {"folder": "checkpoints"}),
    "processes": ("stopping.ProcessWatch", {"folder": "", "checkpoints": "checkpoints"}),
    "non_finite": ("nonfinite.NonFinite", {"folder": "nonfinite"}),
    "health": ("health.HealthMonitor", {}),
    "loader": ("pace.LoaderMonitor", {}),
    "threads": ("pace.Threads", {}),
    "pictures": ("callbacks.PicturePanel", {"folder": "pictures"}),
}
"""The default callbacks by name, with their folders inside the run's folder."""
LOGGERS = {"csv": "CSVLogger", "tensorboard": "TensorBoardLogger"}
POINTS = 20
"""A short training logs at least this many rows of its curves, unless told how often to log."""
DRAWN_FROM = 10
"""A training's curves are drawn from this many steps on."""
_TRUSTED = ("lightning.", "torch.", "saunet.")
"""Packages that nested nodes of callbacks, loggers and the trainer may name."""


@checked
@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of a training: its parts, and where results are saved.

    Args:
        data: Data module.
        model: Networks; the pose network's ``offsets`` follow the data unless they are given.
        objective: Loss.
        output_dir: The run's folder.
        optim: Optimizer and schedule.
        speed: Speed switches.
        trainer: Arguments of `lightning.Trainer`; `TRAINER` has the defaults of the others.
        callbacks: Name -> a callback, a mapping with ``_target_`` and its parameters, or None; the default ones if
            None.
        logger: Name -> a logger, in the same form; CSV and TensorBoard if None.
        seed: Seed of data order, augmentation and fresh weights.
        name: The run's name.
        monitor: The metric that chooses ``best.ckpt``.
        protocol: Protocol of the validation; the data's own if None.
        resume: Checkpoint of this training to resume from; ``auto`` is the folder's ``last.ckpt``, if there is one.
        init_from: Checkpoint, from saunet or another system, whose weights a new training starts from.
        overwrite: Replace the checkpoints that an earlier run left in the folder.

    Raises:
        ConfigError: for values that no training can run with.

    Examples:
        >>> parts = {"encoder": "resnet18", "decoder": "unet", "pose": "posecnn"}
        >>> model = {kind: saunet.Spec.of(kind, name) for kind, name in parts.items()}
        >>> options = saunet.TrainOptions(
        ...     data=saunet.Spec.of("data", "synthetic_tiny", workers=0),
        ...     model=saunet.ModelOptions(**model),
        ...     objective=saunet.Spec.of("objective", "saunet"),
        ...     output_dir="run",
        ...     trainer={"max_epochs": 2},
        ... )
        >>> options.optim.lr
        0.0001
    """

    data: Spec
    model: ModelOptions
    objective: Spec
    output_dir: str | Path
    optim: Recipe = field(default_factory=Recipe)
    speed: Speed = field(default_factory=Speed)
    trainer: Mapping[str, Any] = field(default_factory=dict)
    callbacks: Mapping[str, Any] | None = None
    logger: Mapping[str, Any] | None = None
    seed: int = 0
    name: str = "train"
    monitor: str = "val/abs_rel"
    protocol: str | None = None
    resume: str | None = None
    init_from: str | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        in_range("seed", positive("seed", self.seed, allow_zero=True), 0, 2**32 - 1)
        self._check_trainer({**TRAINER, **self.trainer})
        gradient = self.objective.get("gradient") or {}
        has_lidar = self.data.get("target_depth", False) or self.data.get("dense", "none") != "none"
        if gradient.get("target") == "lidar" and not has_lidar:
            raise ConfigError(
                "objective.gradient.target=lidar needs LiDAR depth in the training batches; "
                "set data.target_depth=true, or use objective.gradient.target=image"
            )

    def _check_trainer(self, trainer: Mapping[str, Any]) -> None:
        """Check settings that Lightning's trainer accepts silently and fails on later."""
        known = list(inspect.signature(Trainer).parameters)
        for key in trainer:
            if not key.startswith("_") and key not in known:
                hint = suggest(key, known) or ";"
                raise ConfigError(f"unknown key 'trainer.{key}'{hint} allowed: {', '.join(known)}")
        for key in ("accumulate_grad_batches", "check_val_every_n_epoch", "val_check_interval"):
            value = trainer.get(key)
            if isinstance(value, int | float):
                positive(f"trainer.{key}", value)
        precision = str(trainer.get("precision") or "32-true")
        one_of("trainer.precision", precision, PRECISIONS)
        if trainer.get("overfit_batches"):
            raise ConfigError(
                f"trainer.overfit_batches is {trainer['overfit_batches']}, which would lose the training's position "
                "in the data order; use trainer.limit_train_batches with few frames instead"
            )
        if self.optim.fused and not precision.startswith("32") and trainer.get("gradient_clip_val"):
            raise ConfigError(
                f"optim.fused=true, trainer.precision={precision} and trainer.gradient_clip_val cannot be combined: "
                "gradients would be clipped before the fused optimizer unscales them; set optim.fused=false, or "
                "leave one of the others out"
            )
        if trainer.get("max_epochs") == -1 and trainer.get("max_steps", -1) == -1:
            raise ConfigError(
                "trainer.max_epochs is -1, but an endless training has no learning-rate schedule; set it, or "
                "trainer.max_steps"
            )
        if trainer.get("enable_progress_bar") is False and (self.callbacks is None or self.callbacks.get("progress")):
            raise ConfigError(
                "trainer.enable_progress_bar is false, but callbacks.progress draws a bar; "
                "set callbacks.progress=null instead"
            )
        strategy = trainer.get("strategy", "auto")
        strategy = str(dict(strategy) if isinstance(strategy, Mapping) else strategy).lower()
        if "spawn" in strategy or "fork" in strategy:
            raise ConfigError(
                f"trainer.strategy is {strategy}, whose first process only waits for the others: a signal would end "
                "the training without saving it; use trainer=ddp, or start it with torchrun"
            )

    def to_plain(self) -> dict[str, Any]:
        """Return the options as plain containers."""
        plain: dict[str, Any] = {**vars(self), "optim": self.optim.to_plain(), "speed": asdict(self.speed)}
        plain |= {"model": dict(vars(self.model)), "data": dict(self.data.node), "objective": dict(self.objective.node)}
        plain["model"] |= {kind: dict(node.node) for kind, node in plain["model"].items() if isinstance(node, Spec)}
        return plain


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """The results of a training, with its data and model."""

    folder: Path
    best: Path | None
    """The best checkpoint."""
    cost: float | None
    """The best monitored value as a cost for searches: negated if larger is better."""
    data: DepthDataModule
    model: SelfSupervisedDepth


def train(
    options: TrainOptions,
    *,
    choices: Mapping[str, str | None] | None = None,
    overrides: Sequence[str] = (),
    describe: Describe = lambda error: None,
) -> TrainResult:
    """Train a depth network on driving video; ``run.json`` in the run's folder records how it went.

    Args:
        options: The training.
        choices: The choice for each part by name, such as ``{"data": "kitti"}``, for the record.
        overrides: The overrides of the command line, for the record.
        describe: Turns an error into one sentence, or None for a bug.

    Raises:
        SaunetError: if the options do not fit together, or the data or checkpoints cannot be used. Nothing is written.

    Returns:
        Where the results are, the best checkpoint, the model and the data.

    Examples:
        >>> result = saunet.train(options)  # doctest: +SKIP
        >>> saunet.load(result.best).predict(image).show()  # doctest: +SKIP
    """
    folder = Path(options.output_dir)
    if not (options.resume or options.overwrite):
        check_unused(folder)
    resume = resume_path(options.resume, folder)
    if resume and options.init_from and options.init_from != _started_from(Path(resume)):
        rank_zero_info(f"init_from={options.init_from} is not used: a resumed training has its own weights")
    checkpoint = read_checkpoint(resume) if resume else None  # before the data are set up, which takes time
    seed_everything(options.seed, workers=True, verbose=False)
    learned = options.model.intrinsics == "learned"
    data = (options.data.fitted(guess_camera=True) if learned else options.data).build()
    model = assemble(options, data, pretrained=resume is None and options.init_from is None)
    loggers = _loggers(options)
    trainer = _trainer(options, loggers)
    data.setup("fit")
    data.train_dataloader()  # knows whether there are enough samples
    if trainer.log_every_n_steps == TRAINER["log_every_n_steps"]:  # type: ignore[attr-defined]
        often = max(1, total_steps(trainer, data) // POINTS)
        trainer.log_every_n_steps = min(TRAINER["log_every_n_steps"], often)  # type: ignore[attr-defined]
    if files := camera_files(drive for dataset in data.datasets.values() for drive in dataset.drives):
        rank_zero_info(files)
    if shared := data.overlap():
        rank_zero_info(shared)
    model.intrinsics = focal_lengths(options.model.intrinsics, data)
    steps = check_resume(model, checkpoint, data) if checkpoint else 0
    done = {"global_step": steps, "saunet_training": checkpoint.rest.get("saunet_training", {})} if checkpoint else {}
    due = validation_due(done)
    del checkpoint  # as large as the model and its moments
    started = warm_start(model, options.init_from) if options.init_from and not resume else None
    known = {
        "config": options.to_plain(),
        "choices": dict(choices or {}),
        "overrides": list(overrides),
        "protocol": options.protocol or data.protocol,
        "splits": data.fingerprints(),
        "samples": {split: data.summary(split) for split in data.datasets},
        "resumed": resume,
    }
    with locked(folder):
        if not (options.resume or options.overwrite):
            check_unused(folder)  # once more: another run may have ended meanwhile
        remove_partial_files(folder)
        with recording(folder, options.name, describe, **known) as record:
            model.run_record = record
            for logger in loggers if resume else ():
                keep_rows(logger, done)
            if resume or started:
                say(f"resuming from {resume}" if resume else str(started))
            if due and 0 <= trainer.max_steps <= steps:
                say("the validation after the last step was cut short; run saunet evaluate to make up for it")
            try:
                trainer.fit(model, datamodule=data, ckpt_path=resume, weights_only=True)
            except RuntimeError as error:
                if trainer.world_size > 1 and re.search(r"Connection|NCCL|Gloo|gloo|store", str(error)):
                    lost = "the connection to another process of this run was lost, most likely because it died"
                    raise SaunetError(f"{lost}; {way_on(folder / 'checkpoints')}") from error
                raise
            except SystemExit as stop:
                if trainer.is_global_zero and isinstance(stop.__context__, KeyboardInterrupt):
                    raise stop.__context__ from None  # the trainer ends without a word, and as if it had failed
                raise
            if model.intrinsics is not None:
                found = model.found_intrinsics()
                record.write(intrinsics=found.to_plain())
                rank_zero_info(model.intrinsics.told(found))
    if resume and trainer.global_step == steps:
        more = "trainer.max_steps=N" if 0 <= trainer.max_steps <= steps else "epochs=N"
        new = f"init_from={folder} in another folder starts a new one"
        say(
            f"nothing was left to train: it was complete after step {steps}; {more} continues to a later end, at the "
            f"learning rate that the schedule has there, and {new}"
        )
    elif told := _ended_early(trainer):
        rank_zero_info(told)
    if trainer.is_global_zero:
        if trainer.global_step >= DRAWN_FROM:
            _draw(folder)
        say(f"results: {folder}")
    kept = [each for each in trainer.checkpoint_callbacks if isinstance(each, BestCheckpoint)]
    best = next((Path(each.best_model_path) for each in kept if each.best_model_path), None)
    cost = next((each.cost for each in kept if each.cost is not None), None)
    return TrainResult(folder=folder, best=best, cost=cost, data=data, model=model)


def _started_from(checkpoint: Path) -> str | None:
    """Return the ``init_from`` of the run that a checkpoint belongs to; None if it had none."""
    folder = run_of(checkpoint)
    return (read(folder).get("config") or {}).get("init_from") if folder is not None else None


def _ended_early(trainer: Trainer) -> str:
    """Return a sentence about the setting that ended a training before its ``max_steps``; empty if none did."""
    if trainer.global_step >= trainer.max_steps or not 0 < (trainer.max_epochs or 0) <= trainer.current_epoch:
        return ""
    short = trainer.limit_train_batches not in (None, 1.0)
    few = f" of trainer.limit_train_batches={trainer.limit_train_batches}" if short else ""
    ended = f"trainer.max_epochs={trainer.max_epochs}{few} ended it at step {trainer.global_step}"
    return f"{ended}, before trainer.max_steps={trainer.max_steps}; set more epochs"


def _draw(folder: Path) -> None:
    """Draw the curves of the training; a failure is only reported, because the training itself has succeeded."""
    from saunet.reporting.run import write_results

    try:
        write_results(folder)
    except SaunetError as reason:
        say(f"no results.png was drawn: {reason}")


def assemble(options: TrainOptions, data: DepthDataModule, pretrained: bool = True) -> SelfSupervisedDepth:
    """Build networks, objective, recipe and metrics into the module to train.

    With ``pretrained`` they start from the public weights that the model names; a resumed training has its own weights.
    """
    pose = _pose(options.model.pose, data)
    objective = options.objective.build()
    if data.track_motion and pose is not None and "tracked_motion" not in getattr(objective, "terms", {}):
        raise ConfigError(
            "data.track_motion is true, so the pose network learns from tracked points alone, but the objective has "
            "no term for them; add +objective.extra.tracked_motion.weight=1"
        )
    measured = ["val/loss", *(f"val/{name}" for name in (*ERROR_NAMES, *getattr(objective, "terms", {}))), "train/loss"]
    one_of("monitor", options.monitor, measured)
    for name, node in (options.callbacks or {}).items():
        given = node.get("monitor") if isinstance(node, Mapping) else getattr(node, "wanted", None)
        if given is not None:
            one_of(f"callbacks.{name}.monitor", given, measured)
    record = ModelRecord(
        encoder=options.model.encoder.node,
        decoder=options.model.decoder.node,
        pose=pose.node if pose else None,
        min_depth=options.model.min_depth,
        max_depth=options.model.max_depth,
        height=data.height,
        width=data.width,
        offsets=tuple(data.offsets),
        scale=Scale(1.0, "stereo training") if data.stereo else None,
        data={"name": options.name, **options.data.node},
        plugins=plugins.loaded(),
    )
    depth, pose_network = build_networks(record, pretrained)
    divisible(data.height, data.width, depth.size_divisor, what="data.height x data.width", by="the encoder's stride")
    rules = protocol(options.protocol or data.protocol)
    if not rules.accepts(data.ground_truth):
        raise ConfigError(
            f"protocol '{rules.name}' is defined on '{rules.ground_truth}' ground truth but the data give "
            f"'{data.ground_truth}'; leave protocol unset, or choose the matching ground truth"
        )
    recipe, metrics, seed, plain = options.optim, DepthMetrics(rules), options.seed, record.to_plain()
    module = SelfSupervisedDepth(depth, pose_network, objective, recipe, metrics, seed, plain, options.speed)
    module.objective_node = options.objective.node
    return module


def _pose(pose: Spec | None, data: DepthDataModule) -> Spec | None:
    """Return the pose network that fits the data's source images."""
    if not data.offsets and not data.stereo:
        raise ConfigError(
            "data.offsets is empty and data.stereo is false, so there is no source image to learn from; "
            "set data.offsets=[-1,1] for video, data.stereo=true for a stereo pair, or both"
        )
    if not data.offsets:  # the stereo rig's motion is known
        return None
    if pose is None:
        raise ConfigError(
            f"model.pose is null but the data give neighbors in time at {list(data.offsets)}, and their motion must "
            "be learned; choose a model/pose, or learn from a stereo pair alone with data.stereo=true "
            "data.offsets=[]"
        )
    offsets = pose.get("offsets", data.offsets)
    if list(offsets) != list(data.offsets):
        raise ConfigError(
            f"model.pose.offsets is {list(offsets)} but the data give frames at {list(data.offsets)}; set "
            "data.offsets only; the pose network follows"
        )
    return pose.changed(offsets=list(data.offsets))


def _loggers(options: TrainOptions) -> list[Any]:
    nodes = options.logger
    if nodes is None:
        where = {"save_dir": str(options.output_dir), "name": None}
        nodes = {
            name: {"_target_": f"lightning.pytorch.loggers.{target}", "version": name, **where}
            for name, target in LOGGERS.items()
        }
    built = [_part(f"logger.{name}", node, Logger) for name, node in nodes.items()]
    return [each for each in built if each is not None]


def _callbacks(options: TrainOptions) -> list[Any]:
    nodes: Mapping[str, Any] | None = options.callbacks
    if nodes is None:
        nodes = {name: {"_target_": f"saunet.training.{target}"} for name, (target, _) in CALLBACKS.items()}
    built = []
    for name, node in nodes.items():
        if isinstance(node, Mapping):
            places = CALLBACKS[name][1] if name in CALLBACKS else {}
            given = {key: str(Path(options.output_dir, place)) for key, place in places.items()}
            node = {**given, **({"monitor": options.monitor} if name == "best" else {}), **node}
        built.append(_part(f"callbacks.{name}", node, Callback))
    return [each for each in built if each is not None]


def _trainer(options: TrainOptions, loggers: list[Any]) -> Trainer:
    arguments = {key: _part(f"trainer.{key}", value, object) for key, value in {**TRAINER, **options.trainer}.items()}
    plugins = [AtomicCheckpointIO(), *(arguments.pop("plugins", None) or [])]
    callbacks = [*_callbacks(options), *(arguments.pop("callbacks", None) or [])]
    arguments |= {"logger": loggers or False, "default_root_dir": str(options.output_dir)}
    try:
        return EpochLoop.install(Trainer(**arguments, callbacks=callbacks, plugins=plugins))
    except (MisconfigurationException, ValueError, TypeError) as reason:
        raise ConfigError(" ".join(f"trainer: {reason}".split())) from reason


def _part(key: str, node: Any, kind: type) -> Any:
    """Build a callback, logger or part of the trainer from its node; anything else is returned as it is."""
    if isinstance(node, list | tuple):
        return [_part(key, each, object) for each in node]
    if node is None or not isinstance(node, Mapping):
        if node is not None and not isinstance(node, kind):
            raise ConfigError(f"{key} is {node!r}; it must be a {kind.__name__}, or a mapping with '_target_'")
        return node
    if "_target_" not in node:
        if kind is object:
            return {each: _part(f"{key}.{each}", value, object) for each, value in node.items()}
        raise ConfigError(f"{key} has no '_target_'; name its class, or set {key}=null")
    path = str(node["_target_"])
    module, _, name = path.rpartition(".")
    if kind is object and not path.startswith(_TRUSTED):
        raise ConfigError(
            f"{key} asks for '{path}'; only parts of {', '.join(each[:-1] for each in _TRUSTED)} are built"
        )
    try:
        target = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as reason:
        raise ConfigError(f"{key} asks for '{path}', which cannot be imported: {reason}") from reason
    if kind is not object and not (inspect.isclass(target) and issubclass(target, kind)):
        raise ConfigError(f"{key} asks for '{path}', which is not a {kind.__name__}")
    values = {each: _part(f"{key}.{each}", value, object) for each, value in node.items() if each[:1] != "_"}
    try:
        return target(**values)
    except ModuleNotFoundError as reason:
        what = key.replace(".", "=", 1)  # the choice of the command line
        raise ConfigError(
            f"{what} needs a package that is not installed; run `pip install 'saunet[track]'`"
        ) from reason
    except (SaunetError, ValueError, TypeError) as reason:
        raise ConfigError(" ".join(f"{key}: {reason}".split())) from reason
