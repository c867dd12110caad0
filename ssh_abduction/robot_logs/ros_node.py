"""A ROS 2 node that maps a building while the robot drives.

It takes LaserScan and Odometry, and publishes the map as markers and as JSON, the belief of the
place, and what changed. `/tf_static` says where the laser is, if the message of TF is installed.

The numbers and names that a service needs are parameters of the node: `place`, `to` and `text`.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import networkx as nx
import numpy as np

from perception.errors import LogError
from perception.readers.bag_frames import flat_pose, frame_name, stamp_of
from perception.readers.scans import Damaged, Scan, laser_of
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.odometry import Pose
from ssh_abduction.robot_logs.log_mapper import LiveSession, OnlineLogMapper
from ssh_abduction.robot_logs.stamps import StampPairing

# Seconds to wait for a topic before that is said, and from one look at the topics to the next.
PATIENCE, LOOK = 5.0, 1.0
TICK = 0.1  # seconds
DEEP = 2000  # messages of a topic that wait, if it is reliable
MISSING = (
    "live: expected ROS 2, got none; pip install 'ssh-abduction[ros2]', source its setup file, or "
    "give --replay LOG"
)


def run_node(
    session: LiveSession,
    new_mapper: Callable[[], OnlineLogMapper],
    scan_topic: str,
    odom_topic: str,
    mount: Pose | None,
    idle: float | None,
    say: Callable[[str], None],
) -> None:
    """Run the node until Ctrl-C, or until nothing came for `idle` seconds.

    `mount` is the pose of the laser on the robot; None takes it from `/tf_static`. Raises LogError
    if ROS 2 is not installed.
    """
    try:
        import rclpy
    except ImportError:
        raise LogError(MISSING) from None
    rclpy.init(args=[])
    node = rclpy.create_node("ssh_abduction")
    live = _LiveNode(node, session, new_mapper, scan_topic, odom_topic, mount, say)
    try:
        while rclpy.ok() and (idle is None or time.monotonic() - live.heard < idle):
            rclpy.spin_once(node, timeout_sec=TICK)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        say("interrupted: the drive ends here")
    finally:
        if live.pairing.lost:
            parts = (f"{count} {why}" for why, count in live.pairing.lost.items())
            say(f"scans that were lost: {', '.join(parts)}")
        node.destroy_node()
        rclpy.try_shutdown()


def scan_of(message: Any, mount: Pose, odometry: Pose, number: int) -> Scan:
    """Make a Scan of a LaserScan."""
    ranges = np.array(message.ranges, np.float64)
    with np.errstate(invalid="ignore"):
        ranges[~(ranges >= message.range_min)] = np.nan
        ranges[ranges >= message.range_max] = np.inf
    laser = laser_of(
        message.angle_min, message.angle_increment, len(ranges), message.range_max, mount
    )
    return Scan(ranges, laser, odometry, None, stamp_of(message.header), number)


class _LiveNode:
    """The topics and services of a node, around a session."""

    def __init__(
        self,
        node: Any,
        session: LiveSession,
        new_mapper: Callable[[], OnlineLogMapper],
        scan_topic: str,
        odom_topic: str,
        mount: Pose | None,
        say: Callable[[str], None],
    ) -> None:
        from nav_msgs.msg import Odometry
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from sensor_msgs.msg import LaserScan
        from std_msgs.msg import String
        from std_srvs.srv import SetBool, Trigger
        from visualization_msgs.msg import MarkerArray

        self.node, self.session, self._say = node, session, say
        self.pairing, self.heard = StampPairing(), time.monotonic()
        self._new_mapper, self._mount = new_mapper, mount
        self._mounts: dict[str, Pose] = {}
        self._begun, self._said, self._paused = time.monotonic(), set[str](), False
        self._kinds = {
            scan_topic: (LaserScan, self._on_scan),
            odom_topic: (Odometry, self._on_odom),
        }
        self._listening: set[str] = set()
        last = session.mapper.live.log.scans[-1].time if len(session.mapper) else None
        self._after = -math.inf if last is None else last
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._markers = node.create_publisher(MarkerArray, "~/markers", latched)
        self._map = node.create_publisher(String, "~/map", latched)
        self._belief = node.create_publisher(String, "~/belief", 10)
        for name, value in (("place", 0), ("to", 0), ("text", "")):
            node.declare_parameter(name, value)
        for name in ("save", "reset", "name", "route", "why"):
            node.create_service(Trigger, f"~/{name}", self._service(getattr(self, f"_{name}")))
        node.create_service(SetBool, "~/pause", self._service(self._pause))
        self._listen_to_frames(mount)
        node.create_timer(TICK, self._tick)
        node.create_timer(LOOK, self._look)

    def _once(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(text)

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        """Say once what is wrong with a message."""
        try:
            yield
        except Damaged as error:
            self._once(f"{what}: a message was dropped: {error}")

    def _listen_to_frames(self, mount: Pose | None) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile

        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            if mount is None:
                self._once(
                    "tf2_msgs is not installed, so the laser is taken to be in the middle of the "
                    "robot; if it is not, give --set mount=X,Y,DEGREES"
                )
            return
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(TFMessage, "/tf_static", self._on_frames, latched)

    def _on_frames(self, message: Any) -> None:
        for one in message.transforms:
            with self._told("/tf_static"):
                at = flat_pose(one.transform.translation, one.transform.rotation)
                self._mounts[frame_name(one.child_frame_id)] = at

    def _look(self) -> None:
        """Listen to the topics that are there, and say what is missing."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data

        for topic, (kind, call) in self._kinds.items():
            sources = self.node.get_publishers_info_by_topic(topic)
            if len(sources) > 1:
                self._once(f"{topic}: expected one publisher, got {len(sources)}; stop all but one")
            if sources and topic not in self._listening:
                self._listening.add(topic)
                reliable = ReliabilityPolicy.RELIABLE
                is_reliable = all(one.qos_profile.reliability == reliable for one in sources)
                deep = QoSProfile(depth=DEEP, reliability=reliable)
                quality = deep if is_reliable else qos_profile_sensor_data
                self.node.create_subscription(kind, topic, call, quality)
                how = "reliable" if is_reliable else "best effort, so messages may be lost"
                self._once(f"listening to {topic}, {how}")
            elif not sources and time.monotonic() - self._begun > PATIENCE:
                there = sorted(name for name, _ in self.node.get_topic_names_and_types())
                if topic not in self._listening:
                    self._once(
                        f"{topic}: expected messages, got none for {PATIENCE:.0f} s; there are "
                        f"{', '.join(there)}; name the topic"
                    )

    def _on_odom(self, message: Any) -> None:
        self.heard = time.monotonic()
        before = self.pairing.restarts
        with self._told("odometry"):
            at = flat_pose(message.pose.pose.position, message.pose.pose.orientation)
            self.pairing.add_pose(stamp_of(message.header), at)
        if self.pairing.restarts > before:
            self._after = -math.inf
            self._say("the clock went back: it started anew")
        self._work()

    def _on_scan(self, message: Any) -> None:
        self.heard = time.monotonic()
        if not len(message.ranges):
            self._once("a scan has no ranges; look at the driver of the laser")
            return
        self.pairing.add_scan(stamp_of(message.header), message)
        self._work()

    def _work(self) -> None:
        for at, message, pose in self.pairing.ready():
            if at <= self._after or self._paused:  # known from the saved state
                continue
            frame = frame_name(message.header.frame_id)
            mount = self._mount or self._mounts.get(frame, (0.0, 0.0, 0.0))
            if self._mount is None and self._mounts and frame not in self._mounts:
                self._once(
                    f"/tf_static: expected the frame {frame}, got {', '.join(self._mounts)}; the "
                    "laser is taken to be in the middle of the robot"
                )
            number = len(self.session.mapper)
            self.session.take(scan_of(message, mount, pose, number))

    def _tick(self) -> None:
        from std_msgs.msg import String

        if self.session.tick():
            self._publish()
        if self.session.seen is not None:
            seen = self.session.seen
            said = {"pose": seen.pose, "on_map": seen.on_map, "belief": seen.belief}
            self._belief.publish(String(data=json.dumps(said)))

    def _publish(self) -> None:
        """Publish the map as JSON and as markers."""
        from geometry_msgs.msg import Point
        from std_msgs.msg import String
        from visualization_msgs.msg import Marker, MarkerArray

        found = self.session.mapper.to_dict()
        self._map.publish(String(data=json.dumps(found)))
        at = {place["place"]: (place["x"], place["y"]) for place in found["places"]}

        def marker(sort: str, number: int, kind: int, size: float) -> Any:
            made = Marker(ns=sort, id=number, type=kind, action=Marker.ADD)
            made.header.frame_id = "odom"
            made.pose.orientation.w = made.color.a = made.color.g = 1.0
            made.scale.x = made.scale.y = made.scale.z = size
            return made

        clear = Marker(action=Marker.DELETEALL)
        clear.header.frame_id = "odom"
        markers = [clear]
        for place, (x, y) in at.items():
            ball = marker("places", place, Marker.SPHERE, 0.6)
            ball.pose.position.x, ball.pose.position.y = x, y
            markers.append(ball)
        lines = marker("edges", 0, Marker.LINE_LIST, 0.1)
        for pair in found["edges"]:
            lines.points += [Point(x=at[n][0], y=at[n][1]) for n in pair]
        self._markers.publish(MarkerArray(markers=[*markers, lines]))

    def _service(self, act: Callable[[Any], str]) -> Callable[[Any, Any], Any]:
        """Make the callback of a service: `act` returns what is said, or raises AbductionError."""

        def answer(request: Any, response: Any) -> Any:
            try:
                response.success, response.message = True, act(request)
            except (AbductionError, nx.NetworkXException) as error:
                response.success, response.message = False, str(error)
            return response

        return answer

    def _value(self, name: str) -> Any:
        return self.node.get_parameter(name).value

    def _save(self, _: Any) -> str:
        self.session.save()
        found = self.session.mapper.to_dict()
        return json.dumps({**found, "lost": dict(self.pairing.lost)})

    def _reset(self, _: Any) -> str:
        self.session.restart(self._new_mapper())
        return "a new drive begins"

    def _pause(self, request: Any) -> str:
        self._paused = bool(request.data)
        return "scans are dropped" if self._paused else "scans are taken"

    def _name(self, _: Any) -> str:
        self.session.mapper.name(self._value("place"), self._value("text"))
        self._publish()
        return f"place {self._value('place')} is {self._value('text')}"

    def _route(self, _: Any) -> str:
        """The places on the shortest route, in metres, from `place` to `to`."""
        found = self.session.mapper.to_dict()
        at = {place["place"]: (place["x"], place["y"]) for place in found["places"]}
        graph = nx.Graph()
        graph.add_nodes_from(at)
        graph.add_weighted_edges_from((a, b, math.dist(at[a], at[b])) for a, b in found["edges"])
        way = nx.shortest_path(graph, self._value("place"), self._value("to"), "weight")
        return " ".join(map(str, way))

    def _why(self, _: Any) -> str:
        """How sure the map is."""
        return self.session.mapper.said or "there is no map yet"
