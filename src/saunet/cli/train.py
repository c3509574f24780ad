"""``saunet-train``: train a depth network on driving video."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hydra.utils import instantiate as hydra_instantiate
from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import run, sentence
from saunet.errors import SaunetError


def train(cfg: DictConfig) -> float | None:
    """Train, print where the results are, and return what a search minimizes: see `BestCheckpoint.cost`."""
    return fit(cfg)[1]


def fit(cfg: DictConfig) -> tuple[Any, float | None]:
    """Build every part from the config and train; ``run.json`` in the run's folder says how that went.

    Returns:
        The data module, and the best monitored value, its negative where more is better.
    """
    from hydra.core.hydra_config import HydraConfig
    from lightning import seed_everything

    from saunet.registry import instantiate
    from saunet.runs.folder import recording
    from saunet.training.assemble import assemble
    from saunet.training.callbacks import AtomicCheckpointIO, BestCheckpoint, SplitsRecorded
    from saunet.training.resume import check_resume, check_unused, keep_rows, resume_path, warm_start
    from saunet.training.stopping import way_on

    config.check(cfg)
    if not (cfg.resume or cfg.overwrite):
        check_unused(cfg.output_dir)
    hydra = HydraConfig.get()
    known = {"config": config.plain(cfg), "choices": config.plain(hydra.runtime.choices)}
    with recording(cfg.output_dir, cfg.name, sentence, overrides=list(hydra.overrides.task), **known) as record:
        resume = resume_path(cfg.resume, cfg.output_dir, cfg.init_from)
        seed_everything(cfg.seed, workers=True, verbose=False)
        data = instantiate(config.plain(cfg.data))
        record.write(protocol=cfg.protocol or data.protocol)
        model = assemble(config.plain(cfg), data, pretrained=resume is None and cfg.init_from is None)
        loggers = [hydra_instantiate(logger) for logger in cfg.logger.values() if logger]
        if resume:
            steps = check_resume(model, resume)
            for logger in loggers:
                keep_rows(logger, steps)
            record.write(resumed=resume)
            print(f"going on from {resume}")
        elif cfg.init_from:
            print(warm_start(model, cfg.init_from))
        callbacks = [hydra_instantiate(callback) for callback in cfg.callbacks.values() if callback]
        trainer = hydra_instantiate(
            cfg.trainer,
            callbacks=[SplitsRecorded(record), *callbacks],
            logger=loggers or False,
            plugins=[AtomicCheckpointIO()],
            default_root_dir=cfg.output_dir,
        )
        try:
            trainer.fit(model, datamodule=data, ckpt_path=resume, weights_only=True)
        except RuntimeError as error:
            if trainer.world_size > 1 and re.search(r"Connection|NCCL|Gloo|gloo|store", str(error)):
                lost = "the connection to another process of this run broke, most likely because it died"
                raise SaunetError(f"{lost}; {way_on(Path(cfg.output_dir) / 'checkpoints')}") from error
            raise
    if trainer.is_global_zero:
        print(f"results: {cfg.output_dir}")
    costs = [each.cost for each in trainer.checkpoint_callbacks if isinstance(each, BestCheckpoint)]
    return data, next((cost for cost in costs if cost is not None), None)


def main() -> None:
    """Entry point of ``saunet-train``."""
    config.register_training_configs()
    run("train", train)


if __name__ == "__main__":
    main()
