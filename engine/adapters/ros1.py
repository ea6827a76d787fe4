"""The ROS 1 node: rospy's topics to and from the bridge. On loopback, unless ROS_IP or ROS_HOSTNAME is set."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from engine.adapters.ros import OUTPUTS, Handler, find_class
from engine.errors import BackendError
from engine.formats.ros.messages import MessageFactory

_IMAGE_BUFFER_BYTES = 2**24  # by rospy's default of 64 kB pictures queue up in the socket, and grow old there


class Node:
    """A node; implements :class:`engine.adapters.ros.RosNode`.

    Args:
        name: of the node, under which it publishes.

    Raises:
        BackendError: rospy is not installed, or no master answers.
    """

    def __init__(self, name: str) -> None:
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
        rospy.init_node(name)
        self.maker = MessageFactory(find_class, True, genpy.Time, octets=lambda values: values.tobytes())
        self._publishers = {
            output: rospy.Publisher(_topic(output), find_class(kind), queue_size=10, tcp_nodelay=True)
            for output, kind in OUTPUTS.items()
        }

    def now_ns(self) -> int:
        """The time of ROS, simulated where it is."""
        return int(self._rospy.Time.now().to_nsec())

    def wait_for(self, topic: str, msgtype: str, timeout_s: float) -> Any:
        """The next message of a topic; None after the timeout."""
        try:
            return self._rospy.wait_for_message(topic, find_class(msgtype), timeout_s)
        except self._rospy.ROSException:
            return None

    def publish(self, output: str, message: Any) -> None:
        """Publish a message; after the end of the node it goes nowhere."""
        if not self._rospy.is_shutdown():
            self._publishers[output].publish(message)

    def is_wanted(self, output: str) -> bool:
        """Whether anybody subscribes to it."""
        return bool(self._publishers[output].get_num_connections())

    def spin(
        self, handlers: dict[str, tuple[str, Handler]], beat: Callable[[], None], seconds: float | None
    ) -> None:
        """Subscribe, and call ``beat`` every second until the node is shut down or the time is over."""
        for topic, (msgtype, handler) in handlers.items():
            many = {} if not msgtype.endswith("/Image") else {"queue_size": 1, "buff_size": _IMAGE_BUFFER_BYTES}
            self._rospy.Subscriber(topic, find_class(msgtype), handler, tcp_nodelay=True, **many)
        end_s = None if seconds is None else time.monotonic() + seconds
        while not self._rospy.is_shutdown() and (end_s is None or time.monotonic() < end_s):
            time.sleep(1.0 if end_s is None else min(1.0, max(end_s - time.monotonic(), 0.0)))
            beat()


def _topic(output: str) -> str:
    return "/diagnostics" if output == "diagnostics" else f"~{output}"
