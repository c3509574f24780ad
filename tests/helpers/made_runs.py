"""Run folders as trainings leave them, made without training."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from saunet.fingerprint import fingerprint
from saunet.metrics.functional import ERROR_NAMES
from saunet.runs.checkpoint import atomic_save, build_networks
from saunet.runs.record import ModelRecord

ERRORS = (0.2, 1.5, 6.0, 0.3, 0.7, 0.9, 0.95)
ENCODERS = {
    "stratified_nano": {
        "_target_": "saunet.models.encoders.stratified.StratifiedTransformer",
        "dim": 8,
        "depths": [1, 1, 1, 1],
        "heads": [1, 1, 1, 1],
        "window": [4, 4, 4, 4],
    },
    "resnet18": {"_target_": "saunet.models.encoders.resnet.ResNetEncoder"},
}
DECODERS = {
    "aunet": {"_target_": "saunet.models.decoders.aunet.AUNetDecoder", "width": 8, "fine": 4, "attention": "eca"},
    "unet": {"_target_": "saunet.models.decoders.unet.UNetDecoder"},
}


def hydra_files(
    folder: Path, config: Mapping[str, Any], choices: Mapping[str, str], overrides: Sequence[str] = (), job: int = 0
) -> None:
    """Write what Hydra writes into a run's folder."""
    place = folder / ".hydra"
    place.mkdir(parents=True, exist_ok=True)
    hydra = {
        "runtime": {"choices": {**choices, "hydra/launcher": "basic"}, "cwd": str(folder.parent)},
        "job": {"num": job},
    }
    for name, content in (("config", config), ("hydra", {"hydra": hydra}), ("overrides", list(overrides))):
        (place / f"{name}.yaml").write_text(yaml.safe_dump(content))


def make_run(
    folder: Path,
    *,
    encoder: str = "stratified_nano",
    decoder: str = "aunet",
    alpha: float = 10.0,
    beta: float = 0.1,
    abs_rel: Sequence[float] = (0.4, 0.2, 0.3),
    overrides: Sequence[str] = (),
    job: int = 0,
    **record: Any,
) -> Path:
    """Write a training of three steps an epoch; ``record`` is its run.json, absent if empty."""
    config = {
        "model": {"encoder": ENCODERS[encoder], "decoder": DECODERS[decoder], "pose": {"offsets": "${data.offsets}"}},
        "objective": {"_target_": "x.SaunetObjective", "alpha": alpha, "beta": beta, "gradient": {"target": "image"}},
        "data": {"_target_": "x.Data", "offsets": [-1, 1], "height": 32, "width": 64},
        "optim": {"lr": 0.001},
        "name": folder.name,
        "output_dir": str(folder),
    }
    choices = {"model/encoder": encoder, "model/decoder": decoder, "objective": "saunet", "data": "synthetic"}
    hydra_files(folder, config, choices, overrides, job)
    if record:
        (folder / "run.json").write_text(json.dumps({"name": folder.name, "error": None, **record}))
    if abs_rel:
        columns = [
            "epoch",
            "step",
            "train/loss",
            "train/photometric",
            *(f"val/{name}" for name in ERROR_NAMES),
            "val/images",
        ]
        (folder / "csv").mkdir()
        with (folder / "csv" / "metrics.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            for epoch, value in enumerate(abs_rel):
                for step in range(3 * epoch, 3 * epoch + 3):
                    writer.writerow(
                        {"epoch": epoch, "step": step, "train/loss": 2.0 - 0.1 * step, "train/photometric": 0.1}
                    )
                errors = dict(zip((f"val/{name}" for name in ERROR_NAMES), (value, *ERRORS[1:]), strict=True))
                writer.writerow({"epoch": epoch, "step": 3 * epoch + 2, **errors, "val/images": 4})
    return folder


def add_checkpoint(folder: Path) -> Path:
    """Give a run of the stratified encoder and the attention decoder a checkpoint of a very small network."""
    record = ModelRecord(
        ENCODERS["stratified_nano"], {**DECODERS["aunet"], "_partial_": True}, None, 0.1, 100.0, 32, 64
    )
    depth, _ = build_networks(record)
    state = {f"depth.{key}": value for key, value in depth.state_dict().items()}
    file = folder / "checkpoints" / "best.ckpt"
    atomic_save({"saunet": record.to_plain(), "state_dict": state}, file)
    return file


def make_evaluation(
    folder: Path,
    checkpoint: Path | str | None,
    abs_rel: float = 0.25,
    protocol: str = "synthetic",
    images: int = 6,
    drive: str = "drive",
    **settings: Any,
) -> Path:
    """Write what saunet evaluate writes: a model and constant depth, six images.

    Without a checkpoint, ``settings`` name the predictions of another system.
    """
    config = {"checkpoint": str(checkpoint)} if checkpoint else {"predictions": settings["predictions"]}
    hydra_files(folder, {**config, "split": "test"}, {"data": "synthetic"})
    rows = [("model" if checkpoint else "predictions", abs_rel), ("constant depth", 0.5)]
    names = [f"{drive} {index:06d}" for index in range(images)]
    results = [
        {
            "predictor": who,
            "protocol": protocol,
            **dict(zip(ERROR_NAMES, (value, *ERRORS[1:]), strict=True)),
            "images": images,
        }
        for who, value in rows
    ]
    content = {"settings": settings, "protocols": [], "results": results, "images": {protocol: fingerprint(names)}}
    (folder / "metrics.json").write_text(json.dumps(content))
    with (folder / "per_image.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["predictor", "protocol", "name", "pixels", "scale", *ERROR_NAMES])
        for who, value in rows:
            for index, name in enumerate(names):
                writer.writerow([who, protocol, name, 100, 1.0, value + 0.01 * index, *ERRORS[1:]])
    return folder
