"""Feed a USB camera into Live by OpenCV. Run it in the folder of map.tif and camera.yaml: LAT LON (the start)."""

import sys
import time

import cv2

from engine import Answer, Camera, Fix, Frame, Live, LiveOptions, Navigator, OrthoMap, Prior, SceneMatcher
from scenematch import RecentValues

matcher = SceneMatcher(OrthoMap.open("map.tif"), Camera.load("camera.yaml"), method="auto")
matcher.warmup()  # builds lookups and plans before take-off
start = Prior(lat_deg=float(sys.argv[1]), lon_deg=float(sys.argv[2]), sigma_m=15.0)
KNOWN = ("roll_deg", "pitch_deg", "heading_deg", "height_agl_m")
vehicle = RecentValues((True, True, True))  # call vehicle.add(ns, roll, pitch, heading, height) for your autopilot


def deliver(answer: Answer) -> None:
    """Print the fix; send it to your autopilot here."""
    if isinstance(answer.result, Fix):
        print(f"{answer.result.lat_deg:.7f} {answer.result.lon_deg:.7f}, {answer.age_ms:.0f} ms old")
    else:
        print(answer.result.reason.value, answer.result.detail)


with Live(lambda prior: Navigator(matcher, prior), deliver, start, LiveOptions(deadline_ms=500)) as live:
    camera = cv2.VideoCapture(0)
    while camera.grab():
        taken_ns = time.monotonic_ns()  # minus your camera's latency from exposure to here
        image = camera.retrieve()[1]
        while (vehicle.last_ns or 0) < taken_ns and time.monotonic_ns() < taken_ns + 50_000_000:
            time.sleep(0.002)  # until the attitude after the exposure has arrived
        known = dict(zip(KNOWN, vehicle.at(taken_ns) or (None,) * 4, strict=True))
        live.submit(Frame.from_bgr(image, taken_ns, **known), captured_ns=taken_ns)
