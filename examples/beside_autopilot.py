"""Beside an autopilot: beside_autopilot.py FIRMWARE LINK LAT LON [CAMERA], where a flight folder's files lie."""

import sys
from pathlib import Path

from engine import Camera, Navigator, OrthoMap, Prior, SceneMatcher
from engine.adapters.links import parse_connection
from engine.adapters.mavlink import Bridge
from engine.adapters.mavlink_out import Outgoing
from engine.adapters.pictures import capture, replay
from engine.adapters.vehicle import Origin
from engine.device import set_threads

firmware, link, lat, lon, *cameras = sys.argv[1:]  # ardupilot, udpin:127.0.0.1:14550, where it takes off, 0
set_threads(1)  # more threads wait for each other on a busy processor
site = OrthoMap.open("map.tif", surface="dsm.tif")
matcher = SceneMatcher(site, Camera.load("camera.yaml"), method="auto")
matcher.warmup()
start = Prior(lat_deg=float(lat), lon_deg=float(lon), sigma_m=15.0)
origin = Origin(site.frame.lat_deg, site.frame.lon_deg, site.ground_m)  # for an autopilot that has none
outgoing = Outgoing(firmware=firmware)
bridge = Bridge(parse_connection(link), lambda prior: Navigator(matcher, prior), outgoing, start, origin=origin)
with bridge:  # a camera, or without one the flight folder's pictures at their own pace
    pictures = capture(cameras[0]) if cameras else replay(Path("frames"), Path("telemetry.csv"), rate_hz=5.0)
    for image, captured_ns in pictures:
        bridge.submit(image, captured_ns)
    print(bridge.status)
