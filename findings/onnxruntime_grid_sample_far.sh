#!/usr/bin/env bash
# Guess: GridSample with padding_mode="border" gives the border pixel for a point however far outside, as its specification, its reference and
#   PyTorch's grid_sample do. View synthesis asks for such points: what lies near the camera's own plane is seen millions of pixels away.
# Seen: ONNX Runtime 1.32.0 (onnx 1.23.2, Python 3.11, CPU). In mode "linear" (float32) the border pixel is right to about 2^24 pixels from the image; just
#   below that some points get twice its value, and from there on 0, a value that no pixel has. No warning. Mode "nearest" is right at these distances.
#   Lesson: clamp the grid to [-2, 2] before sampling; the result is the same, and right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q onnxruntime==1.32.0 onnx==1.23.2 numpy==2.4.6
"$folder/venv/bin/python" - <<'PY'
import numpy as np
import onnxruntime
from onnx import TensorProto, helper
from onnx.reference import ReferenceEvaluator


def model(mode):
    tensors = {"image": [1, 1, 4, 4], "grid": [1, 1, "n", 2], "seen": [1, 1, 1, "n"]}
    image, grid, seen = (helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in tensors.items())
    node = helper.make_node("GridSample", ["image", "grid"], ["seen"], mode=mode, padding_mode="border", align_corners=1)
    graph = helper.make_graph([node], "sample", [image, grid], [seen])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)


image = np.arange(1, 17, dtype=np.float32).reshape(1, 1, 4, 4)  # between its second and third row: 10 at the right border
x = np.array([2, 1e5, 1e7, 1.2e7, 2e7, 1e8], np.float32)
feeds = {"image": image, "grid": np.stack([x, 0 * x], -1)[None, None]}
linear = model("linear")
meant = ReferenceEvaluator(linear).run(None, feeds)[0].ravel()
got = onnxruntime.InferenceSession(linear.SerializeToString()).run(None, feeds)[0].ravel()
print(f"ONNX Runtime {onnxruntime.__version__}")
for place, right, value in zip(x, meant, got):
    print(f"x = {place:.2g}, {1.5 * (place + 1):.3g} pixels: reference {right:g}, ONNX Runtime {value:g}")
assert (meant == 10).all()
nearest = onnxruntime.InferenceSession(model("nearest").SerializeToString()).run(None, feeds)[0].ravel()
assert (nearest == nearest[0]).all(), "mode nearest changes with the distance too"
clamped = {**feeds, "grid": feeds["grid"].clip(-2, 2)}
assert (onnxruntime.InferenceSession(linear.SerializeToString()).run(None, clamped)[0] == 10).all()
assert got.tolist() == [10, 10, 10, 20, 0, 0], "points far outside are sampled otherwise than seen"
PY
