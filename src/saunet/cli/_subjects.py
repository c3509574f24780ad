"""What ``saunet-evaluate`` scores: a checkpoint, or predictions made elsewhere; each with the data as it wants them."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import torch
from omegaconf import DictConfig

from saunet import config, schema
from saunet.cli._app import pick_device
from saunet.errors import ConfigError, DataError, one_of


def subject_of(cfg: DictConfig) -> Subject:
    """Return what a configuration asks to score.

    Raises:
        ConfigError: if it names a checkpoint and predictions, or neither.
        CheckpointError: if the checkpoint cannot be read.
    """
    if (cfg.checkpoint is None) == (cfg.predictions is None):
        raise ConfigError(
            "give checkpoint=FILE to score a model, or predictions=FILE_OR_FOLDER to score what another system "
            f"predicted; {'neither is' if cfg.checkpoint is None else 'both are'} set"
        )
    return CheckpointSubject(cfg) if cfg.checkpoint is not None else ForeignSubject(cfg)


class Subject:
    """One thing to score.

    Args:
        cfg: Root of ``saunet-evaluate``.
        fixed: Keys of the data that it decides.
    """

    motion: Any = None
    """The camera's motion as it predicts it, for protocols without ground truth."""
    exporter: Any = None
    """What writes its predictions, once there is one."""

    def __init__(self, cfg: DictConfig, fixed: Mapping[str, Any]) -> None:
        self.cfg = cfg
        node = config.plain(cfg.data)
        self.node = {**node, **{key: value for key, value in fixed.items() if key in node}}

    def data(self, kind: str | None) -> Any:
        """Return the data module, with ground truth of a kind where it has the choice.

        Raises:
            ConfigError: if a protocol needs ground truth that these data cannot give.
        """
        from saunet.registry import instantiate

        chosen = {"depth": kind} if kind is not None and "depth" in self.node else {}
        data = instantiate({**self.node, **chosen})
        if kind is None:  # the first call: before anything is scored
            self._check_protocols(data)
        return data

    def _check_protocols(self, data: Any) -> None:
        from saunet.metrics.protocols import protocol

        choice = schema.parameters(type(data))["depth"].annotation if "depth" in self.node else None
        kinds = tuple(dict.fromkeys([data.ground_truth, *get_args(choice)]))
        for name in self.cfg.protocols or []:
            rules = protocol(name)
            if rules.ground_truth not in ("none", *kinds) and not rules.accepts(data.ground_truth):
                raise ConfigError(
                    f"protocols names '{name}', which is defined on '{rules.ground_truth}' ground truth, and "
                    f"these data give {' or '.join(kinds)}; choose other protocols or data"
                )

    def predictors(self, data: Any) -> dict[str, Any]:
        """Return what to score on these data, first the subject, then those that look at no image."""
        from saunet.data.truth_cache import cache_truths
        from saunet.evaluation.export import ExportingPredictor
        from saunet.metrics.protocols import protocol

        name, predictor = self.predictor(data)
        if self.cfg.truth_cache:
            cache_truths(data.datasets[self.cfg.split].drives, self.cfg.truth_cache)
        if self.cfg.export and self.exporter is None:  # in the first pass, which is of the first protocol's truth
            rules = protocol((list(self.cfg.protocols or []) or [data.protocol])[0])
            predictor = self.exporter = ExportingPredictor(predictor, Path(self.cfg.export), rules)
        baselines = self.cfg.baselines and data.ground_truth != "none"  # else there is no depth to beat them in
        return {name: predictor, **(trivial(data, self.cfg.truth_cache) if baselines else {})}

    def predictor(self, data: Any) -> tuple[str, Any]:
        """Return its name in tables, and itself."""
        raise NotImplementedError

    def settings(self) -> dict[str, object]:
        """Return what the numbers depend on, as plain data."""
        return {"split": self.cfg.split, "post_processing": "monodepth blend of two flips" if self.cfg.flip else None}


class CheckpointSubject(Subject):
    """A trained model.

    Args:
        cfg: Root of ``saunet-evaluate``.
    """

    def __init__(self, cfg: DictConfig) -> None:
        from saunet.evaluation.views import PoseNetwork
        from saunet.weights.files import read_model

        checkpoint = read_model(cfg.checkpoint)
        record = checkpoint.record
        fixed = {"height": record.height, "width": record.width}
        super().__init__(cfg, {**fixed, "offsets": list(record.offsets)} if record.pose else fixed)
        self.device, self.record = pick_device(cfg.device), record
        network, pose = checkpoint.networks()
        self.network: Any = network.to(self.device)
        self.motion = PoseNetwork(pose.to(self.device)) if pose is not None else None
        self.scale: dict[str, Any] | None = None

    def predictor(self, data: Any) -> tuple[str, Any]:
        """Return the depth network, with Monodepth's blend of two flips if that is wanted."""
        from saunet.cli._scale import apply_scale
        from saunet.evaluation import NetworkPredictor

        if self.scale is None:  # once: other ground truth is of the same images
            pose = self.motion.network if self.motion else None
            self.network, pose, self.scale = apply_scale(self.cfg, self.record, self.network, pose, data)
            if self.motion:
                self.motion.network = pose
        return "model", NetworkPredictor(self.network, flip=self.cfg.flip)

    def settings(self) -> dict[str, object]:
        """Return the checkpoint's path too."""
        return {"checkpoint": str(self.cfg.checkpoint), **super().settings(), "scale": self.scale}


class ForeignSubject(Subject):
    """Predictions in files.

    Args:
        cfg: Root of ``saunet-evaluate``.

    Raises:
        ConfigError: if it asks for what only a model can give.
    """

    def __init__(self, cfg: DictConfig) -> None:
        # One image at a time: files of a folder may differ in size.
        super().__init__(cfg, {"batch_size": 1})
        if cfg.predicted is not None:
            one_of("predicted", cfg.predicted, ("disparity", "depth"))
        if cfg.flip:
            raise ConfigError("flip=true blends two predictions of a model; leave it out with predictions=...")
        if cfg.scale.method != "auto":
            raise ConfigError("scale.method measures the scale of a model; leave it out with predictions=...")

    def predictor(self, data: Any) -> tuple[str, Any]:
        """Return the reader of the files, in the order in which the split lists its images."""
        from saunet.evaluation.foreign import foreign_predictor

        names = data.listed(self.cfg.split)
        return "predictions", foreign_predictor(Path(self.cfg.predictions), names, self.cfg.predicted, self.cfg.match)

    def settings(self) -> dict[str, object]:
        """Return the files' path too."""
        return {"predictions": str(self.cfg.predictions), "match": self.cfg.match, **super().settings()}


def trivial(data: Any, truth_cache: str | None = None) -> dict[str, Any]:
    """Return constant depth and, where the training split has depth, its mean map; say so where it has none."""
    from saunet.data.truth_cache import cache_truths
    from saunet.evaluation import NetworkPredictor
    from saunet.metrics.baselines import ConstantDepth, MeanDepthMap

    found, mean = {"constant depth": NetworkPredictor(ConstantDepth())}, MeanDepthMap()
    try:
        data.setup("fit")
        if truth_cache:
            cache_truths(data.datasets["train"].drives, truth_cache)
        for depth in data.ground_truths("train"):
            mean.update(depth[None], torch.tensor([depth.shape[-2:]]))
        mean.depth_map()
    except DataError as reason:
        print(f"the mean depth map is left out: {reason}", file=sys.stderr)
        return found
    return {**found, "mean depth map": NetworkPredictor(mean)}
