"""The ROS 2 node's conversions, on messages as ROS writes them; the node itself needs ROS, which is not here."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from saunet.errors import DataError
from saunet.prediction.predictor import Predictor

typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
EXAMPLE = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "ros2_depth_node.py"))
STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
IMAGE = "sensor_msgs/msg/Image"


def made(**values: Any) -> Any:
    """Return an image message, which was sent and received."""
    values["data"] = np.frombuffer(values["data"], np.uint8)
    sent = STORE.serialize_cdr(STORE.types[IMAGE](**values), IMAGE)
    return STORE.deserialize_cdr(sent, IMAGE)


def header() -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=12, nanosec=34)
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")


@pytest.mark.parametrize(("encoding", "code"), [("rgb8", None), ("bgr8", cv2.COLOR_RGB2BGR), ("mono8", None)])
def test_an_image_message_becomes_a_depth_message(
    predictor: Predictor,
    picture: Any,
    encoding: str,
    code: int | None,
) -> None:
    image = picture if code is None else cv2.cvtColor(picture, code)
    expected = predictor.predict(picture).depth
    if encoding == "mono8":
        image = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        expected = predictor.predict(image).depth
    height, width = image.shape[:2]
    rows = np.pad(image.reshape(height, -1), ((0, 0), (0, 5)))  # rows may be longer than their pixels
    size = {"height": height, "width": width, "is_bigendian": 0}
    seen = made(header=header(), encoding=encoding, step=rows.shape[1], data=rows.tobytes(), **size)
    depth = EXAMPLE["depth_message"](made, seen.header, EXAMPLE["predicted"](predictor, seen))
    assert (depth.encoding, depth.step, depth.height, depth.width) == ("32FC1", 4 * width, height, width)
    assert (depth.header.stamp.sec, depth.header.stamp.nanosec, depth.header.frame_id) == (12, 34, "camera")
    np.testing.assert_array_equal(depth.data.view("<f4").reshape(height, width), expected)
    with pytest.raises(DataError, match="encoding 32FC1, which is no color image"):
        EXAMPLE["predicted"](predictor, depth)
