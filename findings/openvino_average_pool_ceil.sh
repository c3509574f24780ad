#!/usr/bin/env bash
# Guess: AveragePool with ceil_mode=1 and count_include_pad=1 divides by the pixels of a window that lie in the padded image, as PyTorch, ONNX Runtime
#   and ONNX's reference do; what ceil_mode adds beyond the padding is not counted.
# Seen: OpenVINO 2026.4.1 (onnx 1.23.2, Python 3.11, CPU, float32). It divides by the whole window there: the last row and column come out at 2/3, their
#   corner at 4/9 of the right value, when the size does not divide evenly. No warning; the size of the result is right.
#   Lesson: compare a converted network on sizes that do not divide evenly too, or pad by hand and pool without ceil_mode.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q openvino==2026.4.1 onnx==1.23.2 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
import numpy as np
import openvino
from onnx import TensorProto, helper
from onnx.reference import ReferenceEvaluator


def pooled(size):
    out = -(-(size - 1) // 2) + 1
    pair = (helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1, side, side]) for name, side in (("x", size), ("y", out)))
    x, y = pair
    choice = {"kernel_shape": [3, 3], "strides": [2, 2], "pads": [1, 1, 1, 1], "ceil_mode": 1, "count_include_pad": 1}
    graph = helper.make_graph([helper.make_node("AveragePool", ["x"], ["y"], **choice)], "pool", [x], [y])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 19)], ir_version=9)
    ones = np.ones((1, 1, size, size), np.float32)
    core = openvino.Core()
    compiled = core.compile_model(core.read_model(model.SerializeToString()), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    return ReferenceEvaluator(model).run(None, {"x": ones})[0][0, 0], compiled([ones])[0][0, 0]


print(f"OpenVINO {openvino.__version__}")
for size in (5, 6):
    meant, got = pooled(size)
    print(f"{size}x{size} ones: last row {meant[-1].round(3)} in the reference, {got[-1].round(3)} in OpenVINO")
    assert np.allclose(meant[:-1, :-1], got[:-1, :-1])
    assert np.allclose(meant, got) == (size == 5), "windows beyond the padding are divided otherwise than seen"
assert np.allclose(got[-1, 1:-1] / meant[-1, 1:-1], 2 / 3) and np.isclose(got[-1, -1] / meant[-1, -1], 4 / 9)
PY
