"""Files for older runtimes run in one: `nox -s old_runtime` makes its environment, with onnxruntime 1.14."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from networks import small_network

from saunet.exporting.exporters import export_onnx
from saunet.runs.record import ModelRecord

pytest.importorskip("onnxscript", reason="ONNX export needs saunet[export]")
PYTHON = os.environ.get("SAUNET_OLD_RUNTIME", "")
RUN = """
import sys, numpy, onnxruntime
assert onnxruntime.__version__.startswith("1.14."), onnxruntime.__version__
session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
images = numpy.load(sys.argv[2])
numpy.save(sys.argv[3], session.run(["disparity"], {"image": images})[0])
"""
PAIRS = [
    ("stratified_tiny", "aunet"),
    ("swin_tiny", "unet"),
    ("lite_mono", "lite_mono"),
    ("packnet", "packnet"),
    ("efficientnet_lite0", "unet"),
]


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON, reason="SAUNET_OLD_RUNTIME names no Python with onnxruntime 1.14")
@pytest.mark.parametrize("opset", [17, 18])
@pytest.mark.parametrize(("encoder", "decoder"), PAIRS)
def test_onnxruntime_1_14_computes_what_the_network_computes(
    encoder: str, decoder: str, opset: int, node: Callable[[str, str], dict[str, Any]], tmp_path: Path
) -> None:
    network = small_network(encoder, decoder)
    height, width = 2 * network.size_divisor, 3 * network.size_divisor
    record = ModelRecord(node("encoder", encoder), node("decoder", decoder), None, 0.1, 100.0, height, width)
    export_onnx(network, record, tmp_path / "x.onnx", opset=opset)
    images = torch.rand(2, 3, height, width)
    np.save(tmp_path / "images.npy", images.numpy())
    files = [str(tmp_path / name) for name in ("x.onnx", "images.npy", "disparity.npy")]
    done = subprocess.run([PYTHON, "-c", RUN, *files], capture_output=True, text=True, env={"PATH": os.environ["PATH"]})
    assert done.returncode == 0, done.stderr
    with torch.no_grad():
        wanted = network(images).disparity[0].numpy()
    assert np.abs(np.load(tmp_path / "disparity.npy") - wanted).max() < 1e-4
