"""Test the ROS 2 node on real topics, where ROS 2 is installed."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests import ROOT
from tests.examples.test_ros2 import PICTURE, POSE, Turning
from tests.extras.serving.stand_in import serving

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("sensor_msgs.msg", reason="ROS 2's messages are not installed")
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # ROS's lark
LOCAL = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(os.getpid() % 100)}
JOINTS = ["joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "gripper"]


class Robot:
    """Publishes pictures and states, and follows the targets that it receives."""

    def __init__(self):
        from sensor_msgs.msg import CompressedImage, JointState

        self.node = rclpy.create_node("robot")
        self.pose, self.targets = POSE.copy(), []
        self.cameras = [
            self.node.create_publisher(CompressedImage, f"{name}/compressed", 1)
            for name in ("side", "wrist")
        ]
        self.states = self.node.create_publisher(JointState, "joint_states", 1)
        self.node.create_subscription(JointState, "joint_targets", self.follow, 10)
        self.types = CompressedImage, JointState

    def follow(self, message):
        assert list(message.name) == JOINTS
        self.targets.append(np.array(message.position))
        self.pose = self.targets[-1]

    def run(self, seconds, *, pictures=True, enough=10**9):
        image, state = self.types
        end = time.monotonic() + seconds
        while time.monotonic() < end and len(self.targets) < enough:
            now = self.node.get_clock().now().to_msg()
            for camera in self.cameras if pictures else ():
                message = image(format="rgb8; jpeg compressed bgr8", data=PICTURE)
                message.header.stamp = now
                camera.publish(message)
            message = state(name=JOINTS, position=self.pose.tolist())
            message.header.stamp = now
            self.states.publish(message)
            rclpy.spin_once(self.node, timeout_sec=0.01)


@pytest.fixture
def robot(monkeypatch):
    for name, value in LOCAL.items():
        monkeypatch.setenv(name, value)
    rclpy.init()
    robot = Robot()
    yield robot
    robot.node.destroy_node()
    rclpy.shutdown()


def test_the_node_moves_the_arm_and_falls_silent_without_pictures(robot):
    with serving(Turning()) as server:
        cameras = "cameras:=['side=side/compressed', 'wrist=wrist/compressed']"
        settings = [f"server:={server.address}", "prompt:=turn it", cameras, "state_age:=1.0"]
        options = [part for text in settings for part in ("-p", text)]
        command = [sys.executable, "examples/ros2/policy_node.py", "--ros-args", *options]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        with subprocess.Popen(command, cwd=ROOT, env=environment, **pipes) as node:
            robot.run(60, enough=40)
            assert len(robot.targets) == 40, node.kill() or node.stdout.read()
            assert robot.pose[0] > POSE[0] + 0.1
            np.testing.assert_allclose(robot.pose[1:], POSE[1:], atol=1e-5)
            assert server.policy.last_request.prompt == "turn it"
            robot.run(1.0, pictures=False)
            count = len(robot.targets)
            robot.run(1.0, pictures=False)
            assert len(robot.targets) == count
            node.send_signal(signal.SIGINT)
            said = node.communicate(timeout=30)[0]
    assert node.returncode == 0, said
    assert "moving" in said
    assert "holding: the camera side" in said
