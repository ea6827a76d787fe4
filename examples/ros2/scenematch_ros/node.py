"""The node: takes the options of `scenematch bridge ros` as ROS parameters."""

import sys
from contextlib import suppress

from engine import EngineError, OptionError, set_threads
from scenematch import BridgeSettings, CameraInput, MapInput, Progress, RosSettings, run_ros_bridge
from scenematch.bridges.ros import RosTopics
from scenematch.bridges.ros2 import Node

FILES = ("map", "surface", "camera", "start", "origin", "mount")
"""Text parameters; an empty one counts as not given."""
TOPICS = RosTopics()


class Printed(Progress):
    """Prints the node's messages, one line each, for ros2 launch."""

    def message(self, text):
        """Print it at once; if what started the node has ended, nobody reads it, and the node goes on."""
        with suppress(BrokenPipeError):
            print(text, flush=True)


def settings_of(node):
    """The settings from the parameters: for ROS and for matching."""
    text = {name: node.parameter(name, "") or None for name in FILES}
    topics = {name: node.parameter(f"{name}_topic", getattr(TOPICS, name)) for name in RosTopics.__slots__}
    if text["map"] is None:
        raise OptionError("map: expected a file, got nothing; give it as -p map:=site.tif")
    map_sigma_m, hfov_deg = node.parameter("map_sigma_m", 0.0), node.parameter("hfov_deg", 0.0)
    ros = RosSettings(
        map=MapInput(text["map"], surface=text["surface"], map_sigma_m=map_sigma_m or None),
        camera=CameraInput(text["camera"], hfov_deg=hfov_deg or None, mount=text["mount"]),
        origin=text["origin"],
        firmware=node.parameter("firmware", "none"),
        topics=RosTopics(**topics),
        version=2,
    )
    matching = BridgeSettings(
        method=node.parameter("method", "auto"),
        device=node.parameter("device", "auto"),
        deadline_ms=node.parameter("deadline_ms", BridgeSettings().live_options().deadline_ms),
        start=text["start"],
    )
    return ros, matching


def main():
    """Run until ROS, Ctrl-C or SIGTERM ends it."""
    try:
        node = Node("scenematch", sys.argv)
        set_threads(node.parameter("threads", 1))
        ros, matching = settings_of(node)
        printed = Printed()
        printed.message(run_ros_bridge(ros, matching, node=node, progress=printed).line())
    except KeyboardInterrupt:  # while loading
        print("ended before it began", flush=True)
    except EngineError as error:
        sys.exit(f"scenematch: {error}")


if __name__ == "__main__":
    main()
