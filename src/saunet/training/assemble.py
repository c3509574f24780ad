"""From a plain training config to the LightningModule: the one place where all parts meet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from saunet.data.module import DepthDataModule
from saunet.errors import ConfigError, divisible, one_of
from saunet.metrics.depth import DepthMetrics
from saunet.metrics.functional import ERROR_NAMES
from saunet.metrics.protocols import protocol
from saunet.registry import instantiate
from saunet.runs.checkpoint import build_networks
from saunet.runs.record import ModelRecord, Scale
from saunet.training.module import SelfSupervisedDepth
from saunet.training.optim import Recipe
from saunet.training.speed import Speed


def assemble(cfg: Mapping[str, Any], data: DepthDataModule, pretrained: bool = True) -> SelfSupervisedDepth:
    """Build networks, objective, recipe and metrics from a resolved training config.

    Args:
        cfg: Plain containers with the keys of `saunet.roots.TrainConfig`.
        data: What the model will be trained on; it names the validation protocol if the config does not.
        pretrained: Whether to start from the public weights that the config names; a resumed training has its own.

    Raises:
        ConfigError: if a part cannot be built, or the parts do not fit together.
        CheckpointError: if public weights cannot be fetched, read or fitted.
    """
    _check_sources(cfg, data)
    objective = instantiate(cfg["objective"])
    _check_monitor(cfg, getattr(objective, "terms", {}))
    model = cfg["model"] if data.offsets else {**cfg["model"], "pose": None}  # the stereo rig's motion is known
    record = ModelRecord(
        **model,
        height=data.height,
        width=data.width,
        offsets=tuple(data.offsets),
        scale=Scale(1.0, "stereo training") if data.stereo else None,
        data={"name": cfg["name"], **cfg["data"]},
    )
    depth, pose = build_networks(record, pretrained)
    divisible(data.height, data.width, depth.size_divisor, what="data.height x data.width", by="the encoder's stride")
    rules = protocol(cfg.get("protocol") or data.protocol)
    if not rules.accepts(data.ground_truth):
        raise ConfigError(
            f"protocol '{rules.name}' is defined on '{rules.ground_truth}' ground truth and the data give "
            f"'{data.ground_truth}'; leave protocol unset, or choose the matching ground truth"
        )
    module = SelfSupervisedDepth(
        depth=depth,
        pose=pose,
        objective=objective,
        recipe=Recipe(**_settings(cfg["optim"])),
        metrics=DepthMetrics(rules),
        seed=cfg["seed"],
        record=record.to_plain(),
        speed=Speed(**_settings(cfg.get("speed", {}))),
    )
    module.objective_node = cfg["objective"]
    return module


def _settings(node: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in node.items() if not key.startswith("_")}


def _check_monitor(cfg: Mapping[str, Any], terms: Iterable[str]) -> None:
    """Check that what shall choose ``best.ckpt`` is something that a training measures.

    Raises:
        ConfigError: otherwise.
    """
    measured = ["val/loss", *(f"val/{name}" for name in (*ERROR_NAMES, *terms)), "train/loss"]
    if "monitor" in cfg:
        one_of("monitor", cfg["monitor"], measured)
    for name, node in (cfg.get("callbacks") or {}).items():
        if node and str(node.get("_target_")).endswith(".BestCheckpoint"):
            one_of(f"callbacks.{name}.monitor", node.get("monitor", measured[0]), measured)


def _check_sources(cfg: Mapping[str, Any], data: DepthDataModule) -> None:
    """Check that there is something to synthesize the target from, and that the pose network expects it.

    Raises:
        ConfigError: otherwise.
    """
    if not data.offsets and not data.stereo:
        raise ConfigError(
            "data.offsets is empty and data.stereo is false, so there is no source image to learn from; "
            "set data.offsets=[-1,1] for video, data.stereo=true for a stereo pair, or both"
        )
    if cfg["model"]["pose"] is None:
        if not data.offsets:  # the stereo rig's motion is known
            return
        raise ConfigError(
            f"model.pose is null but the data give neighbors in time at {list(data.offsets)}, whose motion has to be "
            "learnt; choose a model/pose, or learn from a stereo partner alone with data.stereo=true data.offsets=[]"
        )
    offsets = cfg["model"]["pose"]["offsets"]
    if list(offsets) != list(data.offsets):
        raise ConfigError(
            f"model.pose.offsets is {list(offsets)} but the data give frames at {list(data.offsets)}; "
            "set data.offsets only, the pose network follows"
        )
