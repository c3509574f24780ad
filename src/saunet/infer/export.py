"""A trained depth network as a file that runs without saunet: ONNX or torch.export, checked against the original."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn
from torch._dynamo.exc import UserError
from torch.nn.attention import SDPBackend, sdpa_kernel

from saunet.atomic import replacing, write_bytes
from saunet.checkpoint import read_checkpoint
from saunet.checks import CheckpointError, ConfigError, one_of
from saunet.images import network_input, read_image
from saunet.infer.card import model_card
from saunet.infer.onnx import INPUT, METADATA, OUTPUT, open_session
from saunet.infer.parity import Parity, Run, compare
from saunet.models.depth import DepthNet
from saunet.record import ModelRecord

FORMATS: tuple[str, ...] = ("onnx", "program")
"""``onnx``: model.onnx, for onnxruntime, TensorRT and others. ``program``: model.pt2, for torch alone."""
BATCHES: tuple[str, ...] = ("auto", "any", "one")
"""``any``: any number of images at once. ``one``: exactly one. ``auto``: any where the network allows it, else one."""
TOLERANCE = 1e-4
"""Largest difference to the original network that passes, as a share of the range of disparity."""

_FILES = {"onnx": "model.onnx", "program": "model.pt2"}
_LARGEST_BATCH = 256
_TRACING_ERRORS = (UserError, RuntimeError, ValueError)


class FinestDisparity(nn.Module):
    """A depth network that returns only its full-resolution disparity: what is exported."""

    def __init__(self, network: DepthNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return disparity in 1/metre (up to scale) of RGB in [0, 1]."""
        return self.network(image).disparity[0]  # type: ignore[no-any-return]


def export_model(
    checkpoint: str | Path,
    output_dir: str | Path,
    formats: Sequence[str] = FORMATS,
    *,
    images: Sequence[str | Path] = (),
    batch: str = "auto",
) -> list[Parity]:
    """Export a checkpoint's depth network into a folder, with its record, a parity report and a model card.

    Args:
        checkpoint: A checkpoint written by ``saunet-train``.
        output_dir: Where ``model.onnx``, ``model.pt2``, ``record.json``, ``report.json`` and ``README.md`` go.
        formats: Which files to write; see `FORMATS`.
        images: Real images to compare on, besides random ones.
        batch: How many images the files take at once; see `BATCHES`.

    Returns:
        One comparison a format.

    Raises:
        ConfigError: for an unknown format, a package that is missing, or a network that cannot be exported this way.
        CheckpointError: if the checkpoint cannot be read, or a file would differ from the original.
        DataError: if an image cannot be read or the system refuses to write.
    """
    for name in formats:
        one_of("formats", name, FORMATS)
    one_of("batch", batch, BATCHES)
    read = read_checkpoint(checkpoint)
    network, record = read.networks()[0].eval(), read.record
    inputs = _inputs(record, images)
    folder = Path(output_dir)
    span = 1 / record.min_depth - 1 / record.max_depth
    reports = []
    for name in dict.fromkeys(formats):
        path = folder / _FILES[name]
        with replacing(path) as temporary:
            _EXPORTERS[name](network, record, temporary, batch)
            report = compare(path.name, _run_eager(network), _RUNNERS[name](temporary), inputs, span)
            if not report.difference <= TOLERANCE:
                raise CheckpointError(
                    f"the exported {path.name} differs from the network by {report.difference:.2g} of the disparity "
                    f"range, more than {TOLERANCE:g}, so it is not written; report the encoder and decoder"
                )
        reports.append(report)
    plain = record.to_plain()
    write_bytes(folder / "record.json", (json.dumps(plain, indent=2) + "\n").encode())
    write_bytes(folder / "report.json", (json.dumps([asdict(report) for report in reports], indent=2) + "\n").encode())
    write_bytes(folder / "README.md", model_card(record, reports).encode())
    return reports


def export_onnx(network: DepthNet, record: ModelRecord, path: str | Path, batch: str = "auto") -> None:
    """Write a depth network as ONNX, with its record inside, so that one file is enough to predict from.

    Args:
        network: The network.
        record: Its record; gives the input size and goes into the file.
        path: The file to write.
        batch: How many images it takes at once; see `BATCHES`.

    Raises:
        ConfigError: if the packages are missing, or the network cannot be exported this way.
    """
    for package in ("onnx", "onnxscript"):
        if importlib.util.find_spec(package) is None:
            raise ConfigError(f"ONNX export needs the package {package}; run: pip install 'saunet[export]'")
    # Attention in its plain form: what the fused kernel returns has strides that the exporter's own run of it has not.
    with sdpa_kernel(SDPBackend.MATH):
        program = _program(network, record, batch)
    try:
        with _quiet():
            exported: Any = torch.onnx.export(
                program, input_names=[INPUT], output_names=[OUTPUT], dynamo=True, verbose=False
            )
    except torch.onnx.OnnxExporterError as reason:
        names = f"{type(network.encoder).__name__} with {type(network.decoder).__name__}"
        raise ConfigError(f"{names} cannot be exported to ONNX; export the format 'program'") from reason
    exported.model.metadata_props[METADATA] = json.dumps(record.to_plain())
    exported.save(str(path))


def export_program(network: DepthNet, record: ModelRecord, path: str | Path, batch: str = "auto") -> None:
    """Write a depth network as a torch.export program: ``torch.export.load(path).module()(image)`` needs no saunet.

    Args:
        network: The network.
        record: Its record; gives the input size and goes into the file.
        path: The file to write.
        batch: How many images it takes at once; see `BATCHES`.

    Raises:
        ConfigError: if the network cannot be exported this way.
    """
    extra = {METADATA: json.dumps(record.to_plain())}
    torch.export.save(_program(network, record, batch), path, extra_files=extra)


def _program(network: DepthNet, record: ModelRecord, batch: str) -> torch.export.ExportedProgram:
    one_of("batch", batch, BATCHES)
    module = FinestDisparity(network).eval()
    names = f"{type(network.encoder).__name__} with {type(network.decoder).__name__}"
    if batch != "one":
        try:
            return _trace(module, torch.zeros(2, 3, record.height, record.width), dynamic=True)
        except _TRACING_ERRORS as reason:
            if batch == "any":
                raise ConfigError(
                    f"{names} fixes its batch size when it is exported; export with batch=one"
                ) from reason
    try:
        return _trace(module, torch.zeros(1, 3, record.height, record.width), dynamic=False)
    except _TRACING_ERRORS as reason:
        raise ConfigError(f"{names} cannot be exported: {str(reason).splitlines()[0]}") from reason


def _trace(module: nn.Module, image: Tensor, dynamic: bool) -> torch.export.ExportedProgram:
    shapes = {"image": {0: torch.export.Dim("batch", min=1, max=_LARGEST_BATCH)}} if dynamic else None
    with torch.no_grad(), _quiet():
        program: torch.export.ExportedProgram = torch.export.export(module, (image,), dynamic_shapes=shapes)
        # decomposing into nothing new inlines autocast regions, which cannot be saved
        return program.run_decompositions({})  # type: ignore[no-any-return]


def _inputs(record: ModelRecord, images: Sequence[str | Path]) -> list[NDArray[np.float32]]:
    size = (record.height, record.width)
    random = np.random.default_rng(0).random((2, 3, *size), dtype=np.float32)
    return [image[None] for image in (*random, *(network_input(read_image(path), *size) for path in images))]


def _run_eager(network: DepthNet) -> Run:
    def run(image: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.no_grad():
            return network(torch.from_numpy(image)).disparity[0].numpy()  # type: ignore[no-any-return]

    return run


def _run_onnx(path: Path) -> Run:
    session = open_session(path, threads=torch.get_num_threads())
    return lambda image: session.run([OUTPUT], {INPUT: image})[0]


def _run_program(path: Path) -> Run:
    module = torch.export.load(path).module()

    def run(image: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.no_grad():
            return module(torch.from_numpy(image)).numpy()  # type: ignore[no-any-return]

    return run


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter's notes about packages that saunet does not use."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


_EXPORTERS: dict[str, Callable[[DepthNet, ModelRecord, Path, str], None]] = {
    "onnx": export_onnx,
    "program": export_program,
}
_RUNNERS = {"onnx": _run_onnx, "program": _run_program}
