"""A trained model as a folder to deploy or share: exported files, each checked against the network, and a card."""

from __future__ import annotations

import contextlib
import json
import math
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from saunet.errors import CheckpointError, ConfigError, DataError, checked, one_of
from saunet.exporting import exporters
from saunet.exporting.card import model_card
from saunet.exporting.parity import Parity, Run, compare, parity_table, random_images, timed
from saunet.io.atomic import remove_partial_files, replacing, write_bytes, write_json
from saunet.io.images import network_input, read_image
from saunet.io.plain import read_json
from saunet.models.depth import DepthNet
from saunet.prediction.sources import find_sources
from saunet.runs.record import Intrinsics, ModelRecord
from saunet.tables import show
from saunet.weights.files import read_model, restored, write_safetensors
from saunet.weights.locate import CARD, CONFIG, POSE, WEIGHTS, check_push, push

FORMATS: tuple[str, ...] = ("onnx", "openvino", "program", "compiled", "safetensors")
"""``onnx``: for onnxruntime, TensorRT and others. ``openvino``: for Intel's runtime. ``program`` (torch.export): for
torch without saunet. ``compiled`` (AOTInductor): machine code, for torch or C++. ``safetensors``: the weights, for
saunet and the hub."""
DEFAULT_FORMATS: tuple[str, ...] = ("onnx", "program", "safetensors")
TOLERANCE = 1e-4
"""Largest accepted difference from the original network, as a fraction of the range of disparity."""
FILES = {
    "onnx": "model.onnx",
    "openvino": "model.xml",
    "program": "model.pt2",
    "compiled": "model.aoti.pt2",
    "safetensors": WEIGHTS,
}
REPORT = "report.json"
OPENVINO_WEIGHTS = "model.bin"
"""The weights of ``model.xml``."""

_REAL_AT_MOST = 8
_PLACES = ("root", "cache")
"""Paths of the training data: private, and they say nothing about the data."""


@checked
@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of `export`: what it writes, and where.

    Args:
        checkpoint: The model: a checkpoint, an exported folder, or a shipped model's name.
        output: The folder for the model's files, ``config.json``, ``report.json`` and ``README.md``.
        formats: ``onnx``, ``openvino``, ``program`` (torch.export), ``compiled`` (AOTInductor), ``safetensors``.
        images: Real images to compare on, besides random ones: a file, a folder or a pattern, in Python also several;
            at most eight are used, evenly spread.
        batch: Number of images the files take at once: ``any``, ``one``, or ``auto``: any if the network allows it.
        opset: ONNX opset: 20, or 18 or 17 for older runtimes.
        evaluation: A ``metrics.json`` of an evaluation, or its folder, for the model card.
        push: Upload the folder to this repository of the Hugging Face hub, ``organization/name``; a new one is private.
        overwrite: Replace the files of an earlier export in the folder.

    Raises:
        ConfigError: for an unknown format, batch or opset.

    Examples:
        >>> saunet.ExportOptions(checkpoint="last.ckpt", output="exported").formats
        ('onnx', 'program', 'safetensors')
    """

    checkpoint: str | Path
    output: str | Path
    formats: Sequence[str] = DEFAULT_FORMATS
    images: Sequence[str | Path] | str | Path | None = None
    batch: str = "auto"
    opset: int = exporters.OPSETS[-1]
    evaluation: str | Path | None = None
    push: str | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        for name in self.formats:
            one_of("formats", name, FORMATS)
        if not self.formats:
            raise ConfigError(f"formats is empty; allowed: {', '.join(FORMATS)}")
        if self.push is not None:
            check_push(self.push)
            if not {"safetensors", "onnx"} & set(self.formats):
                raise ConfigError(
                    f"formats is [{','.join(self.formats)}]; push needs safetensors or onnx, which saunet.load reads"
                )
        one_of("batch", self.batch, exporters.BATCHES)
        one_of("opset", str(self.opset), map(str, exporters.OPSETS))


@dataclass(frozen=True, kw_only=True)
class ExportResult:
    """The result of `export`."""

    output: Path
    reports: tuple[Parity, ...]
    """Comparison of each file with the network, in the order of the formats."""
    address: str | None = None
    """Address of the upload; None without one."""

    def show(self) -> None:
        """Print the comparisons as a table."""
        if not any(report.real for report in self.reports):
            print("images is not set, so only random images were compared", file=sys.stderr)
        show([parity_table(self.reports)])
        print(f"exported, with report.json and a model card: {self.output}")
        if self.address:
            print(f"uploaded: {self.address}")


def export(options: ExportOptions) -> ExportResult:
    """Export a trained model's depth network into a folder, with its config, a parity report and a model card.

    Args:
        options: What to export, and where.

    Returns:
        The comparison of each file with the network.

    Raises:
        ConfigError: for a missing package, a network that cannot be exported this way, or a folder with another export.
        CheckpointError: if the checkpoint cannot be read, or a file would differ from the original.
        DataError: if an image or the evaluation cannot be read, or a file cannot be written.

    Examples:
        >>> options = saunet.ExportOptions(checkpoint="last.ckpt", output="exported", formats=["safetensors"])
        >>> saunet.export(options).reports[0].difference < 1e-6
        True
    """
    formats, folder = tuple(dict.fromkeys(options.formats)), Path(options.output)
    read = read_model(options.checkpoint)
    earlier = check_target(
        folder, read.path, (CONFIG, *FILES.values(), OPENVINO_WEIGHTS, POSE, REPORT, CARD), options.overwrite
    )
    metrics = read_metrics(options.evaluation) if options.evaluation is not None else None
    splits = _splits(read.path)
    network, pose = read.networks()
    record = public_record(read.record)
    network.eval()
    random, real = random_images(record.height, record.width), real_images(record, options.images or ())
    remove(earlier)
    remove_partial_files(folder)
    eager, span = exporters.run_eager(network), 1 / record.min_depth - 1 / record.max_depth
    reports, runs = list[Parity](), list[Run]()
    for name in formats:
        path, begun = folder / FILES[name], time.monotonic()
        _say(f"{name}: making {path.name}")
        with replacing(path) as temporary, _weights_beside(folder, name) as weights:
            if name == "safetensors":
                takes, parts = "any", {"depth": network} if pose is None else {"depth": network, "pose": pose}
                write_safetensors(named_state(parts), temporary)
            else:
                takes = _EXPORTERS[name](network, record, temporary, options, weights)
            _say(f"{name}: checking it against the network on {len(random) + len(real)} images")
            run = _RUNNERS[name](temporary, record, weights)
            size = sum(each.stat().st_size for each in (temporary, weights) if each is not None)
            report = compare(path.name, eager, run, random, real, span, takes, size / 2**20)
            found = f"{report.difference:.2g} of the disparity range, more than {TOLERANCE:g}"
            wrong = "gives NaN where the network gives disparity"
            if not math.isnan(report.difference):
                wrong = f"differs from the network by {found}"
            if not report.difference <= TOLERANCE:
                raise CheckpointError(
                    f"the exported {path.name} {wrong}, so it is not written; please report this with its encoder "
                    "and decoder"
                )
        _say(f"{name}: differs by {report.difference:.1e} of its range; {time.monotonic() - begun:.1f} s")
        reports.append(report)
        runs.append(run)
    _say("timing the files and the network on one image each")
    reports = timed(reports, eager, runs, random[0])
    about: dict[str, Any] = {"threads": torch.get_num_threads(), "machine": platform.machine(), "versions": _versions()}
    if "onnx" in formats:
        about["opset"] = options.opset
    content = {"tolerance": TOLERANCE, **about, "files": [asdict(report) for report in reports]}
    write_json(folder / REPORT, content)
    write_bytes(folder / CARD, model_card(record, reports, metrics, splits, options.push).encode())
    write_json(folder / CONFIG, record.to_plain())  # last: with it, the folder is a model
    address = push(folder, options.push) if options.push else None
    return ExportResult(output=folder, reports=tuple(reports), address=address)


def _say(what: str) -> None:
    """Report progress, also to a pipe: a format can take minutes."""
    print(what, file=sys.stderr, flush=True)


@contextlib.contextmanager
def _weights_beside(folder: Path, name: str) -> Iterator[Path | None]:
    """Yield the separate weights file of each format; None if it has none."""
    if name != "openvino":
        yield None
        return
    with replacing(folder / OPENVINO_WEIGHTS) as temporary:
        yield temporary


def read_metrics(path: str | Path) -> Mapping[str, Any]:
    """Read the ``metrics.json`` of an evaluation."""
    path = Path(path)
    path = path / "metrics.json" if path.is_dir() else path
    try:
        content = read_json(path)
        if [row for row in content["results"] if not isinstance(row["predictor"], str)]:
            raise ValueError("a row without predictor")
    except OSError as reason:
        raise DataError(f"cannot read {path}: {reason.strerror}; give the folder of a saunet evaluate run") from reason
    except (ValueError, TypeError, KeyError) as reason:
        raise DataError(f"{path} is not an evaluation ({reason}); give the metrics.json of saunet evaluate") from reason
    return content  # type: ignore[no-any-return]


def _splits(checkpoint: Path) -> Mapping[str, str]:
    """Return the fingerprints of the frames that a model was trained on, if its run's folder still has them."""
    path = checkpoint.parent.parent / "run.json"
    if not path.is_file():
        return {}
    try:
        return dict(read_json(path).get("splits") or {})
    except (OSError, ValueError, AttributeError, TypeError) as reason:
        raise DataError(
            f"{path} cannot be read ({reason}); repair this file of the run, or move the checkpoint elsewhere"
        ) from reason


def check_target(folder: Path, model: Path, names: Sequence[str], overwrite: bool) -> list[Path]:
    """Return an earlier model's files in a folder, after checking that they may go and are not ``model`` itself."""
    if model.name == WEIGHTS and model.resolve().parent == folder.resolve():
        raise ConfigError(f"the output folder {folder} contains the model itself; choose another")
    present = [folder / name for name in names if (folder / name).exists()]
    if present and not overwrite:
        raise ConfigError(
            f"{folder} already has {present[0].name}; choose another output folder, or set overwrite=true"
        )
    return present


def remove(earlier: Sequence[Path]) -> None:
    """Remove an earlier model, its config first: leftovers must not be mistaken for the new one."""
    for path in earlier:
        try:
            path.unlink()
        except OSError as reason:
            raise DataError(f"cannot replace {path}: {reason.strerror or reason}") from reason


def public_record(record: ModelRecord) -> ModelRecord:
    """Return a model's record without the trainer's folders and recordings."""
    data = {key: value for key, value in record.data.items() if key not in _PLACES}
    found = record.intrinsics
    if found is not None:  # the names of recordings are private too
        found = Intrinsics(found.mode, {"mean": found.mean})
    record = replace(record, data=data, intrinsics=found)
    try:
        json.dumps(record.to_plain(), allow_nan=False)
    except ValueError as reason:
        raise ConfigError(f"{CONFIG} cannot hold the model's settings ({reason}); give finite numbers") from reason
    return record


def real_images(record: ModelRecord, images: str | Path | Sequence[str | Path]) -> list[NDArray[np.float32]]:
    """Return at most eight of the images of files, folders or patterns at the network's size, each 1 3 h w."""
    several = [images] if isinstance(images, str | Path) else list(images)
    paths = [frame.image for item in several for frame in find_sources(item)]
    chosen = [paths[index] for index in np.linspace(0, len(paths) - 1, min(len(paths), _REAL_AT_MOST)).astype(int)]
    return [network_input(read_image(path), record.height, record.width)[None] for path in chosen]


def named_state(parts: Mapping[str, torch.nn.Module]) -> dict[str, torch.Tensor]:
    """Return the weights of networks under a checkpoint's names, such as ``depth.encoder.conv1.weight``."""
    return {f"{part}.{name}": value for part, module in parts.items() for name, value in module.state_dict().items()}


def _versions() -> dict[str, str]:
    found = {}
    for package in ("saunet", "torch", "onnx", "onnxruntime", "onnxscript", "openvino", "safetensors"):
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _openvino(network: DepthNet, record: ModelRecord, path: Path, how: ExportOptions, weights: Path | None) -> str:
    from saunet.exporting.openvino import export_openvino

    return export_openvino(network, record, path, weights or path.with_suffix(".bin"), how.batch)


def _run_openvino(path: Path, record: ModelRecord, weights: Path | None) -> Run:
    from saunet.exporting.openvino import run_openvino

    return run_openvino(path, weights or path.with_suffix(".bin"))


_EXPORTERS: dict[str, Callable[[DepthNet, ModelRecord, Path, ExportOptions, Path | None], str]] = {
    "onnx": lambda network, record, path, how, _: exporters.export_onnx(network, record, path, how.batch, how.opset),
    "openvino": _openvino,
    "program": lambda network, record, path, how, _: exporters.export_program(network, record, path, how.batch),
    "compiled": lambda network, record, path, how, _: exporters.export_compiled(network, record, path, how.batch),
}
_RUNNERS: dict[str, Callable[[Path, ModelRecord, Path | None], Run]] = {
    "onnx": lambda path, record, _: exporters.run_onnx(path),
    "openvino": _run_openvino,
    "program": lambda path, record, _: exporters.run_program(path),
    "compiled": lambda path, record, _: exporters.run_compiled(path),
    "safetensors": lambda path, record, _: exporters.run_eager(restored(path, record).networks()[0].eval()),
}
