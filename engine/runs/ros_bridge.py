"""``bridge ros``: a camera's topic and a vehicle's in, poses, fixes and diagnostics out."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from engine.adapters.ros import RosBridge, RosNode, RosTopics
from engine.adapters.ros_out import RosOptions
from engine.adapters.vehicle import NedOrigin
from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import named_as_typed, open_map, parse_position
from engine.errors import BackendError, CalibrationError, OptionError
from engine.formats.ros.messages import camera_from_message
from engine.matcher import SceneMatcher
from engine.runs.checks import check_place
from engine.runs.mavlink_bridge import MatchSettings
from engine.runs.watching import Watching, watched_beside

_PATIENCE_S = 30.0


@dataclass(frozen=True, slots=True)
class RosFiles:
    """The map, the calibration where a file has it, and the topics."""

    map: Path
    surface: Path | None
    camera: Path | None
    topics: RosTopics
    map_sigma_m: float | None = None  # how well the map lies, where it does not say

    def __post_init__(self) -> None:
        if not self.topics.image:
            raise OptionError("--image-topic: expected a name, got nothing")


def run_bridge_ros(
    version: int,
    inputs: RosFiles,
    matching: MatchSettings,
    firmware: str,
    origin: str | None,
    *,
    as_json: bool,
    watching: Watching,
) -> None:
    """Run the node until ROS, the time or somebody ends it, and print what was done."""
    watching.check()
    start, place = parse_position("--start", matching.start), parse_position("--origin", origin)
    begin = None if place is None else NedOrigin(place.lat_deg or 0.0, place.lon_deg or 0.0, 0.0)
    with named_as_typed(firmware="--firmware"):
        options = RosOptions(firmware=firmware, origin=begin)
    site = open_map(inputs.map, inputs.surface, inputs.map_sigma_m)
    check_place("--start", start, site, OptionError)
    camera = None if inputs.camera is None else Camera.load(inputs.camera)
    node = _node(version)
    matcher = SceneMatcher(
        site, camera or _told(node, inputs.topics.camera_info), matching.method, matching.device
    )
    matcher.warmup()

    with watched_beside(matcher, watching) as (make_navigator, watcher):
        bridge = RosBridge(node, site, make_navigator, options, start, matching.live_options(), watch=watcher)
        console.say(f"listening to {inputs.topics.image}")
        try:
            node.spin(bridge.handlers(inputs.topics), bridge.check_input, matching.seconds)
        finally:
            bridge.close()
    console.facts(asdict(bridge.status), as_json, title=f"ROS {version} on {inputs.topics.image}")


def _node(version: int) -> RosNode:
    if version == 1:
        from engine.adapters import ros1

        return ros1.Node("scenematch")
    if version == 2:
        from engine.adapters import ros2

        return ros2.Node("scenematch")
    raise OptionError(f"--ros: expected 1 or 2, got {version}")


def _told(node: RosNode, topic: str) -> Camera:
    """The calibration that a topic tells."""
    if not topic:
        raise CalibrationError("--camera: expected a calibration, or a topic that has it")
    console.say(f"waiting for the calibration on {topic}")
    message = node.wait_for(topic, "sensor_msgs/msg/CameraInfo", _PATIENCE_S)
    if message is None:
        raise BackendError(
            f"--camera-info-topic: expected a calibration on {topic} within {_PATIENCE_S:g} s, got none"
        )
    return camera_from_message(message)
