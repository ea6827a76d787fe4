"""Matches with a known pose and matches with none, drawn, and what the solver makes of many of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from engine import Camera
from engine.matching.pose import AttitudePrior, solve_pose

Array = NDArray[np.float64]
Matches = tuple[Array, Array]  # (N, 3) metres, (N, 2) pixels

SIZE_PX = 300
CAMERA = Camera(SIZE_PX, SIZE_PX, np.array([[259.8, 0, 149.5], [0, 259.8, 149.5], [0, 0, 1]]))
CHI2_3_SIGMA = float(chi2.ppf(norm.cdf(3) - norm.cdf(-3), 3))  # three degrees of freedom, 99.73 %
GROUNDS = ("planar nadir", "tilted", "high relief", "distorted")


@dataclass(frozen=True)
class Scene:
    """Matches of a camera whose pose is known; some of them are wrong."""

    points_m: Array
    points_px: Array
    rotation: Array
    center_m: Array
    prior: AttitudePrior | None


def scene(rng: np.random.Generator, ground: str, *, with_prior: bool) -> Scene:
    """A camera 60 to 300 m up, 15 to 300 matches, noise of 0.3 to 1 px, up to 60 % of them wrong."""
    height_m, count = rng.uniform(60, 300), int(rng.integers(15, 301))
    noise_px, wrong = rng.uniform(0.3, 1.0), rng.uniform(0, 0.6)
    tilt_deg = rng.uniform(10, 30) if ground == "tilted" else rng.uniform(0, 3)
    rotation = attitude(rng, tilt_deg)
    center = np.array([*rng.uniform(-50, 50, 2), height_m])
    pixels = rng.uniform(0, SIZE_PX - 1, (count, 2))
    rays = np.c_[pixels, np.ones(count)] @ np.linalg.inv(CAMERA.matrix).T @ rotation
    heights = np.zeros(count)
    if ground == "high relief":  # streets, and roofs up to 40 m
        heights = np.where(rng.random(count) < 0.5, rng.uniform(5, 40, count), 0.0)
    points = center + rays * ((heights - height_m) / rays[:, 2])[:, None]
    noise = rng.normal(0, noise_px, pixels.shape)
    pixels = through_the_lens(pixels, noise) if ground == "distorted" else pixels + noise
    astray = rng.random(count) < wrong
    pixels[astray] = rng.uniform(0, SIZE_PX - 1, (int(astray.sum()), 2))
    return Scene(points, pixels, rotation, center, measured(rng, rotation) if with_prior else None)


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


@cache
def _lens() -> tuple[Camera, Array]:
    """A camera with barrel distortion, and where each pixel of its undistorted picture comes from, (H, W, 2)."""
    camera = Camera(SIZE_PX, SIZE_PX, CAMERA.matrix, distortion=np.array([-0.25, 0.08, 1e-3, -5e-4, -0.01]))
    maps = cv2.convertMaps(*camera._undistort_maps, cv2.CV_32FC1)
    return camera, np.stack(maps[:2], axis=-1).astype(np.float64)


def through_the_lens(pixels: Array, noise: Array) -> Array:
    """Ideal pixels as the lens shows them, plus noise, and as the matcher's undistorted picture shows those.

    The way out is OpenCV's formula, the way back the lookup by which :class:`Camera` undistorts a frame.
    """
    camera, source = _lens()
    rays = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(camera.matrix).T
    seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0][:, 0] + noise
    found = pixels.copy()
    for _ in range(8):  # source(found) = seen, the lookup read between its pixels
        low = np.clip(np.floor(found).astype(int), 0, SIZE_PX - 2)
        fx, fy = (found - low).T[:, :, None]
        x, y = low.T
        top = source[y, x] * (1 - fx) + source[y, x + 1] * fx
        bottom = source[y + 1, x] * (1 - fx) + source[y + 1, x + 1] * fx
        found += seen - (top * (1 - fy) + bottom * fy)
    return found


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
    jitter = rng.normal(0, rng.uniform(0, 1.5), (len(index), 2))
    return points[index], pixels[index] + jitter


def _one_to_many(rng: np.random.Generator) -> Matches:
    """A few map points that many points of the frame take for theirs."""
    count = int(rng.integers(10, 150))
    return _map_points(rng, max(count // 6, 3), 20.0)[rng.integers(0, max(count // 6, 3), count)], _image_points(
        rng, count
    )


def _many_to_one(rng: np.random.Generator) -> Matches:
    """A few points of the frame, each matched to many of the map."""
    count = int(rng.integers(10, 150))
    pixels = _image_points(rng, max(count // 6, 3))[rng.integers(0, max(count // 6, 3), count)]
    return _map_points(rng, count, 20.0), pixels


def _permuted(rng: np.random.Generator) -> Matches:
    """The right points of both, in the wrong pairs."""
    points, pixels = _seen(rng, _map_points(rng, int(rng.integers(10, 200)), rng.choice([0.0, 30.0])))
    return points, rng.permutation(pixels)


def _periodic(rng: np.random.Generator) -> Matches:
    """Equal cells: each point of the frame's grid is matched to any point of a grid of another period."""
    count, period_px = int(rng.integers(20, 200)), rng.uniform(12, 50)
    period_m = rng.uniform(0.6, 1.7) * period_px * 200 / SIZE_PX
    cells = rng.integers(0, int(SIZE_PX / period_px) + 1, (count, 2)) * period_px
    on_map = rng.integers(0, int(200 / period_m) + 1, (count, 2)) * period_m - 100
    jitter = rng.uniform(0, 1)
    return np.c_[on_map + rng.normal(0, 0.7 * jitter, (count, 2)), np.zeros(count)], cells + rng.normal(
        0, jitter, (count, 2)
    )


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


def _seen(rng: np.random.Generator, points: Array) -> Matches:
    """Those of the map points that a camera 150 m up sees, and where."""
    rotation = attitude(rng, rng.uniform(0, 10))
    x = (points - [0, 0, 150.0]) @ rotation.T
    pixels = (x @ CAMERA.matrix.T)[:, :2] / x[:, 2:]
    inside = ((pixels >= 0) & (pixels <= SIZE_PX - 1)).all(axis=1)
    return points[inside], pixels[inside]


WRONG: dict[str, Callable[[np.random.Generator], Matches]] = {
    "plane": _anywhere(10, 150, 0.0), "relief": _anywhere(10, 150, 40.0), "4 to 10": _anywhere(4, 11, 0.0, 40.0),
    "200 to 300": _anywhere(200, 301, 0.0, 40.0), "clustered": _clustered,
    "on a road": _line, "repeated": _repeated, "one to many": _one_to_many, "many to one": _many_to_one,
    "permuted": _permuted, "another period": _periodic, "a false cluster": _false_cluster,
}  # fmt: skip
"""Ways to draw matches that no pose explains."""


# ------------------------------------------------------------------------------------------- many of them


@dataclass(frozen=True)
class Coverage:
    """How errors lie within their covariance, over the frames that gave a pose."""

    cases: int
    accepted: int
    off: int  # accepted more than 10 m and 3 sigma off
    within: float  # share within 3 sigma in the sense of Mahalanobis, of the centre
    within_axis: float  # the same, the worst of east, north and up
    nees: float  # mean; 3 is consistent
    within_turn: float  # of the attitude
    nees_turn: float


def accepted(kind: str, sets: int, seed: int) -> int:
    """How many sets of wrong matches gave a pose; every other one comes with telemetry."""
    rng, count = np.random.default_rng([seed, list(WRONG).index(kind)]), 0
    for i in range(sets):
        points, pixels = WRONG[kind](rng)
        prior = measured(rng, attitude(rng, rng.uniform(0, 10))) if i % 2 else None
        count += solve_pose(points, pixels, CAMERA.matrix, prior=prior) is not None
    return count


def coverage(ground: str, with_prior: bool, cases: int, seed: int) -> Coverage:
    """Errors of many simulated frames against their own covariance."""
    rng, rows = np.random.default_rng([seed, GROUNDS.index(ground), with_prior]), []
    for _ in range(cases):
        s = scene(rng, ground, with_prior=with_prior)
        pose = solve_pose(s.points_m, s.points_px, CAMERA.matrix, prior=s.prior)
        if pose is None:
            continue
        error = pose.center_m - s.center_m
        turn = cv2.Rodrigues(s.rotation @ pose.rotation.T)[0][:, 0]
        within = np.abs(error) < 3 * np.sqrt(np.diag(pose.covariance_center_m2))
        nees = error @ np.linalg.solve(pose.covariance_center_m2, error)
        off = nees > CHI2_3_SIGMA and np.linalg.norm(error) > 10
        rows.append([nees, turn @ np.linalg.solve(pose.covariance[3:, 3:], turn), off, *within])
    table = np.array(rows, dtype=float)
    return Coverage(
        cases=cases,
        accepted=len(table),
        off=int(table[:, 2].sum()),
        within=float(np.mean(table[:, 0] < CHI2_3_SIGMA)),
        within_axis=float(table[:, 3:].mean(axis=0).min()),
        nees=float(table[:, 0].mean()),
        within_turn=float(np.mean(table[:, 1] < CHI2_3_SIGMA)),
        nees_turn=float(table[:, 1].mean()),
    )
