"""The bridge's ROS 2 node, using rclpy. Discovery stays on this machine unless the environment says otherwise."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from engine.errors import BackendError, OptionError
from scenematch.bridges.ros import OUTPUTS, Handler, find_class, topic_of
from scenematch.files.ros.messages import MessageFactory

__all__ = ["Node"]


class Node:
    """A node; implements :class:`scenematch.bridges.ros.RosNode`.

    Args:
        name: name of the node and prefix of its topics.
        arguments: for ROS, from ``--ros-args`` on: remaps, parameters, a namespace.

    Raises:
        BackendError: rclpy is not installed.
        OptionError: ROS does not accept the arguments.
    """

    def __init__(self, name: str, arguments: Sequence[str] = ()) -> None:
        if "ROS_LOCALHOST_ONLY" not in os.environ:  # deprecated, but it takes precedence
            os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        try:
            import rclpy
            from rcl_interfaces.msg import ParameterDescriptor
            from rclpy.exceptions import NameValidationException, ParameterException
            from rclpy.executors import ExternalShutdownException
            from rclpy.qos import qos_profile_sensor_data
            from rclpy.signals import SignalHandlerOptions
        except ImportError as error:
            raise BackendError(f"bridge: expected rclpy to be importable (see docs/ros.md): {error}") from None
        try:
            # rclpy's own handlers would end its context in another thread while this one still publishes.
            rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO)
            self._node = rclpy.create_node(name)
        except (RuntimeError, ParameterException) as error:
            reason = str(error).splitlines()[0]
            raise OptionError(f"ros_arguments: expected arguments of ROS 2, got {reason}") from None
        self._rclpy, self._qos = rclpy, qos_profile_sensor_data
        self._shutdown_error, self._name_error = ExternalShutdownException, NameValidationException
        self._any_type = ParameterDescriptor(dynamic_typing=True)
        self.messages = MessageFactory(find_class, False, octet=lambda value: bytes([value]))
        self._publishers = {
            output: self._node.create_publisher(find_class(kind), topic_of(output, "~/"), 10)
            for output, kind in OUTPUTS.items()
        }

    def parameter(self, name: str, default: Any) -> Any:
        """The value of a ROS parameter in the default's type; YAML turns some numbers and texts into integers.

        Raises:
            OptionError: it has another type.
        """
        value, kind = self._node.declare_parameter(name, default, self._any_type).value, type(default)
        if type(value) is kind:
            return value
        if type(value) in (int, float) and kind in (float, str):
            return kind(value)
        expected = {str: "text", float: "a number", int: "a whole number"}[kind]
        raise OptionError(f"{name}: expected {expected}, got {value!r}")

    def now_ns(self) -> int:
        """ROS time in nanoseconds, simulated if the node is configured so."""
        return int(self._node.get_clock().now().nanoseconds)

    def wait_for(self, topic: str, msgtype: str, timeout_s: float) -> Any:
        """Wait for the next message of a topic; None after the timeout."""
        received: list[Any] = []
        subscription = self._subscribe(topic, msgtype, received.append)
        end_s = time.monotonic() + timeout_s
        while not received and time.monotonic() < end_s:
            try:
                self._rclpy.spin_once(self._node, timeout_sec=0.2)
            except self._shutdown_error:
                raise KeyboardInterrupt from None  # shut down from outside, not timed out
        self._node.destroy_subscription(subscription)
        return received[0] if received else None

    def publish(self, output: str, message: Any) -> None:
        """Publish a message; after shutdown it is discarded."""
        if self._rclpy.ok():
            self._publishers[output].publish(message)

    def spin(
        self, handlers: dict[str, tuple[str, Handler]], every_second: Callable[[], None], seconds: float | None
    ) -> None:
        """Subscribe, and call ``every_second`` once a second until shutdown or for ``seconds``."""
        for topic, (msgtype, handler) in handlers.items():
            self._subscribe(topic, msgtype, handler)
        begin_s = called_s = time.monotonic()
        with suppress(self._shutdown_error):
            while seconds is None or time.monotonic() - begin_s < seconds:
                self._rclpy.spin_once(self._node, timeout_sec=0.2)
                if time.monotonic() - called_s >= 1.0:
                    called_s = time.monotonic()
                    every_second()

    def _subscribe(self, topic: str, msgtype: str, handler: Handler) -> Any:
        """Best effort with a short queue also receives from reliable publishers, and skips old messages."""
        try:
            return self._node.create_subscription(find_class(msgtype), topic, handler, self._qos)
        except self._name_error:
            raise OptionError(f"topic: expected a name that ROS 2 permits, got {topic!r}") from None
