"""``saunet-evaluate``: score a checkpoint against ground truth, beside predictors that look at no image."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from saunet import config
from saunet.checks import DataError, one_of
from saunet.cli._app import pick_device, run


def evaluate_model(
    network: Any,
    data: Any,
    protocols: Sequence[str],
    *,
    split: str = "test",
    flip: bool = False,
    baselines: bool = True,
) -> Any:
    """Score a depth network on one split of a data module.

    Args:
        network: A depth network, on the device it is to run on.
        data: A data module with ground truth.
        protocols: Names of protocols; none for the data set's own.
        split: ``test`` or ``val``.
        flip: Average with the prediction of the mirrored image.
        baselines: Also score constant depth and the mean depth map of the training split.

    Returns:
        A `saunet.evaluation.EvaluationResult`.

    Raises:
        ConfigError: if a protocol does not fit the data set's ground truth.
        DataError: if the split has no frame with ground truth.
    """
    from saunet.evaluation import NetworkPredictor, evaluate
    from saunet.metrics.baselines import ConstantDepth
    from saunet.metrics.protocols import protocol

    one_of("split", split, ("val", "test"))
    predictors = {"model": NetworkPredictor(network, flip=flip)}
    if baselines:
        predictors["constant depth"] = NetworkPredictor(ConstantDepth())
        mean = _mean_depth_map(data)
        if mean is not None:
            predictors["mean depth map"] = NetworkPredictor(mean)
    data.setup("test" if split == "test" else "fit")
    return evaluate(
        predictors,
        data.batches(split, next(network.parameters()).device),
        [protocol(name) for name in protocols or [data.protocol]],
        ground_truth=data.ground_truth,
        total=len(data.datasets[split]),
    )


def _mean_depth_map(data: Any) -> Any:
    """Return the mean depth map of the training split, or None, and say so, where there is no training depth."""
    from saunet.metrics.baselines import MeanDepthMap

    mean = MeanDepthMap()
    try:
        data.setup("fit")
        for depth in data.ground_truths("train"):
            mean.update(depth[None], torch.tensor([depth.shape[-2:]]))
        mean.depth_map()
    except DataError as reason:
        print(f"the mean depth map is left out: {reason}", file=sys.stderr)
        return None
    return mean


def evaluate(cfg: DictConfig) -> None:
    """Load the checkpoint and the data, print the tables, write them to the output folder."""
    from saunet.checkpoint import read_checkpoint
    from saunet.evaluation import print_table, write_results
    from saunet.registry import instantiate

    checkpoint = read_checkpoint(cfg.checkpoint)
    network, _ = checkpoint.networks()
    data = instantiate({**config.plain(cfg.data), "height": checkpoint.record.height, "width": checkpoint.record.width})
    result = evaluate_model(
        network.to(pick_device(cfg.device)),
        data,
        list(cfg.protocols or []),
        split=cfg.split,
        flip=cfg.flip,
        baselines=cfg.baselines,
    )
    print_table(result)
    write_results(result, Path(cfg.output_dir))
    print(f"results: {cfg.output_dir}")


def main() -> None:
    """Entry point of ``saunet-evaluate``."""
    run("evaluate", evaluate)


if __name__ == "__main__":
    main()
