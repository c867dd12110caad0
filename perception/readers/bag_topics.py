"""Gives access to the topics and messages of an open bag."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from perception.readers import bag_files
from perception.readers.bag_files import cause
from perception.readers.scans import Damage
from ssh_abduction.data.errors import named
from ssh_abduction.data.words import first_few

TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
NANO = 1e-9


class Bag:
    """An open bag. `Files` explains its attributes; `source` is the name of the bag, for errors."""

    def __init__(self, files: bag_files.Files, store: Any, source: str) -> None:
        self.readers, self.format, self.notes = files.readers, files.format, files.notes
        self.source = source
        self.deserialize = (
            store.deserialize_ros1 if files.format == "ros1" else store.deserialize_cdr
        )

    @property
    def connections(self) -> list[Any]:
        return [connection for reader in self.readers for connection in reader.connections]

    def topics(self, *kinds: str) -> dict[str, int]:
        """Count the messages of each topic of these kinds; without any, of all topics."""
        counts: dict[str, int] = {}
        for connection in self.connections:
            if not kinds or connection.msgtype in kinds:
                counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        return counts

    def listed(self) -> str:
        """Name the topics with their kinds, for error messages: at most 20, or "none"."""
        topics = dict.fromkeys(
            f"{c.topic} ({c.msgtype.rpartition('/')[2]})" for c in self.connections
        )
        return first_few([*topics], 20) or "none"

    def messages(self, topics: set[str]) -> Iterator[tuple[Any, int, float, Any]]:
        """Read the messages of some topics.

        Yield for each its connection, its number within the topic (from 1), the time of recording
        in seconds, and the message. Damage takes the place of a message that cannot be read.
        """
        from rosbags.serde import SerdeError

        numbers = dict.fromkeys(topics, 0)
        for reader in self.readers:
            connections = [c for c in reader.connections if c.topic in topics]
            stored = reader.messages(connections=connections) if connections else iter(())
            while True:
                try:
                    connection, time, raw = next(stored)
                except StopIteration:
                    break
                except Exception as error:  # Damaged bytes can raise any error in the library.
                    bag_files.raise_if_disk_is_full(error, self.source)
                    number = sum(numbers.values()) + 1
                    where = " and ".join(sorted(topics))
                    what = (
                        f"{where}: expected a message, got damaged data ({cause(error)}); what "
                        "follows was not read"
                    )
                    yield connections[0], number, 0.0, Damage(number, what)
                    break
                topic = connection.topic
                numbers[topic] += 1
                try:
                    message = self.deserialize(raw, connection.msgtype)
                    yield connection, numbers[topic], time * NANO, message
                except (SerdeError, ValueError, IndexError) as error:
                    what = (
                        f"{topic}: expected a message {connection.msgtype.rpartition('/')[2]}, "
                        f"got damaged data ({cause(error)})"
                    )
                    yield connection, numbers[topic], time * NANO, Damage(numbers[topic], what)


@contextmanager
def bag_opened(path: str | os.PathLike[str], format: str) -> Iterator[Bag]:
    """Open a bag of the format `ros1`, `ros2` or `mcap`, or a folder. Raises LogError."""
    with bag_files.files_opened(Path(path), format) as files:
        yield Bag(files, typestore(files.format == "ros1"), named(path))


def typestore(is_ros1: bool) -> Any:
    """Make the store of rosbags with the types of messages, including transforms."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    for kind in TRANSFORMS:
        if kind not in store.fielddefs:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store
