"""``saunet-evaluate``: score a checkpoint against ground truth, beside predictors that look at no image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from saunet import config
from saunet.checks import ConfigError, one_of
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
        ConfigError: if the data set has no ground truth, or a protocol does not fit it.
    """
    from saunet.evaluation import NetworkPredictor, evaluate
    from saunet.metrics.baselines import ConstantDepth, MeanDepthMap
    from saunet.metrics.protocols import protocol

    one_of("split", split, ("val", "test"))
    if data.ground_truth is None:
        raise ConfigError(
            f"data set '{type(data).__name__}' has no ground truth; choose one that has, such as data=kitti"
        )
    predictors = {"model": NetworkPredictor(network, flip=flip)}
    if baselines:
        predictors["constant depth"] = NetworkPredictor(ConstantDepth())
        data.setup("fit")
        mean = MeanDepthMap()
        for depth in data.ground_truths("train"):
            mean.update(depth[None], depth.new_tensor([depth.shape[-2:]]).long())
        if mean.count.sum() > 0:
            predictors["mean depth map"] = NetworkPredictor(mean)
    data.setup("test" if split == "test" else "fit")
    return evaluate(
        predictors,
        data.eval_batches(split, next(network.parameters()).device),
        [protocol(name) for name in protocols or [data.protocol]],
        ground_truth=data.ground_truth,
        total=len(data.datasets[split]),
    )


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
