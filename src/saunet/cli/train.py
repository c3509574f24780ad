"""``saunet-train``: train a depth network on driving video."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.utils import instantiate as hydra_instantiate
from omegaconf import DictConfig

from saunet import config
from saunet.cli._app import run


def train(cfg: DictConfig) -> Any:
    """Build every part from the config, train, print where the results are, and return the data module."""
    from lightning import seed_everything

    from saunet.checkpoint import load_weights, read_checkpoint
    from saunet.lit.assemble import assemble
    from saunet.lit.storage import AtomicCheckpointIO
    from saunet.registry import instantiate

    config.check(cfg)
    seed_everything(cfg.seed, workers=True, verbose=False)
    data = instantiate(config.plain(cfg.data))
    resume = str(Path(cfg.resume).expanduser().resolve()) if cfg.resume else None
    model = assemble(config.plain(cfg), data, pretrained=resume is None)
    if resume:  # what does not fit fails here in one sentence rather than deep inside the trainer
        checkpoint = read_checkpoint(resume)
        checkpoint.record.check_same_training(model.record)
        load_weights(model.depth, checkpoint.weights("depth"), "depth network")
        if model.pose is not None:
            load_weights(model.pose, checkpoint.weights("pose"), "pose network")
    trainer = hydra_instantiate(
        cfg.trainer,
        callbacks=[hydra_instantiate(callback) for callback in cfg.callbacks.values() if callback],
        logger=[hydra_instantiate(logger) for logger in cfg.logger.values() if logger] or False,
        plugins=[AtomicCheckpointIO()],
        default_root_dir=cfg.output_dir,
    )
    trainer.fit(model, datamodule=data, ckpt_path=resume, weights_only=True)
    if trainer.is_global_zero:
        print(f"results: {cfg.output_dir}")
    return data


def main() -> None:
    """Entry point of ``saunet-train``."""
    config.register_training_configs()
    run("train", train)


if __name__ == "__main__":
    main()
