"""``saunet-evaluate``: score a checkpoint, or predictions made elsewhere, beside predictors that look at no image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from saunet.cli._app import pick_device, run
from saunet.cli._subjects import subject_of, trivial
from saunet.errors import ConfigError


def evaluate_model(network: Any, data: Any, protocols: Sequence[str], *, split: str = "test") -> Any:
    """Score a depth network, on its device, beside the trivial predictors on one split of a data module.

    Args:
        network: Takes images, b x 3 x h x w, and returns a `saunet.types.DepthPyramid`.
        data: A data module, not necessarily set up, at the network's size.
        protocols: Names of protocols; none for the data set's own.
        split: ``test`` or ``val``.

    Raises:
        ConfigError: if a protocol does not fit the data set's ground truth.
        DataError: if the split has no frame with ground truth.
    """
    from saunet.evaluation import NetworkPredictor, evaluate_protocols

    return evaluate_protocols(
        protocols,
        lambda kind: data,
        lambda each: {"model": NetworkPredictor(network), **trivial(each)},
        split=split,
        device=next(network.parameters()).device,
    )


def evaluate(cfg: DictConfig) -> None:
    """Load what is scored and the data, print the tables, write them to the output folder.

    Raises:
        ConfigError: if a setting is out of range.
    """
    from hydra.core.hydra_config import HydraConfig

    from saunet.evaluation import (
        evaluate_protocols,
        print_table,
        read_earlier,
        with_statistics,
        write_results,
    )
    from saunet.evaluation.breakdown import Buckets
    from saunet.io.atomic import check_folder

    if cfg.intervals and not 0 < cfg.intervals < 1:
        raise ConfigError(f"intervals is {cfg.intervals:g}; it must lie between 0 and 1, such as intervals=0.95")
    earlier = read_earlier(Path(cfg.compare)) if cfg.compare else None
    check_folder(cfg.output_dir)
    subject = subject_of(cfg)
    result = evaluate_protocols(
        list(cfg.protocols or []),
        subject.data,
        subject.predictors,
        motion=subject.motion,
        split=cfg.split,
        device=pick_device(cfg.device),
        buckets=Buckets(tuple(cfg.distances)) if cfg.buckets else None,
    )
    data = HydraConfig.get().runtime.choices["data"]
    result = replace(result, settings={"data": data, **subject.settings()})
    if earlier is not None:
        write_results(result, Path(cfg.output_dir))  # an evaluation that does not compare is not lost
    result = with_statistics(result, cfg.intervals, earlier)
    print_table(result)
    for source in cfg.data.get("sources") or {}:  # of a mixture
        alone = result.part(f"{source}/")
        if alone.protocols:
            print(f"{source} alone:")
            print_table(alone)
    write_results(result, Path(cfg.output_dir))
    if subject.exporter is not None:
        print(subject.exporter)
    print(f"results: {cfg.output_dir}")


def main() -> None:
    """Entry point of ``saunet-evaluate``."""
    run("evaluate", evaluate)


if __name__ == "__main__":
    main()
