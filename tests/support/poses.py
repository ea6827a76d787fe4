"""Matches with a known pose and matches with none, drawn."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from engine import Camera
from engine.matching.pose import AttitudePrior

Array = NDArray[np.float64]
Matches = tuple[Array, Array]  # (N, 3) metres, (N, 2) pixels

SIZE_PX = 300
CAMERA = Camera(SIZE_PX, SIZE_PX, np.array([[259.8, 0, 149.5], [0, 259.8, 149.5], [0, 0, 1]]))
GROUNDS = ("planar nadir", "tilted", "high relief", "distorted")


@dataclass
class Scene:
    """Matches of a camera whose pose is known; some of them are wrong."""

    points_m: Array
    points_px: Array
    rotation: Array
    center_m: Array
    wrong: NDArray[np.bool_]


def scene(
    rng: np.random.Generator, count: int = 60, *, noise_px: float = 0.0, wrong: float = 0.0, relief_m: float = 0.0,
    tilt_deg: float = 3.0, height_m: float = 150.0, matrix: Array = CAMERA.matrix, is_distorted: bool = False,
) -> Scene:  # fmt: skip
    """Points all over the image of a camera that is tilted to any side, half of them on the ground.

    Args:
        rng: what it is drawn with.
        count: of matches.
        noise_px: of a pixel.
        wrong: share of the matches that point anywhere.
        relief_m: height of the highest roofs.
        tilt_deg: off the vertical.
        height_m: above the ground.
        matrix: of the camera.
        is_distorted: whether the pixels went through a lens and back.
    """
    rotation, center = attitude(rng, tilt_deg), np.array([*rng.uniform(-50, 50, 2), height_m])
    pixels = _image_points(rng, count)
    rays = np.c_[pixels, np.ones(count)] @ np.linalg.inv(matrix).T @ rotation
    heights = np.where(rng.random(count) < 0.5, rng.uniform(0, relief_m, count), 0.0)
    points = center + rays * ((heights - height_m) / rays[:, 2])[:, None]
    noise = rng.normal(0, noise_px, pixels.shape)
    pixels = through_the_lens(pixels, noise) if is_distorted else pixels + noise
    astray = rng.permutation(count) < round(wrong * count)
    pixels[astray] = _image_points(rng, int(astray.sum()))
    return Scene(points, pixels, rotation, center, astray)


def any_scene(rng: np.random.Generator, ground: str) -> Scene:
    """A camera 60 to 300 m up, 15 to 300 matches, noise of 0.3 to 1 px, up to 60 % of them wrong."""
    count, noise_px, wrong = int(rng.integers(15, 301)), rng.uniform(0.3, 1.0), rng.uniform(0, 0.6)
    tilt_deg = rng.uniform(10, 30) if ground == "tilted" else rng.uniform(0, 3)
    view = {"tilt_deg": tilt_deg, "height_m": rng.uniform(60, 300), "is_distorted": ground == "distorted"}
    relief_m = 40.0 if ground == "high relief" else 0.0
    return scene(rng, count, noise_px=noise_px, wrong=wrong, relief_m=relief_m, **view)


def attitude(rng: np.random.Generator, tilt_deg: float) -> Array:
    """(3, 3) cam_from_map of a camera at any heading, that far off the vertical in any direction."""
    around, heading = rng.uniform(0, math.tau, 2)
    tilt = math.radians(tilt_deg) * np.array([math.cos(around), math.sin(around), 0.0])
    level = np.diag([1.0, -1.0, -1.0]) @ cv2.Rodrigues(np.array([0.0, 0.0, heading]))[0]
    return np.asarray(cv2.Rodrigues(tilt)[0] @ level)


def measured(rng: np.random.Generator, rotation: Array) -> AttitudePrior:
    """Telemetry whose errors are as large as it says."""
    tilt_deg, heading_deg = rng.uniform(0.1, 2.0, 2)
    sigma_deg = (tilt_deg, tilt_deg, heading_deg)
    error = np.deg2rad(rng.normal(0, sigma_deg))
    return AttitudePrior(np.asarray(cv2.Rodrigues(error)[0] @ rotation), sigma_deg)


def through_the_lens(pixels: Array, noise: Array) -> Array:
    """Ideal pixels as a lens with barrel distortion shows them, plus noise, and as OpenCV undistorts those."""
    distortion = np.array([-0.25, 0.08, 1e-3, -5e-4, -0.01])
    rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(CAMERA.matrix).T
    seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), CAMERA.matrix, distortion)[0] + noise[:, None]
    return np.asarray(cv2.undistortPoints(seen, CAMERA.matrix, distortion, P=CAMERA.matrix)[:, 0])


# ------------------------------------------------------------------------------------------ nothing to be found


def _map_points(rng: np.random.Generator, count: int, relief_m: float = 0.0) -> Array:
    return np.c_[rng.uniform(-100, 100, (count, 2)), rng.uniform(0, 1, count) * relief_m]


def _image_points(rng: np.random.Generator, count: int) -> Array:
    return rng.uniform(0, SIZE_PX - 1, (count, 2))


def _anywhere(fewest: int, most: int, *reliefs_m: float) -> Callable[[np.random.Generator], Matches]:
    def draw(rng: np.random.Generator) -> Matches:
        count = int(rng.integers(fewest, most))
        return _map_points(rng, count, rng.choice(reliefs_m)), _image_points(rng, count)

    return draw


def _clustered(rng: np.random.Generator) -> Matches:
    """Crowded around a few places of the frame and of the map, as texture is."""
    count, places = int(rng.integers(10, 150)), int(rng.integers(1, 6))
    at = rng.integers(0, places, count), rng.integers(0, places, count)
    on_map = _map_points(rng, places)[at[0]] + np.c_[rng.normal(0, 6, (count, 2)), np.zeros(count)]
    return on_map, _image_points(rng, places)[at[1]] + rng.normal(0, 8, (count, 2))


def _line(rng: np.random.Generator) -> Matches:
    """Along a road of the map and a road of the frame, a few pixels wide."""
    count = int(rng.integers(10, 150))
    along, width = rng.uniform(-100, 100, count), rng.uniform(0, 5)
    points = np.c_[along, 0.3 * along + rng.normal(0, width, count), np.zeros(count)]
    column = rng.uniform(0, SIZE_PX - 1, count)
    return points, np.c_[column, 200 - 0.5 * column + rng.normal(0, width, count)]


def _repeated(rng: np.random.Generator) -> Matches:
    """A few matches, each found again and again within a pixel or two."""
    points, pixels = _anywhere(4, 11, 0.0, 40.0)(rng)
    index = rng.integers(0, len(points), int(rng.integers(20, 150)))
    return points[index], pixels[index] + rng.normal(0, rng.uniform(0, 1.5), (len(index), 2))


def _shared(of: str) -> Callable[[np.random.Generator], Matches]:
    """A few points of the map, or of the frame, are each matched to many of the other."""

    def draw(rng: np.random.Generator) -> Matches:
        count = int(rng.integers(10, 150))
        few = rng.integers(0, max(count // 6, 3), count)
        points, pixels = _map_points(rng, count, 20.0), _image_points(rng, count)
        return (points[few], pixels) if of == "map" else (points, pixels[few])

    return draw


def _periodic(rng: np.random.Generator) -> Matches:
    """Equal cells: each point of the frame's grid is matched to any point of a grid of another period."""
    count, period_px = int(rng.integers(20, 200)), rng.uniform(12, 50)
    period_m = rng.uniform(0.6, 1.7) * period_px * 200 / SIZE_PX
    cells = rng.integers(0, int(SIZE_PX / period_px) + 1, (count, 2)) * period_px
    on_map = rng.integers(0, int(200 / period_m) + 1, (count, 2)) * period_m - 100
    jitter = rng.uniform(0, 1)
    on_map = on_map + rng.normal(0, 0.7 * jitter, (count, 2))
    return np.c_[on_map, np.zeros(count)], cells + rng.normal(0, jitter, (count, 2))


def _false_cluster(rng: np.random.Generator) -> Matches:
    """One small thing is found whole, elsewhere (two equal cars), among matches that point anywhere."""
    points, pixels = _anywhere(10, 150, 0.0)(rng)
    count = int(rng.integers(3, 13))
    around, turn = rng.uniform(-8, 8, (count, 2)), rng.uniform(0, math.tau)
    spin = np.array([[math.cos(turn), math.sin(turn)], [math.sin(turn), -math.cos(turn)]])
    place = rng.uniform(10, SIZE_PX - 10, 2), rng.uniform(-90, 90, 2)
    on_map = place[1] + 0.6 * around @ spin
    noisy = place[0] + around + rng.normal(0, 0.4, around.shape)
    return np.r_[points, np.c_[on_map, np.zeros(count)]], np.r_[pixels, noisy]


WRONG: dict[str, Callable[[np.random.Generator], Matches]] = {
    "plane": _anywhere(10, 150, 0.0), "relief": _anywhere(10, 150, 40.0), "4 to 10": _anywhere(4, 11, 0.0, 40.0),
    "200 to 300": _anywhere(200, 301, 0.0, 40.0), "clustered": _clustered,
    "on a road": _line, "repeated": _repeated, "one to many": _shared("map"), "many to one": _shared("frame"),
    "another period": _periodic, "a false cluster": _false_cluster,
}  # fmt: skip
"""Ways to draw matches that no pose explains."""
