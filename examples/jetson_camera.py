"""Feed a Jetson's CSI camera into Live by GStreamer. Run it in the folder of map.tif and camera.yaml: LAT LON."""

import sys

from engine import Answer, Camera, Fix, Frame, Live, LiveOptions, Navigator, OrthoMap, Prior, SceneMatcher
from scenematch import RecentValues
from scenematch.bridges.pictures import capture

matcher = SceneMatcher(OrthoMap.open("map.tif"), Camera.load("camera.yaml"), method="auto")
matcher.warmup()  # builds lookups and plans before take-off
start = Prior(lat_deg=float(sys.argv[1]), lon_deg=float(sys.argv[2]), sigma_m=15.0)
pipeline = (
    "exec:gst-launch-1.0 -q nvarguscamerasrc ! video/x-raw(memory:NVMM),width=1280,height=720,framerate=15/1"
    " ! nvvidconv ! video/x-raw,width=640,height=360 ! jpegenc ! fdsink"
)
KNOWN = ("roll_deg", "pitch_deg", "heading_deg", "height_agl_m")
vehicle = RecentValues((True, True, True))  # call vehicle.add(ns, roll, pitch, heading, height) for your autopilot


def deliver(answer: Answer) -> None:
    """Print the fix; send it to your autopilot here."""
    if isinstance(answer.result, Fix):
        print(f"{answer.result.lat_deg:.7f} {answer.result.lon_deg:.7f}, {answer.age_ms:.0f} ms old")


with Live(lambda prior: Navigator(matcher, prior), deliver, start, LiveOptions(deadline_ms=500)) as live:
    for image, taken_ns in filter(None, capture(pipeline, exposure_to_grab_ms=60.0)):  # measure yours
        known = dict(zip(KNOWN, vehicle.at(taken_ns) or (None,) * 4, strict=True))
        live.submit(Frame(image, taken_ns, **known), captured_ns=taken_ns)  # capture gives RGB
