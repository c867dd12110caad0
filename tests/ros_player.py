"""Publishes the scans of a log over ROS 2, with odometry between them. It is no test."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from typing import Any

import rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan

from perception.readers.logs import read_log
from perception.readers.scans import Scan
from ssh_abduction.data.odometry import Pose

PAUSE, RATE = 1.0, 20.0  # seconds at most between two scans, and poses per second


def stamp(header: Any, seconds: float) -> None:
    header.stamp.sec, header.stamp.nanosec = int(seconds), int(seconds % 1 * 1e9)


def play(scans: Sequence[Scan], speed: float) -> None:
    """Publish scans, `speed` times as fast as they were recorded."""
    rclpy.init(args=[])
    node = rclpy.create_node("player")
    quality = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
    scan_to = node.create_publisher(LaserScan, "/scan", quality)
    odom_to = node.create_publisher(Odometry, "/odom", quality)
    while min(scan_to.get_subscription_count(), odom_to.get_subscription_count()) < 1:
        time.sleep(0.05)
    time.sleep(0.5)

    def odometry(at: float, pose: Pose) -> None:
        message = Odometry()
        stamp(message.header, at)
        message.pose.pose.position.x, message.pose.pose.position.y = pose[:2]
        turned = message.pose.pose.orientation
        turned.z, turned.w = math.sin(pose[2] / 2), math.cos(pose[2] / 2)
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
        stamp(message.header, now)
        message.header.frame_id = "laser"
        message.angle_min, message.angle_increment = scan.laser.first, scan.laser.step
        message.range_max = scan.laser.reach
        message.ranges = [float(metres) for metres in scan.ranges]
        scan_to.publish(message)
        last = scan
    odometry(now + 0.05, last.odometry)
    time.sleep(2.0)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    play(read_log(sys.argv[1]).scans, float(sys.argv[2]))
