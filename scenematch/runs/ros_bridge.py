"""Run the ROS bridge: camera and vehicle topics in, poses, fixes and diagnostics out."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from engine.camera import Camera
from engine.errors import BackendError, OptionError
from scenematch.bridges.ros import RosBridge, RosNode, RosStatus, RosTopics
from scenematch.bridges.ros_out import RosOptions
from scenematch.bridges.vehicle import NedOrigin
from scenematch.files.ros.messages import camera_from_message, image_from_message
from scenematch.runs.arguments import parse_position
from scenematch.runs.cameras import CameraInput
from scenematch.runs.live_viewing import NO_LIVE_VIEW, LiveViewTarget, open_bridge_view
from scenematch.runs.map_input import MapInput, check_position
from scenematch.runs.mavlink_bridge import BridgeSettings
from scenematch.runs.output import SILENT, Progress
from scenematch.runs.service import running_service, status_reporter
from scenematch.runs.supervisor import end_on_sigterm

_WAIT_S = 30.0  # for the first message of a topic


@dataclass(frozen=True, slots=True, kw_only=True)
class RosSettings:
    """What a ROS node subscribes to and publishes.

    Attributes:
        version: 1 for rospy, 2 for rclpy.
        map: the map with its surface.
        camera: the camera; without a calibration, the topic's is used.
        topics: to subscribe to.
        firmware: autopilot behind MAVROS that receives the poses: "none", "ardupilot" or "px4".
        origin: origin of the poses, "LAT,LON"; None uses the map's.
        arguments: for ROS: "NAME:=VALUE" for ROS 1, those from "--ros-args" on for ROS 2.

    Raises:
        OptionError: the topic of the images has no name, or the arguments are not for this ROS.
    """

    map: MapInput
    camera: CameraInput = field(default_factory=CameraInput)
    topics: RosTopics = field(default_factory=RosTopics)
    version: int = 2
    firmware: str = "none"
    origin: str | None = None
    arguments: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        wrong = [argument for argument in self.arguments if ":=" not in argument]
        if self.version == 1 and wrong:
            raise OptionError(f"ros_arguments: expected NAME:=VALUE for ROS 1, got {' '.join(wrong)}")
        if self.version == 2 and self.arguments and self.arguments[0] != "--ros-args":
            raise OptionError(f"ros_arguments: expected --ros-args -r NAME:=VALUE, got {self.arguments[0]}")
        if not self.topics.image:
            raise OptionError("image_topic: expected a name, got nothing")

    def options(self) -> RosOptions:
        """What is published.

        Raises:
            OptionError: the firmware or the origin is invalid.
        """
        position = parse_position("origin", self.origin)
        begin = None if position is None else NedOrigin(position.lat_deg or 0.0, position.lon_deg or 0.0, 0.0)
        return RosOptions(firmware=self.firmware, origin=begin)


def run_ros_bridge(
    ros: RosSettings,
    settings: BridgeSettings | None = None,
    *,
    node: RosNode | None = None,
    live_view: LiveViewTarget = NO_LIVE_VIEW,
    progress: Progress = SILENT,
) -> RosStatus:
    """Run the node until ROS, Ctrl-C, SIGTERM or the time ends it.

    Args:
        ros: what to subscribe to and publish.
        settings: how frames are matched; None uses the defaults.
        node: the ROS node; None creates one.
        live_view: where to send the live view.
        progress: receives progress and messages.

    Returns:
        What was done.

    Raises:
        BackendError: ROS is not installed, or nothing answers.
        OptionError, MapError, CalibrationError: an argument or a file is invalid.
    """
    live_view.check()
    end_on_sigterm()  # before rospy, which calls this handler, too
    settings = settings or BridgeSettings()
    start, options = parse_position("start", settings.start), ros.options()
    site = ros.map.open(progress)
    check_position("start", start, site, OptionError)
    check_position("origin", parse_position("origin", ros.origin), site, OptionError)
    camera = None if ros.camera.camera is None else ros.camera.load(None)
    node = node or _node(ros.version, ros.arguments)
    camera = camera or _heard_camera(node, ros, progress)
    matcher = settings.matcher(site, camera)
    with progress.task("compiling") as report_compiled:
        matcher.warmup(report_compiled)

    with open_bridge_view(matcher, live_view, settings.navigator) as (make_navigator, watcher):
        bridge = RosBridge(node, site, make_navigator, options, start, settings.live_options(), watch=watcher)
        progress.message(f"listening to {ros.topics.image}")
        try:
            settings.schedule_this_thread()
            report = status_reporter(lambda: bridge.status.line(), progress)
            with running_service() as beat, suppress(KeyboardInterrupt):  # the usual end, with its counts

                def every_second() -> None:
                    bridge.check_input()
                    beat()
                    report()

                node.spin(bridge.handlers(ros.topics), every_second, settings.seconds)
        finally:
            bridge.close()
    return bridge.status


def _node(version: int, arguments: tuple[str, ...]) -> RosNode:
    if version not in (1, 2):
        raise OptionError(f"version: expected 1 or 2, got {version}")
    node: RosNode = import_module(f"scenematch.bridges.ros{version}").Node("scenematch", arguments)
    return node


def _heard_camera(node: RosNode, ros: RosSettings, progress: Progress) -> Camera:
    """The camera by its field of view and picture size, or the published calibration."""
    described, topics = ros.camera, ros.topics
    if described.hfov_deg is None:
        if not topics.camera_info:
            raise OptionError("camera: expected a calibration, or a topic that has it")
        progress.message(f"waiting for the calibration on {topics.camera_info}")
        kind, expected = "sensor_msgs/msg/CameraInfo", "camera_info_topic: expected a calibration"
        return described.mounted(camera_from_message(_heard(node, topics.camera_info, kind, expected)))
    progress.message(f"waiting for a picture on {topics.image}, whose size is not known")
    message = _heard(node, topics.image, topics.image_type, "image_topic: expected a picture")
    return described.with_field_of_view(image_from_message(message).shape)


def _heard(node: RosNode, topic: str, msgtype: str, expected: str) -> Any:
    """The next message of a topic."""
    message = node.wait_for(topic, msgtype, _WAIT_S)
    if message is None:
        raise BackendError(f"{expected} on {topic} within {_WAIT_S:g} s, got none")
    return message
