"""A ROS 2 node: depth of a camera's images, as saunet predicts it.

Run it where both ROS 2 and saunet can be imported::

    python examples/ros2_depth_node.py --ros-args -r image:=/camera/image_raw -r camera_info:=/camera/camera_info \
        -p checkpoint:=runs/first -p device:=auto

It reads ``image`` (sensor_msgs/Image, any 8-bit color encoding) and ``camera_info``, and publishes ``depth/image``
(32FC1: meters if the model knows its scale, see docs/scale.md, else relative) and ``depth/camera_info``, both with the
stamp and frame of the image. Images that arrive while one is predicted are dropped, so depth is never late by more than
one prediction.
"""

from __future__ import annotations

import array
from collections.abc import Callable
from typing import Any

import numpy as np

import saunet
from saunet.tools.prepare.bags import rgb_of


def predicted(model: saunet.Predictor, message: Any) -> saunet.Prediction:
    """Return the prediction for an image message.

    Raises:
        DataError: if the message holds no color image.
    """
    image = rgb_of(message, "image")
    if image is None:
        raise saunet.DataError(f"image has the encoding {message.encoding}, which is no color image")
    return model.predict(image)


def depth_message(make: Callable[..., Any], header: Any, result: saunet.Prediction) -> Any:
    """Return depth as an image message (REP 118); ``make`` is ROS' class ``Image``."""
    depth = np.ascontiguousarray(result.depth, dtype="<f4")
    height, width = depth.shape
    data = array.array("B", depth.tobytes())
    return make(header=header, height=height, width=width, encoding="32FC1", is_bigendian=0, step=4 * width, data=data)


def main() -> None:
    """Run the node until Ctrl-C."""
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import CameraInfo, Image

    class DepthNode(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("saunet_depth")
            checkpoint = self.declare_parameter("checkpoint", "street").value
            self.model = saunet.load(checkpoint, device=self.declare_parameter("device", "cpu").value)
            self.info: CameraInfo | None = None
            latest = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
            self.depth = self.create_publisher(Image, "depth/image", 1)
            self.depth_info = self.create_publisher(CameraInfo, "depth/camera_info", 1)
            self.create_subscription(CameraInfo, "camera_info", self.keep, latest)
            self.create_subscription(Image, "image", self.answer, latest)
            self.get_logger().info(f"depth is {self.model.unit}")

        def keep(self, info: CameraInfo) -> None:
            self.info = info

        def answer(self, message: Image) -> None:
            try:
                result = predicted(self.model, message)
            except saunet.SaunetError as error:
                self.get_logger().error(str(error), throttle_duration_sec=5.0)
                return
            self.depth.publish(depth_message(Image, message.header, result))
            if self.info is not None:
                self.info.header = message.header
                self.depth_info.publish(self.info)

    rclpy.init()
    try:
        rclpy.spin(DepthNode())
    except KeyboardInterrupt:
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
