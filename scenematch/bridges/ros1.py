"""The bridge's ROS 1 node, using rospy. It stays on loopback unless ROS_IP or ROS_HOSTNAME is set."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from engine.errors import BackendError
from scenematch.bridges.ros import OUTPUTS, Handler, find_class, topic_of
from scenematch.files.ros.messages import MessageFactory

__all__ = ["Node"]

_IMAGE_BUFFER_BYTES = 2**24  # with rospy's default of 64 kB, images queue up in the socket and grow old


class Node:
    """A node; implements :class:`scenematch.bridges.ros.RosNode`.

    Args:
        name: name of the node and prefix of its topics.
        arguments: NAME:=VALUE for ROS, such as remaps, ``__name`` and ``__ns``.

    Raises:
        BackendError: rospy is not installed, or no master answers.
    """

    def __init__(self, name: str, arguments: Sequence[str] = ()) -> None:
        if not (os.environ.get("ROS_IP") or os.environ.get("ROS_HOSTNAME")):
            os.environ["ROS_IP"] = "127.0.0.1"  # without it rospy listens on every address
        try:
            import genpy
            import rosgraph
            import rospy
        except ImportError as error:
            raise BackendError(f"bridge: expected rospy to be importable (see docs/ros.md): {error}") from None
        if not rosgraph.is_master_online():
            raise BackendError(f"bridge: expected a ROS master at {rosgraph.get_master_uri()}, got no answer")
        self._rospy = rospy
        rospy.init_node(name, argv=list(arguments))
        self.messages = MessageFactory(find_class, True, genpy.Time)
        self._publishers = {
            output: rospy.Publisher(topic_of(output, "~"), find_class(kind), queue_size=10, tcp_nodelay=True)
            for output, kind in OUTPUTS.items()
        }

    def now_ns(self) -> int:
        """ROS time in nanoseconds, simulated if the node is configured so."""
        return int(self._rospy.Time.now().to_nsec())

    def wait_for(self, topic: str, msgtype: str, timeout_s: float) -> Any:
        """Wait for the next message of a topic; None after the timeout."""
        try:
            return self._rospy.wait_for_message(topic, find_class(msgtype), timeout_s)
        except self._rospy.ROSException:
            return None

    def publish(self, output: str, message: Any) -> None:
        """Publish a message; after shutdown it is discarded."""
        if not self._rospy.is_shutdown():
            self._publishers[output].publish(message)

    def spin(
        self, handlers: dict[str, tuple[str, Handler]], every_second: Callable[[], None], seconds: float | None
    ) -> None:
        """Subscribe, and call ``every_second`` once a second until shutdown or for ``seconds``."""
        for topic, (msgtype, handler) in handlers.items():
            limits = {} if not msgtype.endswith("Image") else {"queue_size": 1, "buff_size": _IMAGE_BUFFER_BYTES}
            self._rospy.Subscriber(topic, find_class(msgtype), handler, tcp_nodelay=True, **limits)
        end_s = None if seconds is None else time.monotonic() + seconds
        while not self._rospy.is_shutdown() and (end_s is None or time.monotonic() < end_s):
            time.sleep(1.0 if end_s is None else min(1.0, max(end_s - time.monotonic(), 0.0)))
            every_second()
