"""Convert a flight folder's pictures to a video with its telemetry.csv. Run it in the flight folder."""

import csv
from pathlib import Path

import cv2

rows = list(csv.DictReader(Path("telemetry.csv").read_text(encoding="utf-8").splitlines()))
pictures = [cv2.imread(f"frames/{row['frame']}") for row in rows]
seconds = (int(rows[-1]["timestamp_ns"]) - int(rows[0]["timestamp_ns"])) * 1e-9
size = pictures[0].shape[1::-1]
video = cv2.VideoWriter("flight.mp4", cv2.VideoWriter_fourcc(*"mp4v"), (len(rows) - 1) / seconds, size)
for index, picture in enumerate(pictures):
    video.write(picture)
    rows[index]["frame"] = str(index)  # with a video, a frame's name is its index
video.release()
with Path("video.csv").open("w", encoding="utf-8", newline="") as file:
    table = csv.DictWriter(file, rows[0])
    table.writeheader()
    table.writerows(rows)
