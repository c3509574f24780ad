"""Writing a depth network as one file, and running it: ONNX, a torch.export program, an AOTInductor package."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import logging
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from saunet.errors import ConfigError, one_of
from saunet.exporting.onnx import INPUT, METADATA, OUTPUT, open_session
from saunet.exporting.parity import Run
from saunet.models.depth import DepthNet
from saunet.runs.record import ModelRecord

BATCHES: tuple[str, ...] = ("auto", "any", "one")
"""``any``: any number of images at once. ``one``: exactly one. ``auto``: any if the network allows it, else one."""
Batch = Literal["any", "one"]
OPSETS: tuple[int, ...] = (17, 18, 20)
"""ONNX opsets: 20 by default; 18 and 17 for older runtimes (JetPack before 6.1, TensorRT 8, onnxruntime from 1.14)."""
_IR_VERSIONS = {17: 8, 18: 8, 20: 10}
"""The version of the file format that runtimes of an opset's time can read."""

_LARGEST_BATCH = 256
_TRACING_ERRORS = (RuntimeError, ValueError)
"""The first one includes all of the compiler's own errors."""


class FinestDisparity(nn.Module):
    """A depth network that returns only its full-resolution disparity: what is exported."""

    def __init__(self, network: DepthNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 1 h w"]:
        return self.network(image).disparity[0]  # type: ignore[no-any-return]


def export_onnx(
    network: DepthNet, record: ModelRecord, path: str | Path, batch: str = "auto", opset: int = OPSETS[-1]
) -> Batch:
    """Write a depth network as ONNX, with its record inside, so that one file is enough for prediction."""
    for package in ("onnx", "onnxscript"):
        if importlib.util.find_spec(package) is None:
            raise ConfigError(f"ONNX export needs the package {package}; run: pip install 'saunet[export]'")
    # Attention in its plain form: the fused kernel's result has other strides when the exporter runs it.
    with sdpa_kernel(SDPBackend.MATH):
        program, takes = depth_program(network, record, batch)
    try:
        with _quiet():
            written = max(opset, 18)  # the exporter knows none before
            exported: Any = torch.onnx.export(
                program, input_names=[INPUT], output_names=[OUTPUT], opset_version=written, dynamo=True, verbose=False
            )
    except torch.onnx.OnnxExporterError as reason:
        raise ConfigError(
            f"{_name(network)} cannot be exported to ONNX; export the format 'program' instead"
        ) from reason
    if exported.model.opset_imports[""] != written or (opset == 17 and not _lower_to_17(exported.model)):
        raise ConfigError(
            f"{_name(network)} has operations that opset {opset} does not have; export with opset={OPSETS[-1]}"
        )
    exported.model.ir_version = _IR_VERSIONS[opset]
    exported.model.metadata_props[METADATA] = json.dumps(record.to_plain())
    exported.save(str(path))
    return takes


def _lower_to_17(model: Any) -> bool:
    """Rewrite a model of opset 18 for opset 17; return whether that is possible.

    Among the changed operations, Pad, Split and Resize only gained settings. Before 18, reductions have their axes as
    an attribute. Others have no counterpart.
    """
    import onnx
    import onnx_ir

    new: dict[str, dict[str, Any]] = {
        "Resize": {"antialias": 0, "keep_aspect_ratio_policy": "stretch"},
        "Reduce": {"noop_with_empty_axes": 0},
    }
    for node in model.graph.all_nodes():
        kind = node.op_type
        if node.domain or onnx.defs.get_schema(kind, 18).since_version < 18:
            continue
        for name, default in new.get("Reduce" if kind.startswith("Reduce") else kind, {}).items():
            if name in node.attributes and node.attributes.pop(name).value != default:
                return False
        if kind.startswith("Reduce"):
            if len(node.inputs) > 1 and node.inputs[1] is not None:
                if (axes := node.inputs[1].const_value) is None:
                    return False
                node.attributes.add(onnx_ir.AttrInt64s("axes", axes.numpy().tolist()))
            node.resize_inputs(1)
        elif kind == "Pad":
            if len(node.inputs) > 3:  # axes
                return False
        elif kind not in ("Split", "Resize") or {"axes", "num_outputs"} & set(node.attributes):
            return False
    model.opset_imports[""] = 17
    return True


def export_program(network: DepthNet, record: ModelRecord, path: str | Path, batch: str = "auto") -> Batch:
    """Write a depth network as a torch.export program: ``torch.export.load(path).module()(image)`` needs no saunet."""
    program, takes = depth_program(network, record, batch)
    content = io.BytesIO()  # on a full disk, torch's own writer cannot even be closed and ends the process
    with _quiet():
        torch.export.save(program, content, extra_files={METADATA: json.dumps(record.to_plain())})
    Path(path).write_bytes(content.getbuffer())
    return takes


def export_compiled(network: DepthNet, record: ModelRecord, path: str | Path, batch: str = "auto") -> Batch:
    """Write a depth network as an AOTInductor package: machine code for this kind of processor; takes minutes.

    ``torch._inductor.aoti_load_package(path)(image)`` runs it, and so does C++ with libtorch, without Python.
    """
    if shutil.which("g++") is None and shutil.which("clang++") is None and shutil.which("cl") is None:
        raise ConfigError(
            "the format 'compiled' needs a C++ compiler, but none was found; install g++, or leave the format out"
        )
    program, takes = depth_program(network, record, batch)
    content = io.BytesIO()
    try:
        with torch.no_grad(), _quiet():
            torch._inductor.aoti_compile_and_package(program, package_path=content)
    except RuntimeError as reason:
        raise ConfigError(
            f"compiling failed: {str(reason).strip().splitlines()[0]}; export 'program' instead"
        ) from reason
    Path(path).write_bytes(content.getbuffer())
    return takes


def run_eager(network: DepthNet) -> Run:
    """Return the network as a function of arrays."""
    return _run(FinestDisparity(network))


def run_onnx(path: Path) -> Run:
    """Return an ONNX file as a function of arrays, with as many threads as torch uses.

    They do not spin: that would occupy the cores while the other network is timed.
    """
    session = open_session(path, threads=torch.get_num_threads(), spinning=False)
    return lambda image: session.run([OUTPUT], {INPUT: image})[0]


def run_program(path: Path) -> Run:
    with _quiet():
        return _run(torch.export.load(path).module())


def run_compiled(path: Path) -> Run:
    return _run(torch._inductor.aoti_load_package(str(path)))


def _run(module: Callable[[Tensor], Tensor]) -> Run:
    def run(image: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.no_grad():
            return module(torch.from_numpy(image)).numpy()

    return run


def depth_program(network: DepthNet, record: ModelRecord, batch: str) -> tuple[torch.export.ExportedProgram, Batch]:
    """Return a depth network's finest disparity as a torch.export program, and how many images it takes."""
    one_of("batch", batch, BATCHES)
    module = FinestDisparity(network).eval()
    if batch != "one":
        try:
            return _trace(module, torch.zeros(2, 3, record.height, record.width), dynamic=True), "any"
        except _TRACING_ERRORS as reason:
            if batch == "any":
                raise ConfigError(f"{_name(network)} fixes its batch size on export; export with batch=one") from reason
    try:
        return _trace(module, torch.zeros(1, 3, record.height, record.width), dynamic=False), "one"
    except _TRACING_ERRORS as reason:
        raise ConfigError(f"{_name(network)} cannot be exported: {str(reason).splitlines()[0]}") from reason


def _name(network: DepthNet) -> str:
    return f"{type(network.encoder).__name__} with {type(network.decoder).__name__}"


def _trace(module: nn.Module, image: Tensor, dynamic: bool) -> torch.export.ExportedProgram:
    shapes = {"image": {0: torch.export.Dim("batch", min=1, max=_LARGEST_BATCH)}} if dynamic else None
    with torch.no_grad(), _quiet():
        program: torch.export.ExportedProgram = torch.export.export(module, (image,), dynamic_shapes=shapes)
        # decomposing into nothing new inlines autocast regions, which cannot be saved
        return program.run_decompositions({})  # type: ignore[no-any-return]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence messages of torch's exporters that users can do nothing about."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=r".*LeafSpec", category=FutureWarning)
            warnings.filterwarnings("ignore", message="No complete tensor found")  # of views: the one returned is whole
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
