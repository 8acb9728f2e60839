"""A ROS 2 node: compressed pictures and joint states in, a policy's joint targets out.

    python3 examples/ros2/policy_node.py --ros-args -p server:=ws://gpu-machine:8000 \
      -p prompt:="press the button" -p cameras:="['side=/side/image_raw/compressed']"

README.md beside this file lists topics and parameters.
"""
# pyright: reportMissingImports=false
# ROS 2 brings its own Python.

import contextlib
from argparse import ArgumentTypeError
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from pilot import Pilot, connect
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, JointState

from lorasp_jax.base.errors import one_line


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = rclpy.create_node("policy")
    server, topics, settings = connect(
        lambda name, default: node.declare_parameter(name, default).value
    )
    if not 0 < (rate := node.declare_parameter("rate", 50.0).value) <= 1000:
        raise ValueError(f"rate must be above 0 and at most 1000 Hz, got {rate:g}")
    pilot, period = Pilot(server, settings), 1.0 / rate
    targets = node.create_publisher(JointState, "joint_targets", 1)

    def tick() -> None:
        before, now = pilot.holding, node.get_clock().now()
        target = pilot.tick(1e-9 * now.nanoseconds, period)
        if pilot.holding != before:
            node.get_logger().info(f"holding: {pilot.holding}" if pilot.holding else "moving")
        if target is not None:
            message = JointState(name=list(settings.joints), position=target.tolist())
            message.header.stamp = now.to_msg()
            targets.publish(message)

    listen(node, pilot, topics)
    node.create_timer(period, tick)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


def listen(node: Any, pilot: Pilot, topics: Mapping[str, str]) -> None:
    """Give a pilot what comes on camera -> topic, and the joint states."""
    newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

    def stamp(message: Any) -> float:
        return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec

    def see(camera: str) -> Callable[[Any], None]:
        return lambda message: pilot.see(camera, bytes(message.data), stamp(message))

    def feel(message: Any) -> None:
        pilot.feel(message.name, message.position, stamp(message))

    for camera, topic in topics.items():
        node.create_subscription(CompressedImage, topic, see(camera), newest)
    node.create_subscription(JointState, "joint_states", feel, newest)


if __name__ == "__main__":
    try:
        main()
    except (ValueError, OSError, ArgumentTypeError) as error:
        raise SystemExit(f"error: {one_line(error)}") from None
