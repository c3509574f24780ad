"""From a plain training config to the LightningModule: the one place where all parts meet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from saunet import __version__
from saunet.checks import divisible
from saunet.checkpoint import FORMAT, ModelRecord, build_networks
from saunet.data.module import DepthDataModule
from saunet.lit.module import SelfSupervisedDepth
from saunet.metrics.depth import DepthMetrics
from saunet.metrics.protocols import protocol
from saunet.registry import instantiate


def assemble(cfg: Mapping[str, Any], data: DepthDataModule) -> SelfSupervisedDepth:
    """Build networks, objective, recipe and metrics from a resolved training config.

    Args:
        cfg: Plain containers with the keys of `saunet.config.TrainConfig`.
        data: The data module the model will be trained on; it names the protocol if the config does not.

    Raises:
        ConfigError: if a part cannot be built or the image size does not fit the encoder.
    """
    raise NotImplementedError((FORMAT, __version__, divisible, ModelRecord, build_networks, DepthMetrics, protocol, instantiate))
