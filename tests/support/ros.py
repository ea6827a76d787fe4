"""Messages of both ROS by rosbags' types, and a node of a bridge that keeps what is published."""

from __future__ import annotations

import threading

from rosbags.typesys import Stores, get_typestore

from bench.inputs.bags import BagMessages

STORES = {"ros1": get_typestore(Stores.ROS1_NOETIC), "ros2": get_typestore(Stores.ROS2_HUMBLE)}
NOW_NS = 1_700_000_000_123_456_789


def maker_of(ros):
    """What makes the messages of a ROS."""
    return BagMessages(STORES[ros].types.__getitem__, ros == "ros1")


class StandInNode:
    """A node that keeps what is published, and whose clock stands still."""

    def __init__(self, maker):
        self.messages, self.published, self.changed = maker, [], threading.Condition()
        self.time_ns = NOW_NS

    def now_ns(self):
        return self.time_ns

    def publish(self, output, message):
        with self.changed:
            self.published.append((output, message))
            self.changed.notify_all()

    def of(self, output):
        """The messages of an output."""
        return [message for kind, message in list(self.published) if kind == output]

    def wait_for(self, output, count):
        """Wait until so many messages of an output were published."""
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.of(output)) >= count, 60.0), self.published
