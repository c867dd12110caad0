"""Publishes the scans of a log over ROS 2, with odometry between them. It is no test.

    python ros_player.py LOG SPEED [tf]

With `tf`, odometry comes as transforms, and the laser is turned by the transform to its frame.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from typing import Any

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan

from perception.readers.logs import read_log
from perception.readers.scans import Scan
from ssh_abduction.data.odometry import Pose

PAUSE, RATE = 1.0, 20.0  # seconds at most between two scans, and poses per second
TURNED = 0.5  # radians by which the laser is turned, with transforms


def stamp(at: Any, seconds: float) -> None:
    at.sec, at.nanosec = int(seconds), int(seconds % 1 * 1e9)


def transform(parent: str, child: str, pose: Pose, at: float) -> TransformStamped:
    made = TransformStamped()
    stamp(made.header.stamp, at)
    made.header.frame_id, made.child_frame_id = parent, child
    made.transform.translation.x, made.transform.translation.y = pose[:2]
    turned = made.transform.rotation
    turned.z, turned.w = math.sin(pose[2] / 2), math.cos(pose[2] / 2)
    return made


def play(scans: Sequence[Scan], speed: float, by_frames: bool) -> None:
    """Publish scans, `speed` times as fast as they were recorded."""
    rclpy.init(args=[])
    node = rclpy.create_node("player")
    quality = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    scan_to = node.create_publisher(LaserScan, "/scan", quality)
    clock_to = node.create_publisher(Clock, "/clock", 10)
    turned = TURNED if by_frames else 0.0
    if by_frames:
        from tf2_msgs.msg import TFMessage

        odom_to = node.create_publisher(TFMessage, "/tf", quality)
        fixed_to = node.create_publisher(TFMessage, "/tf_static", latched)
        # The laser is on a mast on the robot.
        links = (
            ("base", "mast", (0.0, 0.0, TURNED / 2)),
            ("mast", "laser", (0.0, 0.0, TURNED / 2)),
        )
        fixed_to.publish(TFMessage(transforms=[transform(*link, 0.0) for link in links]))
    else:
        odom_to = node.create_publisher(Odometry, "/odom", quality)
    while min(scan_to.get_subscription_count(), odom_to.get_subscription_count()) < 1:
        time.sleep(0.05)
    time.sleep(0.5)

    def odometry(at: float, pose: Pose) -> None:
        now = Clock()
        stamp(now.clock, at)
        clock_to.publish(now)
        moved = transform("odom", "base", pose, at)
        if by_frames:
            odom_to.publish(TFMessage(transforms=[moved]))
            return
        message = Odometry(header=moved.header, child_frame_id="base")
        message.pose.pose.position.x, message.pose.pose.position.y = pose[:2]
        message.pose.pose.orientation = moved.transform.rotation
        odom_to.publish(message)

    begin, now, last = time.monotonic(), 0.0, scans[0]
    for scan in scans:
        gap = min(PAUSE, max(0.05, (scan.time or 0.0) - (last.time or 0.0)))
        turn = math.remainder(scan.odometry[2] - last.odometry[2], math.tau)
        steps = max(1, int(gap * RATE))
        for k in range(1, steps + 1):
            share = k / steps
            x, y = (a + share * (b - a) for a, b in zip(last.odometry[:2], scan.odometry[:2]))  # noqa: B905
            time.sleep(max(0.0, begin + (now + share * gap) / speed - time.monotonic()))
            odometry(now + share * gap, (x, y, last.odometry[2] + share * turn))
        now += gap
        message = LaserScan()
        stamp(message.header.stamp, now)
        message.header.frame_id = "laser"
        message.angle_min = scan.laser.first - turned
        message.angle_increment = scan.laser.step
        message.angle_max = message.angle_min + (len(scan.ranges) - 1) * scan.laser.step
        message.range_max = scan.laser.reach
        message.ranges = [float(metres) for metres in scan.ranges]
        scan_to.publish(message)
        last = scan
    odometry(now + 0.05, last.odometry)
    time.sleep(2.0)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    play(read_log(sys.argv[1]).scans, float(sys.argv[2]), "tf" in sys.argv[3:])
