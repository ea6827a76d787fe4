"""Feed a Raspberry Pi camera into Live by picamera2. Run it in the folder of map.tif and camera.yaml: LAT LON."""

import sys

from picamera2 import Picamera2

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


with Live(lambda prior: Navigator(matcher, prior), deliver, start, LiveOptions(deadline_ms=500)) as live:
    camera = Picamera2()
    camera.configure(camera.create_video_configuration({"size": (640, 480), "format": "RGB888"}))  # BGR in memory
    camera.start()
    while True:
        request = camera.capture_request()
        image, told = request.make_array("main"), request.get_metadata()
        request.release()
        taken_ns = told["SensorTimestamp"] + 500 * told["ExposureTime"]  # the middle of the exposure
        known = dict(zip(KNOWN, vehicle.at(taken_ns) or (None,) * 4, strict=True))
        live.submit(Frame.from_bgr(image, taken_ns, **known), captured_ns=taken_ns)
