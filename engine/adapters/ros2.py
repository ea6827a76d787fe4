"""The ROS 2 node: rclpy's topics to and from the bridge. On loopback, unless the environment says else."""

from __future__ import annotations

import array
import os
import time
from collections.abc import Callable
from typing import Any

from engine.adapters.ros import OUTPUTS, Handler, find_class
from engine.errors import BackendError
from engine.formats.ros.messages import MessageFactory

_LOOPBACK = {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}  # up to Humble; from Iron on


class Node:
    """A node; implements :class:`engine.adapters.ros.RosNode`.

    Args:
        name: of the node, under which it publishes.

    Raises:
        BackendError: rclpy is not installed.
    """

    def __init__(self, name: str) -> None:
        if not any(variable in os.environ for variable in _LOOPBACK):
            os.environ.update(_LOOPBACK)
        try:
            import rclpy
            from rclpy.qos import qos_profile_sensor_data
        except ImportError as error:
            raise BackendError(f"bridge: expected rclpy to be importable (see docs/ros.md): {error}") from None
        rclpy.init()
        self._rclpy, self._quality = rclpy, qos_profile_sensor_data
        self._node = rclpy.create_node(name)
        self.maker = MessageFactory(
            find_class,
            False,
            octets=lambda values: array.array("B", values.tobytes()),  # a list would be checked byte by byte
            octet=lambda value: bytes([value]),
        )
        self._publishers = {
            output: self._node.create_publisher(find_class(kind), _topic(output), 10)
            for output, kind in OUTPUTS.items()
        }

    def now_ns(self) -> int:
        """The time of ROS, simulated where it is."""
        return int(self._node.get_clock().now().nanoseconds)

    def wait_for(self, topic: str, msgtype: str, timeout_s: float) -> Any:
        """The next message of a topic; None after the timeout."""
        found: list[Any] = []
        subscription = self._node.create_subscription(find_class(msgtype), topic, found.append, self._quality)
        end_s = time.monotonic() + timeout_s
        while not found and self._rclpy.ok() and time.monotonic() < end_s:
            self._rclpy.spin_once(self._node, timeout_sec=0.2)
        self._node.destroy_subscription(subscription)
        return found[0] if found else None

    def publish(self, output: str, message: Any) -> None:
        """Publish a message; after the end of the node it goes nowhere."""
        if self._rclpy.ok():
            self._publishers[output].publish(message)

    def is_wanted(self, output: str) -> bool:
        """Whether anybody subscribes to it."""
        return bool(self._publishers[output].get_subscription_count())

    def spin(
        self, handlers: dict[str, tuple[str, Handler]], beat: Callable[[], None], seconds: float | None
    ) -> None:
        """Subscribe, and call ``beat`` every second until the node is shut down or the time is over."""
        for topic, (msgtype, handler) in handlers.items():
            # Best effort, the newest few: it hears reliable publishers as well, and never waits for an old one.
            self._node.create_subscription(find_class(msgtype), topic, handler, self._quality)
        begin_s = beaten_s = time.monotonic()
        while self._rclpy.ok() and (seconds is None or time.monotonic() - begin_s < seconds):
            self._rclpy.spin_once(self._node, timeout_sec=0.2)
            if time.monotonic() - beaten_s >= 1.0:
                beaten_s = time.monotonic()
                beat()


def _topic(output: str) -> str:
    return "/diagnostics" if output == "diagnostics" else f"~/{output}"
