#!/usr/bin/env bash
# Guess: a Resize that says antialias=1 is computed with antialiasing, or refused.
# Seen: OpenVINO 2026.4.1 (onnx 1.23.2, onnxruntime 1.32.0, Python 3.11, CPU, float32). It is read without a word and computed as if it said antialias=0: the
#   result equals ONNX Runtime's without antialiasing within 1e-6, and is 0.2 to 0.3 off from that with it, for values in [0, 1] made four times smaller. So
#   a network that makes its own input smaller gets another picture, and gives another depth.
#   Lesson: make pictures smaller outside of the network, or replace the Resize by a convolution of fixed weights.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q openvino==2026.4.1 onnxruntime==1.32.0 onnx==1.23.2 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
import numpy as np
import onnxruntime
import openvino
from onnx import TensorProto, helper


def model(mode, antialias):
    x, y = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1, side, side]) for name, side in (("x", 16), ("y", 4)))
    factors = helper.make_tensor("factors", TensorProto.FLOAT, [4], [1, 1, 0.25, 0.25])
    node = helper.make_node("Resize", ["x", "", "factors"], ["y"], mode=mode, antialias=antialias)
    graph = helper.make_graph([node], "resize", [x], [y], [factors])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9).SerializeToString()


x = np.random.default_rng(0).random((1, 1, 16, 16), np.float32)
core = openvino.Core()
print(f"OpenVINO {openvino.__version__}, ONNX Runtime {onnxruntime.__version__}")
for mode in ("linear", "cubic"):
    plain, smooth = (onnxruntime.InferenceSession(model(mode, choice)).run(None, {"x": x})[0] for choice in (0, 1))
    got = core.compile_model(core.read_model(model(mode, 1)), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})([x])[0]
    off, same = np.abs(got - smooth).max(), np.abs(got - plain).max()
    print(f"{mode}: OpenVINO with antialias=1 is {off:.3f} off from ONNX Runtime with it, {same:.1e} from ONNX Runtime without")
    assert off > 0.1 and same < 1e-6, "antialias=1 is no longer ignored"
PY
