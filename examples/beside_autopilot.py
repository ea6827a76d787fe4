"""Beside an autopilot: beside_autopilot.py FIRMWARE LINK LAT LON [CAMERA]. Run it in a flight folder."""

import sys
from contextlib import suppress
from pathlib import Path

from engine import Camera, Navigator, OrthoMap, Prior, SceneMatcher
from scenematch.bridges.mavlink import MavlinkBridge, MavlinkOptions, NedOrigin, parse_connection
from scenematch.bridges.pictures import capture, replay

if not 5 <= len(sys.argv) <= 6:
    sys.exit(__doc__)
firmware, link, lat, lon, *cameras = sys.argv[1:]  # ardupilot, udpin:127.0.0.1:14550, where it takes off, 0
site = OrthoMap.open("map.tif", surface="dsm.tif")
matcher = SceneMatcher(site, Camera.load("camera.yaml"), method="auto")
matcher.warmup()
start = Prior(lat_deg=float(lat), lon_deg=float(lon), sigma_m=15.0)
origin = NedOrigin(site.frame.lat_deg, site.frame.lon_deg, site.ground_m)  # for an autopilot that has none
options = MavlinkOptions(firmware=firmware)
bridge = MavlinkBridge(
    parse_connection(link), lambda prior: Navigator(matcher, prior), options, start, origin=origin, site=site
)
# A camera or, without one, the flight folder's pictures in real time.
pictures = capture(cameras[0]) if cameras else replay(Path("frames"), Path("telemetry.csv"), rate_hz=5.0)
with bridge, suppress(KeyboardInterrupt):  # the usual way to stop with a camera
    for picture in pictures:
        if picture is not None:  # None: the camera had no picture for a while
            bridge.submit(*picture)
print(bridge.status)  # after closing, the last frame has been answered
