"""A public repository, as you cloned it, as a flight folder.

    python -m bench.samples park drone_dataset_brighton_beach --out park
    python -m bench.samples campus Aerial-Template-Matching --out campus

``park``, of pierotofy: 18 photographs as a drone took them. Map and heights are the repository's point cloud,
which was made of the same photographs; the package laspy reads it. ``campus``, of m-hamza-mughal: a video on a
satellite map of another date. Nobody published where it was filmed, nor how the camera hangs: heights, headings,
rounded to 5 m and 2 degrees, and the truth, the ground in the middle of each fifth frame, are read off the map by
OpenCV's SIFT. That truth is good to about a metre. Both repositories have the 2-clause BSD licence.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from bench.command import new_folder
from bench.datasets import link_frames
from engine import Camera, OrthoMap
from engine.values import Window
from scenematch.files.flight import camera_info
from scenematch.files.geotiff import write_geotiff
from scenematch.files.telemetry import TelemetryRow, write_telemetry
from scenematch.files.truth import truth_from_telemetry, write_truth

Array = NDArray[np.float64]

PARK_EPSG, STEP_M, REACH_M = 32615, 0.1, 1.0
"""Zone and pixels of the park's map, and how far from a point they reach."""
HFOV_DEG, EVERY = 64.1, 5
"""Of the campus' camera, assumed; and how many frames lie between two that are located."""
_MIN_MATCHES, _NEIGHBOURS, _APART_PX, _SMOOTH = 8, 15, 10.0, 5


def park(root: Path, out: Path) -> int:
    """Photographs as they are, over the points seen from above; returns the number of photographs."""
    try:
        import laspy
    except ImportError:
        raise SystemExit("laspy: expected the package, got none: pip install 'laspy[lazrs]'") from None
    cloud = laspy.read(root / "model.laz")
    points = np.column_stack([getattr(cloud, name) for name in ("x", "y", "z", "red", "green", "blue")])
    seen, near, corner = from_above(points.astype(np.float64))
    colours = np.dstack([seen[..., 1:], 255 * near]).astype(np.uint8)
    heights_m = np.where(near, seen[..., 0], np.nan).astype(np.float32)
    west, north = corner + 0.5 * STEP_M * np.array([1.0, -1.0])
    placed = np.array([[STEP_M, 0.0, west], [0.0, -STEP_M, north]]), PARK_EPSG
    write_geotiff(out / "map.tif", colours, *placed)
    write_geotiff(out / "dsm.tif", heights_m, *placed)
    photos = sorted((root / "images").glob("*.JPG"))
    link_frames(out, photos)
    return len(photos)


def from_above(points: Array) -> tuple[Array, NDArray[np.bool_], Array]:
    """What is seen of points (N, 3 + C), metres and colours, from above.

    Returns:
        Height and colours (H, W, 1 + C) of the highest point in each pixel, else in the nearest with a point;
        whether one is within :data:`REACH_M`, (H, W); and the raster's corner (2,), west and north.
    """
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    width, height = (np.floor((high - low) / STEP_M).astype(int) + 1).tolist()
    rising = points[np.argsort(points[:, 2], kind="stable")]
    x, y = ((rising[:, :2] - low) / STEP_M).astype(int).T
    seen, empty = np.zeros((height, width, points.shape[1] - 2)), np.ones((height, width), np.uint8)
    seen[height - 1 - y, x], empty[height - 1 - y, x] = rising[:, 2:], 0
    away_px, label = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros((label.max() + 1, seen.shape[2]))
    of_label[label[empty == 0]] = seen[empty == 0]
    return of_label[label], np.asarray(away_px * STEP_M <= REACH_M), low + np.array([0.0, height * STEP_M])


def campus(root: Path, out: Path) -> int:
    """Map and video as they are, with what the map shows of the flight; returns the number of rows."""
    folder = (root / "SIFT-based").resolve()
    (out / "map.tif").symlink_to(folder / "1.tif")
    (out / "flight.mp4").symlink_to(folder / "our_data.mp4")
    site, reader = OrthoMap.open(out / "map.tif"), cv2.VideoCapture(str(out / "flight.mp4"))
    sides = (round(reader.get(which)) for which in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    camera, rate_hz = Camera.from_fov(*sides, HFOV_DEG), reader.get(cv2.CAP_PROP_FPS)
    places = smoothed(np.array(list(_places(site, reader, camera.matrix[:2, 2]))))
    up_m = places[:, 3:].T  # of one pixel towards the top of the picture
    heights_m, headings_deg = np.hypot(*up_m) * camera.focal_px, np.degrees(np.arctan2(*up_m))
    rows = [
        TelemetryRow(
            timestamp_ns=round(index / rate_hz * 1e9),
            frame=f"{index:.0f}",
            height_agl_m=5.0 * round(height_m / 5.0),
            heading_deg=2.0 * round(heading_deg / 2.0) % 360.0,
        )
        for index, height_m, heading_deg in zip(places[:, 0], heights_m, headings_deg, strict=True)
    ]
    lat_deg, lon_deg = site.geodetic_from_pixel(places[:, 1:3])
    write_telemetry(out / "telemetry.csv", rows)
    write_truth(out / "truth.csv", list(map(truth_from_telemetry, rows, lat_deg.tolist(), lon_deg.tolist())))
    (out / "camera.yaml").write_text(camera_info(camera), encoding="utf-8")
    return len(rows)


def _places(site: OrthoMap, reader: cv2.VideoCapture, middle_px: Array) -> Iterator[tuple[float, ...]]:
    """Where frames are plainly found: index, middle x and y on the map, a pixel upwards in metres east, north."""
    detector, matcher = cv2.SIFT.create(2000), cv2.FlannBasedMatcher({"algorithm": 1, "trees": 4}, {"checks": 64})
    picture = site.gray(Window(0, 0, site.width_px, site.height_px), 0)
    keypoints, descriptors = cv2.SIFT.create(20_000, contrastThreshold=0.01).detectAndCompute(picture, None)
    matcher.add([descriptors])
    ground_px, index = cv2.KeyPoint.convert(keypoints), 0
    while reader.grab():
        if index % EVERY == 0:
            gray = cv2.cvtColor(reader.retrieve()[1], cv2.COLOR_BGR2GRAY)
            keypoints, descriptors = detector.detectAndCompute(gray, None)
            pairs = matcher.knnMatch(descriptors, k=2)
            kept = [first for first, second in pairs if first.distance < 0.8 * second.distance]
            own_px = cv2.KeyPoint.convert(keypoints)[[each.queryIdx for each in kept]]
            there_px = ground_px[[each.trainIdx for each in kept]]
            found, agree = cv2.estimateAffinePartial2D(own_px, there_px, ransacReprojThreshold=4.0)
            if found is not None and np.count_nonzero(agree) >= _MIN_MATCHES:
                place_px = found @ [*middle_px, 1.0]
                yield index, *place_px, *(site.enu_jacobian(place_px) @ -found[:, 1])
        index += 1


def smoothed(found: Array) -> Array:
    """Places (N, 5) without those far from their neighbours' median, interpolated to every fifth frame."""

    def over(values: Array, count: int) -> Array:
        return sliding_window_view(np.pad(values, ((count // 2,) * 2, (0, 0)), mode="edge"), count, axis=0)

    usual_px = np.median(over(found[:, 1:3], _NEIGHBOURS), axis=-1)
    kept = found[np.hypot(*(found[:, 1:3] - usual_px).T) < _APART_PX]
    frames = np.arange(kept[0, 0], kept[-1, 0] + 1.0, EVERY)
    even = np.column_stack([np.interp(frames, kept[:, 0], column) for column in kept[:, 1:].T])
    return np.column_stack([frames, over(even, _SMOOTH).mean(axis=-1)])


SAMPLES = {"park": (park, "model.laz"), "campus": (campus, "SIFT-based/our_data.mp4")}
"""Each sample's maker, and a file of its repository."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=SAMPLES)
    parser.add_argument("root", type=Path, metavar="CLONE")
    parser.add_argument("--out", type=Path, required=True, metavar="FLIGHT")
    given = parser.parse_args()
    make, needed = SAMPLES[given.name]
    if not (given.root / needed).is_file():
        raise SystemExit(f"root: expected a clone with {needed}, got {given.root}")
    with new_folder(given.out):
        count = make(given.root, given.out)
    print(f"{given.out}: {count} pictures")


if __name__ == "__main__":
    main()
