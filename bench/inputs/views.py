"""Pairs of one picture seen twice: drone pictures warped by known homographies, in another light.

The pictures are of the built-in town and, where they are there, of the shared flights.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from bench import SHARED
from bench.accuracy.quality import Array, Gray, ViewPair
from bench.inputs.scenes import mosaic
from engine import Frame
from engine.matching.align import to_gray
from scenematch.files.flight import Flight, open_flight

Size = tuple[int, int]

FRAMES = {"gazebo-a1": "frames", "gazebo-a2": "frames", "nust": "flight.mp4", "caliterra": "frames"}
TURN_DEG, SCALES, TILT_DEG, VIEW_DEG = 180.0, (0.7, 1.4), 8.0, 60.0
NOISE_SD = 2.0  # grey levels


@cache
def warped_pairs(size: Size, count: int) -> list[ViewPair]:
    """At least ``count`` pairs of pictures (width, height), shared evenly among the sources."""
    rng = np.random.default_rng(size[0])
    sources = {name: _usable(grays, size) for name, grays in _sources(size).items()}
    sources = {name: grays for name, grays in sources.items() if grays}
    share = -(-count // len(sources))
    return [
        _warped(name, grays[i * len(grays) // share], size, rng)
        for name, grays in sources.items()
        for i in range(share)
    ]


def open_shared(name: str) -> Flight:
    """One of the shared flights."""
    return open_flight(SHARED / name / FRAMES[name], SHARED / name / "telemetry.csv")


def _sources(size: Size) -> dict[str, list[Gray]]:
    side = int(np.hypot(*size) / SCALES[0]) + 2
    town = mosaic(2000)
    cuts = [np.ascontiguousarray(town[y : y + side, x : x + side]) for x, y in ((0, 0), (400, 600), (800, 300))]
    found = {"town": cuts}
    for name in FRAMES:
        if (SHARED / name).is_dir():
            found[name] = _frames(name)
    return found


@cache
def _frames(name: str, count: int = 8) -> list[Gray]:
    flown = open_shared(name)
    middle = flown.names[len(flown) // 10 :: len(flown) // count][:count]
    return [to_gray(Frame(flown.source.read(frame))) for frame in middle]


def _usable(grays: list[Gray], size: Size) -> list[Gray]:
    """The pictures, reduced as far as a turned and smaller view of them still fills ``size``."""
    diagonal, out = float(np.hypot(*size)), []
    for gray in grays:
        if diagonal <= min(gray.shape):
            factor = min(1.0, (diagonal / SCALES[0] + 1) / min(gray.shape))
            out.append(np.asarray(cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)))
    return out


def _warped(name: str, source: Gray, size: Size, rng: np.random.Generator) -> ViewPair:
    """A cut of the source, and the same ground turned, scaled, tilted, and in another light."""
    width, height = size
    corner = (np.array(source.shape[::-1]) - size) // 2
    first = source[corner[1] : corner[1] + height, corner[0] : corner[0] + width]
    least = max(SCALES[0], float(np.hypot(*size)) / min(source.shape))
    scale = float(np.exp(rng.uniform(np.log(least), np.log(SCALES[1]))))
    source_from_second = _translation(corner + (np.array(size) - 1) / 2) @ _turn_and_tilt(size, scale, rng)
    blurred = cv2.GaussianBlur(source, (0, 0), 0.5 * np.sqrt(1 / scale**2 - 1)) if scale < 0.95 else source
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    second = cv2.warpPerspective(blurred, source_from_second, size, flags=flags, borderMode=cv2.BORDER_REFLECT)
    homography = _translation(-corner) @ source_from_second
    return ViewPair(name, _noisy(first, rng), _relit(np.asarray(second), rng), by_homography(homography))


def _turn_and_tilt(size: Size, scale: float, rng: np.random.Generator) -> Array:
    """(3, 3) from pixels of the view to places about the middle that it looks at."""
    focal = size[0] / 2 / np.tan(np.radians(VIEW_DEG / 2))
    camera = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    tilt = np.radians(rng.uniform(0, TILT_DEG)) * _direction(rng)
    seen = np.diag([focal, focal, 1]) @ cv2.Rodrigues(np.array([*tilt, 0.0]))[0] @ np.linalg.inv(camera)
    middle = seen @ [*camera[:2, 2], 1.0]
    turn = np.radians(rng.uniform(-TURN_DEG, TURN_DEG))
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, scale]])
    return np.asarray(turned @ _translation(-middle[:2] / middle[2]) @ seen)


def _direction(rng: np.random.Generator) -> Array:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _noisy(picture: NDArray[np.generic], rng: np.random.Generator, sd: float = NOISE_SD) -> Gray:
    return np.clip(np.rint(picture + rng.normal(0.0, sd, picture.shape)), 0, 255).astype(np.uint8)


def _relit(picture: Gray, rng: np.random.Generator) -> Gray:
    """Another gamma, exposure, focus and noise."""
    levels = 255.0 * rng.uniform(0.85, 1.15) * (picture / 255.0) ** rng.uniform(0.75, 1.33)
    sharpness = rng.uniform(0.0, 1.0)
    blurred = cv2.GaussianBlur(levels, (0, 0), sharpness) if sharpness > 0.2 else levels
    return _noisy(np.asarray(blurred), rng, rng.uniform(1.0, 2.0) * NOISE_SD)


def _translation(by: Array) -> Array:
    return np.array([[1.0, 0, by[0]], [0, 1.0, by[1]], [0, 0, 1.0]])


def by_homography(homography: Array) -> Callable[[Array], Array]:
    """The map of pixels (N, 2) that a homography (3, 3) is."""

    def first_from_second(xy_px: Array) -> Array:
        moved = np.c_[xy_px, np.ones(len(xy_px))] @ homography.T
        return np.asarray(moved[:, :2] / moved[:, 2:])

    return first_from_second
