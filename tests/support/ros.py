"""Messages of both ROS by rosbags' types, and a node of a bridge that keeps what is published."""

import threading

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from bench.inputs.bags import BagMessages

STORES = {"ros1": get_typestore(Stores.ROS1_NOETIC), "ros2": get_typestore(Stores.ROS2_HUMBLE)}
NOW_NS = 1_700_000_000_123_456_789


def maker_of(ros):
    """What makes the messages of a ROS."""
    return BagMessages(STORES[ros].types.__getitem__, ros == "ros1")


def written(path, topics, set_up=lambda writer: None):
    """A bag with messages by topic, (time_ns, message): of ROS 1 where its name is one, else a folder of ROS 2."""
    ros1 = path.suffix == ".bag"
    types = STORES["ros1" if ros1 else "ros2"]
    serialize = types.serialize_ros1 if ros1 else types.serialize_cdr
    writer = Writer1(path) if ros1 else Writer2(path, version=9)
    set_up(writer)
    with writer:
        for topic, messages in topics.items():
            name = messages[0][1].__msgtype__
            connection = writer.add_connection(topic, name, typestore=types)
            for time_ns, message in messages:
                writer.write(connection, time_ns, serialize(message, name))
    return path


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
