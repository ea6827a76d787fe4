"""In ROS: in_ros.py 1|2 [NAME:=VALUE ...], your own node. Run it in the folder of the map and camera.yaml."""

import sys
from contextlib import suppress
from importlib import import_module

from engine import Camera, Navigator, OrthoMap, SceneMatcher
from scenematch.bridges.ros import RosBridge, RosOptions, RosTopics

if sys.argv[1:2] not in (["1"], ["2"]):
    sys.exit(__doc__)
site = OrthoMap.open("map.tif", surface="dsm.tif")
matcher = SceneMatcher(site, Camera.load("camera.yaml"), method="auto")
matcher.warmup()
node = import_module(f"scenematch.bridges.ros{sys.argv[1]}").Node("scenematch", tuple(sys.argv[2:]))
bridge = RosBridge(node, site, lambda prior: Navigator(matcher, prior), RosOptions())
topics = RosTopics(
    image="/down/image_raw", compass="", height="/mavros/global_position/rel_alt"
)  # "" disables a topic
try:
    with suppress(KeyboardInterrupt):  # the usual way to stop
        node.spin(bridge.handlers(topics), bridge.check_input, None)
finally:
    bridge.close()
print(bridge.status)
