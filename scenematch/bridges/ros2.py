"""The ROS 2 node of the bridge, by rclpy. On loopback, unless the environment sets otherwise."""

from __future__ import annotations

import array
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from engine.errors import BackendError
from scenematch.bridges.ros import OUTPUTS, Handler, find_class
from scenematch.files.ros.messages import MessageFactory

__all__ = ["Node"]

_LOOPBACK = {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}  # up to Humble; from Iron on


class Node:
    """A node; implements :class:`scenematch.bridges.ros.RosNode`.

    Args:
        name: name of the node, the prefix of its topics.
        arguments: for ROS, from ``--ros-args`` on: remaps, parameters, a namespace.

    Raises:
        BackendError: rclpy is not installed.
    """

    def __init__(self, name: str, arguments: Sequence[str] = ()) -> None:
        if not any(variable in os.environ for variable in _LOOPBACK):
            os.environ.update(_LOOPBACK)
        try:
            import rclpy
            from rclpy.qos import qos_profile_sensor_data
        except ImportError as error:
            raise BackendError(f"bridge: expected rclpy to be importable (see docs/ros.md): {error}") from None
        rclpy.init(args=list(arguments))
        self._rclpy, self._qos = rclpy, qos_profile_sensor_data
        self._node = rclpy.create_node(name)
        self.messages = MessageFactory(
            find_class,
            False,
            octets=lambda values: array.array("B", values.tobytes()),  # a list would be checked byte by byte
            octet=lambda value: bytes([value]),
        )
        self._publishers = {
            output: self._node.create_publisher(find_class(kind), _topic(output), 10)
            for output, kind in OUTPUTS.items()
        }

    def parameter(self, name: str, default: Any) -> Any:
        """The value of a ROS parameter of the default's type."""
        return self._node.declare_parameter(name, default).value

    def now_ns(self) -> int:
        """ROS time in nanoseconds, simulated where the node is so configured."""
        return int(self._node.get_clock().now().nanoseconds)

    def wait_for(self, topic: str, msgtype: str, timeout_s: float) -> Any:
        """Wait for the next message of a topic; None after the timeout."""
        received: list[Any] = []
        subscription = self._node.create_subscription(find_class(msgtype), topic, received.append, self._qos)
        end_s = time.monotonic() + timeout_s
        while not received and self._rclpy.ok() and time.monotonic() < end_s:
            self._rclpy.spin_once(self._node, timeout_sec=0.2)
        self._node.destroy_subscription(subscription)
        return received[0] if received else None

    def publish(self, output: str, message: Any) -> None:
        """Publish a message; after shutdown it is discarded."""
        if self._rclpy.ok():
            self._publishers[output].publish(message)

    def has_subscribers(self, output: str) -> bool:
        """Whether the topic has subscribers."""
        return bool(self._publishers[output].get_subscription_count())

    def spin(
        self, handlers: dict[str, tuple[str, Handler]], every_second: Callable[[], None], seconds: float | None
    ) -> None:
        """Subscribe, and call ``every_second`` once a second until shutdown or for ``seconds``."""
        for topic, (msgtype, handler) in handlers.items():
            # Best effort with a short queue also hears reliable publishers, and never waits for old messages.
            self._node.create_subscription(find_class(msgtype), topic, handler, self._qos)
        begin_s = called_s = time.monotonic()
        while self._rclpy.ok() and (seconds is None or time.monotonic() - begin_s < seconds):
            self._rclpy.spin_once(self._node, timeout_sec=0.2)
            if time.monotonic() - called_s >= 1.0:
                called_s = time.monotonic()
                every_second()


def _topic(output: str) -> str:
    return "/diagnostics" if output == "diagnostics" else f"~/{output}"
