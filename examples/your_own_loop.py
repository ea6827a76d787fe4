"""Your own loop: frames from anywhere, answers as values. Run it in a flight folder."""

import csv
from pathlib import Path

import numpy as np
from PIL import Image

from engine import Budget, Camera, Fix, Frame, Navigator, NoFix, OrthoMap, Prior, SceneMatcher

site = OrthoMap.open("map.tif", surface="dsm.tif")
camera = Camera.load("camera.yaml")
matcher = SceneMatcher(site, camera, method="ncc", device="auto")
matcher.warmup()  # builds lookups and plans before take-off

rows = list(csv.DictReader(Path("telemetry.csv").read_text(encoding="utf-8").splitlines()))
start = Prior(lat_deg=float(rows[0]["lat_deg"]), lon_deg=float(rows[0]["lon_deg"]), sigma_m=10.0)
navigator = Navigator(matcher, start, budget=Budget(total_ms=500))
for row in rows:  # your camera and autopilot here
    known = {name: float(row[name]) for name in ("height_agl_m", "heading_deg", "roll_deg", "pitch_deg")}
    image = np.array(Image.open(f"frames/{row['frame']}"))
    match navigator.update(Frame(image, timestamp_ns=int(row["timestamp_ns"]), **known)):
        case Fix() as fix:
            print(f"{fix.lat_deg:.7f} {fix.lon_deg:.7f} +- {fix.sigma_m:.1f} m, NCC {fix.score:.2f}")
        case NoFix(reason=reason, detail=detail):
            print(f"no fix: {reason.value}, {detail}")
