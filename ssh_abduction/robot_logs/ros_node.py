"""A ROS 2 node that maps a building while the robot drives.

It takes LaserScan, and Odometry or transforms. It publishes the map as markers and as JSON, the
belief of the place, and what changed. `/tf_static` says where the laser is, if the message of TF is
installed.

The numbers and texts that a service needs are parameters of the node. The node has a lifecycle:
while it is inactive, it takes no scans.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from perception.errors import LogError
from perception.readers.bag_frames import (
    Frames,
    describe_unmounted,
    flat_pose,
    frame_name,
    mount_of,
    record_transform,
    stamp_of,
)
from perception.readers.bag_geometry import Mount, believed
from perception.readers.bags import measured
from perception.readers.scans import Damaged, Scan
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.odometry import Pose
from ssh_abduction.data.words import counted
from ssh_abduction.robot_logs.log_mapper import LiveSession, OnlineLogMapper
from ssh_abduction.robot_logs.stamps import BACK, MOST_POSES, StampPairing

# Seconds to wait for a topic before that is said, and from one look at the topics to the next.
PATIENCE, LOOK = 5.0, 1.0
TICK = 0.1  # seconds
DEEP = MOST_POSES  # messages of a topic that wait, if it is reliable
# Parameters of the node, and their values if no option sets them. `place`, `to`, `first`, `second`
# and `text` are for services.
PARAMETERS = {
    "scan_topic": "/scan",
    "odom_topic": "/odom",
    "odom_frame": "odom",
    "autostart": True,
    **{"place": 0, "to": 0, "first": 0, "second": 0, "text": ""},
}
MISSING = (
    "live: expected ROS 2, got none; pip install '.[ros2]' in your clone, or source its setup "
    "file, or give --replay LOG"
)


@dataclass(frozen=True)
class NodeOptions:
    """Options of the node. The first four are parameters of the node, too.

    Attributes:
        scan_topic: The topic of the LaserScan.
        odom_topic: The topic of the Odometry, or of TF: "/tf" takes the transforms to the robot
            from the frame of the parameter `odom_frame`.
        mount: The pose of the laser on the robot in metres and degrees; None takes it from
            `/tf_static`.
        autostart: Whether the node activates itself. If not, a lifecycle manager does.
        idle: End if nothing came for so many seconds; None for never.
        ros_args: Arguments of ROS, such as `-p use_sim_time:=true`.
    """

    scan_topic: str = "/scan"
    odom_topic: str = "/odom"
    mount: Sequence[float] | None = None
    autostart: bool = True
    idle: float | None = None
    ros_args: Sequence[str] = ()


def run_node(
    session: LiveSession,
    new_mapper: Callable[[], OnlineLogMapper],
    options: NodeOptions,
    say: Callable[[str], None],
    is_over: Callable[[], bool],
) -> None:
    """Run the node until `is_over`, or until nothing came for a while.

    Signal handlers may not raise meanwhile: code of ROS in C++ would make a RuntimeError of it.

    Raises LogError if ROS 2 is not installed, or cannot read its arguments.
    """
    try:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.lifecycle import LifecycleNode
        from rclpy.signals import SignalHandlerOptions
    except ImportError:
        raise LogError(MISSING) from None
    try:
        given = ["--ros-args", *options.ros_args] if options.ros_args else []
        rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # its classes are private
        raise LogError(f"--ros-args: expected arguments of ROS, got {error}; mend them") from None
    node = LifecycleNode("ssh_abduction")
    pairing, idle = StampPairing(), math.inf if options.idle is None else options.idle
    try:
        live = LiveNode(node, session, pairing, new_mapper, options, say)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not is_over() and time.monotonic() - live.heard < idle:
            executor.spin_once(timeout_sec=TICK)
    finally:
        if is_over():
            say("interrupted: the drive ends here")
        if pairing.lost:
            parts = (f"{count} {why}" for why, count in pairing.lost.items())
            say(f"scans that were lost: {', '.join(parts)}")
        node.destroy_node()
        rclpy.try_shutdown()


def scan_of(message: Any, mount: Mount, odometry: Pose, number: int) -> Scan:
    """Make a Scan of a LaserScan. Raises Damaged."""
    ranges, laser = measured(message, mount)
    with np.errstate(invalid="ignore"):
        ranges[~(ranges >= message.range_min)] = np.nan
        ranges[ranges >= laser.reach] = np.inf
    return Scan(ranges, laser, odometry, None, stamp_of(message.header), number)


class LaserFrames:
    """Where the laser is on the robot: as a person says, or as transforms do.

    Args:
        odom: The frame of the odometry.
        given: What a person says: metres ahead, metres to the left, degrees to the left; or empty.
    """

    def __init__(self, odom: str, given: Sequence[float]) -> None:
        self.odom, self.base = odom, ""  # `base` is the frame of the robot
        self.given = given
        self.known: Frames = {}
        self._mounts: dict[str, Mount] = {}  # by the frame of the scans

    def add(self, transform: Any, is_static: bool) -> Pose | None:
        """Add a transform. Return the pose of the robot if it has one. Raises Damaged."""
        child, parent = map(frame_name, (transform.child_frame_id, transform.header.frame_id))
        record_transform(self.known, child, parent, transform.transform, is_static)
        if is_static or parent != self.odom:
            return None
        self.base = child
        return flat_pose(transform.transform.translation, transform.transform.rotation)

    def mount(self, message: Any, may_wait: bool, say: Callable[[str], None]) -> Mount | None:
        """Where the laser of a scan is; None if transforms may still come and `may_wait`."""
        frame = frame_name(message.header.frame_id)
        if self.given:
            x, y, degrees = self.given
            return Mount((x, y, math.radians(degrees)))
        if frame in self._mounts:
            return self._mounts[frame]
        notes = list[str]()
        mount = mount_of(self.known, self.odom, self.base, frame, notes)
        if mount is None:
            if may_wait:
                return None
            say(f"/tf_static: {describe_unmounted(self.known, self.base, [frame])}")
            return Mount()
        try:
            mount = believed(mount, [message], frame, "/tf_static", False, notes)
        except LogError as error:
            notes.append(f"{error}; the laser is taken to be level")
            mount = Mount(mount.pose, mount.is_flipped)
        for note in notes:
            say(note)
        self._mounts[frame] = mount
        return mount


class LiveNode:
    """The topics and services of a lifecycle node, around a session."""

    def __init__(
        self,
        node: Any,
        session: LiveSession,
        pairing: StampPairing,
        new_mapper: Callable[[], OnlineLogMapper],
        options: NodeOptions,
        say: Callable[[str], None],
    ) -> None:
        from nav_msgs.msg import Odometry
        from rclpy.clock import Clock, ClockType
        from rclpy.lifecycle import SimpleManagedEntity
        from rclpy.parameter import Parameter
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from sensor_msgs.msg import LaserScan
        from std_msgs.msg import String
        from std_srvs.srv import SetBool, Trigger
        from visualization_msgs.msg import MarkerArray

        self.node, self.session, self._say = node, session, say
        self.pairing, self.heard = pairing, time.monotonic()
        self._new_mapper = new_mapper
        self._begun, self._said, self._told_events = time.monotonic(), set[str](), 0
        for name, value in PARAMETERS.items():
            node.declare_parameter(name, getattr(options, name, value))
        node.declare_parameter(
            "mount", Parameter.Type.DOUBLE_ARRAY if options.mount is None else [*options.mount]
        )
        given = tuple(node.get_parameter_or("mount").value or ())
        self._frames = LaserFrames(str(self._value("odom_frame")), given)
        self._by_frames = self._value("odom_topic").strip("/") == "tf"
        self._listen_to_frames()
        self._kinds: dict[str, tuple[Any, Callable[[Any], None]]] = {
            str(self._value("scan_topic")): (LaserScan, self._on_scan)
        }
        if not self._by_frames:
            self._kinds[str(self._value("odom_topic"))] = (Odometry, self._on_odom)
        self._listening, self._came = set[str](), set[Any]()
        last = session.mapper.live.log.scans[-1].time if len(session.mapper) else None
        self._after = -math.inf if last is None else last
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        kept = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._topics = {
            name: node.create_publisher(kind, f"~/{name}", quality)
            for name, kind, quality in (
                ("markers", MarkerArray, latched),
                ("map", String, latched),
                ("events", String, kept),
                ("belief", String, 10),
            )
        }
        for name in ("save", "reset", "name", "correct", "route", "why", "next"):
            node.create_service(Trigger, f"~/{name}", self._service(getattr(self, f"_{name}")))
        node.create_service(SetBool, "~/pause", self._service(self._pause))
        # Timers go on if the simulated time stands still.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(TICK, self._tick, clock=steady)
        node.create_timer(LOOK, self._look, clock=steady)
        self._state = SimpleManagedEntity()
        node.add_managed_entity(self._state)
        if self._value("autostart"):
            node.trigger_configure()
            node.trigger_activate()

    def _once(self, text: str, about: str = "") -> None:
        """Say something once, or one thing about something."""
        if (about or text) not in self._said:
            self._said.add(about or text)
            self._say(text)

    @contextmanager
    def _told(self, what: str) -> Iterator[None]:
        """Say once what is wrong with a message."""
        try:
            yield
        except Damaged as error:
            self._once(f"{what}: a message was dropped: {error}")

    def _listen_to_frames(self) -> None:
        """Listen to transforms, if their message is installed. Raises LogError if it must be."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            if self._by_frames:
                raise LogError(
                    "/tf: expected the ROS package tf2_msgs, which reads transforms, got none; "
                    "install it, or name a topic with Odometry"
                ) from None
            if not self._frames.given:
                self._frames.given = (0.0, 0.0, 0.0)
                self._once(
                    "tf2_msgs is not installed, so the laser is taken to be in the middle of the "
                    "robot; if it is not, give --set mount=X,Y,DEGREES"
                )
            return
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        fixed, moving = (partial(self._on_frames, is_static=static) for static in (True, False))
        self.node.create_subscription(TFMessage, "/tf_static", fixed, latched)
        if self._by_frames:
            self.node.create_subscription(TFMessage, self._value("odom_topic"), moving, DEEP)

    def _on_frames(self, message: Any, is_static: bool) -> None:
        for one in message.transforms:
            with self._told("transforms"):
                if (pose := self._frames.add(one, is_static)) is not None:
                    self._add_pose(stamp_of(one.header), pose)

    def _look(self) -> None:
        """Listen to the topics that are there, and say what is missing."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data

        is_late = time.monotonic() - self._begun > PATIENCE
        own = (self.node.get_fully_qualified_name(), "/parameter_events", "/rosout")
        named_types = sorted(self.node.get_topic_names_and_types())
        there = [f"{t} ({' '.join(of)})" for t, of in named_types if not t.startswith(own)]
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
            if is_late and kind not in self._came:
                self._once(
                    f"{topic}: expected messages {kind.__name__}, got none for {PATIENCE:.0f} s "
                    f"from {counted(len(sources), 'publishers')}; other topics: "
                    f"{', '.join(there) or 'none'}; name the topic",
                    f"{topic} is silent",
                )
        if is_late and self._by_frames and not self._frames.base:
            known = ", ".join(
                f"{one} to {child}" for child, of in self._frames.known.items() for one in of
            )
            self._once(
                f"expected transforms from {self._frames.odom} for {PATIENCE:.0f} s, got "
                f"{known or 'none'}; set the parameter odom_frame",
                "no transforms",
            )

    def _on_odom(self, message: Any) -> None:
        self._came.add(type(message))
        self._frames.base = frame_name(message.child_frame_id)
        with self._told("odometry"):
            at = flat_pose(message.pose.pose.position, message.pose.pose.orientation)
            self._add_pose(stamp_of(message.header), at)

    def _add_pose(self, at: float, pose: Pose) -> None:
        self.heard, before = time.monotonic(), self.pairing.restarts
        self.pairing.add_pose(at, pose)
        if self.pairing.restarts > before:
            self._after = -math.inf
            self._say("the clock went back: it started anew")
        self._work()

    def _on_scan(self, message: Any) -> None:
        self._came.add(type(message))
        self.heard = time.monotonic()
        if not len(message.ranges):
            self._once("a scan has no ranges; look at the driver of the laser")
        elif not self._state.is_activated:
            self.pairing.lost["while paused"] += 1
        else:
            self.pairing.add_scan(stamp_of(message.header), message)
            self._work()

    def _mount_of(self, message: Any) -> Mount | None:
        return self._frames.mount(message, time.monotonic() - self._begun < PATIENCE, self._once)

    def _work(self) -> None:
        for at, message, pose in self.pairing.ready(lambda one: self._mount_of(one) is not None):
            if self._after - at > BACK:
                self._say("the clock is behind the saved state: the robot may be anywhere")
                self.session.mapper.lift()
                self._after = -math.inf
            if at <= self._after:  # known from the saved state
                continue
            mount = self._mount_of(message)
            assert mount is not None
            with self._told("scan"):
                self.session.take(scan_of(message, mount, pose, len(self.session.mapper)))

    def _tick(self) -> None:
        from std_msgs.msg import String

        self._work()  # a scan that waited for its mount may go now
        if self.session.tick():
            self._publish()
        for text in self.session.events[self._told_events :]:
            self._topics["events"].publish(String(data=text))
        self._told_events = len(self.session.events)
        if (seen := self.session.seen) is not None:
            said = {"pose": seen.pose, "on_map": seen.on_map, "belief": seen.belief}
            self._topics["belief"].publish(String(data=json.dumps(said)))

    def _publish(self) -> None:
        """Publish the map as JSON and as markers."""
        from geometry_msgs.msg import Point
        from std_msgs.msg import String
        from visualization_msgs.msg import Marker, MarkerArray

        found, now = self.session.told, self.node.get_clock().now().to_msg()
        self._topics["map"].publish(String(data=json.dumps(found)))
        at = {place["place"]: (place["x"], place["y"]) for place in found["places"]}

        def marker(sort: str, number: int, kind: int, size: float) -> Any:
            made = Marker(ns=sort, id=number, type=kind, action=Marker.ADD)
            made.header.frame_id, made.header.stamp = self._frames.odom, now
            made.pose.orientation.w = made.color.a = made.color.g = 1.0
            made.scale.x = made.scale.y = made.scale.z = size
            return made

        clear = Marker(action=Marker.DELETEALL)
        clear.header.frame_id = self._frames.odom
        markers, provisional = [clear], dict(enumerate(found["provisional"]))
        for sort, middles, size in (("places", at, 0.6), ("provisional", provisional, 0.3)):
            for number, (x, y) in middles.items():
                ball = marker(sort, number, Marker.SPHERE, size)
                ball.pose.position.x, ball.pose.position.y = x, y
                markers.append(ball)
        lines = marker("edges", 0, Marker.LINE_LIST, 0.1)
        for pair in found["edges"]:
            lines.points += [Point(x=at[n][0], y=at[n][1]) for n in pair]
        self._topics["markers"].publish(MarkerArray(markers=[*markers, lines]))

    def _service(self, act: Callable[[Any], str]) -> Callable[[Any, Any], Any]:
        """Make the callback of a service: `act` returns what is said, or raises AbductionError."""

        def answer(request: Any, response: Any) -> Any:
            try:
                response.success, response.message = True, act(request)
            except AbductionError as error:
                response.success, response.message = False, str(error)
            return response

        return answer

    def _value(self, name: str) -> Any:
        return self.node.get_parameter(name).value

    def _save(self, _: Any) -> str:
        self.session.save()
        return json.dumps({**self.session.mapper.to_dict(), "lost": dict(self.pairing.lost)})

    def _reset(self, _: Any) -> str:
        self.session.restart(self._new_mapper())
        return "a new drive begins"

    def _pause(self, request: Any) -> str:
        if request.data == self._state.is_activated:
            (self.node.trigger_deactivate if request.data else self.node.trigger_activate)()
        return "scans are dropped" if request.data else "scans are taken"

    def _name(self, _: Any) -> str:
        self.session.happened(self.session.mapper.name(self._value("place"), self._value("text")))
        return f"place {self._value('place')} is {self._value('text')}"

    def _correct(self, _: Any) -> str:
        """Say with `text` that the scans `first` and `second` are at one place, or at two."""
        kind, first, second = map(self._value, ("text", "first", "second"))
        self.session.mapper.correct(kind, first, second)
        return f"{kind} {first}, {second}: the next search obeys"

    def _next(self, _: Any) -> str:
        return self.session.mapper.next()

    def _route(self, _: Any) -> str:
        """The places on the shortest route, in metres, from `place` to `to`."""
        import networkx as nx

        found = self.session.told
        at = {place["place"]: (place["x"], place["y"]) for place in found["places"]}
        graph = nx.Graph()
        graph.add_nodes_from(at)
        graph.add_weighted_edges_from((a, b, math.dist(at[a], at[b])) for a, b in found["edges"])
        ends = self._value("place"), self._value("to")
        if not at.keys() >= {*ends}:
            numbers = ", ".join(map(str, at)) or "none yet"
            raise LogError(f"places: expected two of {numbers}, got {ends}; set `place` and `to`")
        try:
            return " ".join(map(str, nx.shortest_path(graph, *ends, "weight")))
        except nx.NetworkXNoPath as error:
            raise LogError(str(error)) from None

    def _why(self, _: Any) -> str:
        """How sure the map is."""
        return self.session.mapper.said or "there is no map yet"
