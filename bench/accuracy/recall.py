"""Right matches of those found, SIFT by OpenCV and by both backends: real pictures under known turns and scales.

    python -m bench.accuracy.recall [--keypoints 150 300 1000] [--data DIR]

Each picture is matched against itself turned and scaled about its middle. A match is right within 3 px. The error
is the median distance of the right ones, the time that of one picture on one thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import rasterio
from rasterio.windows import Window

from bench import SHARED
from bench.accuracy.quality import Gray, Keypoints, Quality, ViewPair, judge
from bench.command import parser_on_one_thread
from bench.inputs.views import by_homography
from bench.pages.text import table
from bench.speed.detectors import keypoints_of_features, keypoints_of_opencv, picture_tensor
from engine import Frame
from engine.features import sift
from engine.matching.align import to_gray
from scenematch.files.flight import open_flight

FLIGHTS = {"gazebo-a1": 4, "nust": 4, "seneca": 3, "brighton": 3, "caliterra": 3}
PATCHES = 3  # of the NAIP
SIDE_PX = 640
WARPS = ((25.0, 1.15), (-70.0, 0.8))  # degrees, scale
Detect = Callable[[Gray, int], Keypoints]


def pictures(data: Path) -> Iterator[tuple[str, Gray]]:
    """Twenty pictures of every source that is there, at most 640 px wide."""
    for name, count in FLIGHTS.items():
        if (data / name).is_dir():
            frames = data / name / ("flight.mp4" if name == "nust" else "frames")
            flight = open_flight(frames, data / name / "telemetry.csv")
            for frame in flight.names[len(flight) // 8 :: max(1, len(flight) // (count + 1))][:count]:
                gray = to_gray(Frame(flight.source.read(frame)))
                factor = min(1.0, SIDE_PX / max(gray.shape))
                yield name, np.asarray(cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))
    for path in sorted((data / "naip").glob("*.tif"))[:: 8 // PATCHES][:PATCHES]:
        with rasterio.open(path) as file:
            part = Window(file.width // 2, file.height // 2, SIDE_PX, SIDE_PX)
            yield "naip", to_gray(Frame(np.moveaxis(file.read((1, 2, 3), window=part), 0, 2).copy()))


def warped(name: str, gray: Gray, turn_deg: float, scale: float) -> ViewPair:
    """A picture, and the same turned and scaled about its middle."""
    height, width = gray.shape
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), turn_deg, scale)
    blurred = cv2.GaussianBlur(gray, (0, 0), 0.5 * np.sqrt(1 / scale**2 - 1)) if scale < 1.0 else gray
    second = cv2.warpAffine(blurred, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    back = np.vstack([cv2.invertAffineTransform(matrix), [0.0, 0.0, 1.0]])
    return ViewPair(name, gray, np.asarray(second), by_homography(back))


def by_opencv(gray: Gray, count: int) -> Keypoints:
    """OpenCV at our threshold of contrast."""
    detector = cv2.SIFT_create(nfeatures=count, contrastThreshold=0.02)
    return keypoints_of_opencv(detector.detectAndCompute(gray, None), count)


def by_engine(gray: Gray, count: int, backend: str, spread: int = 6) -> Keypoints:
    """The engine's, by one of its backends."""
    return keypoints_of_features(sift(picture_tensor([gray]), max_keypoints=count, backend=backend, spread=spread))


DETECTORS: dict[str, Detect] = {
    "OpenCV": by_opencv,
    "compiled": partial(by_engine, backend="compiled"),
    "compiled, not spread": partial(by_engine, backend="compiled", spread=1),
    "kornia": partial(by_engine, backend="kornia"),
}


def measured(detect: Detect, count: int, pairs: list[ViewPair]) -> tuple[list[Quality], float]:
    """The quality of every pair, and the median time in ms."""
    detect(pairs[0].first, count)
    found, times = [], []
    for pair in pairs:
        start = time.perf_counter()
        first = detect(pair.first, count)
        times.append(time.perf_counter() - start)
        found.append(judge(first, detect(pair.second, count), pair))
    return found, 1000.0 * float(np.median(times))


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--keypoints", type=int, nargs="+", default=[150, 300, 1000])
    parser.add_argument("--data", type=Path, default=SHARED)
    options = parser.parse_args(arguments)
    pairs = [warped(*picture, *warp) for picture in pictures(options.data) for warp in WARPS]
    sources = list(dict.fromkeys(pair.source for pair in pairs))
    rows = []
    for count in options.keypoints:
        for name, detect in DETECTORS.items():
            found, ms = measured(detect, count, pairs)
            right = [quality.correct for quality in found]
            total = [quality.correct / max(quality.inlier_ratio, 1e-9) for quality in found]
            error = np.nanmedian([quality.error_px for quality in found])
            by = [np.mean([r for r, pair in zip(right, pairs, strict=True) if pair.source == s]) for s in sources]
            of_found = f"{np.mean(right):.1f} of {np.mean(total):.1f}"
            rows.append([str(count), name, of_found, f"{error:.3f}", f"{ms:.0f}", *(f"{n:.0f}" for n in by)])
    print("\n".join(table(["keypoints", "detector", "right of found", "error px", "ms", *sources], rows)))


if __name__ == "__main__":
    main()
