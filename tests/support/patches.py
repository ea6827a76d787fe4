"""A world of one bright patch on a dark box: where its pixels must lie in a picture is known by other means."""

import numpy as np

from engine import Attitude, Camera
from engine.geo import LocalFrame, enu_from_body
from scenematch.simulator import World
from scenematch.simulator.render import transformer

EPSG = 32633
GSD = 0.25
SIZE = 1200
CAMERA = Camera.from_fov(300, 300, 60.0)
ORIGIN = transformer(EPSG).transform(16.45, 48.25)
CONVERGENCE = np.radians(1.08)  # east of the central meridian true north leans to the left of grid north
TO_GRID = np.array([[np.cos(CONVERGENCE), -np.sin(CONVERGENCE)], [np.sin(CONVERGENCE), np.cos(CONVERGENCE)]])
TO_CRS = np.array([[GSD, 0.0, ORIGIN[0] - SIZE / 2 * GSD], [0.0, -GSD, ORIGIN[1] + SIZE / 2 * GSD]])


def patch_world(x: int, y: int, height: float) -> World:
    """Dark flat ground, a dark box of 60 px, and a bright patch of 17 px in the middle of its roof."""
    rgb = np.full((SIZE, SIZE, 3), 40, np.uint8)
    heights = np.zeros((SIZE, SIZE), np.float32)
    heights[y - 30 : y + 31, x - 30 : x + 31] = height
    rgb[y - 8 : y + 9, x - 8 : x + 9] = 240
    return World(rgb, np.full((SIZE, SIZE, 4), (90, 60, 60, 0), np.uint8), heights, TO_CRS, EPSG)


def project(camera: Camera, grid: np.ndarray, up: float, position: np.ndarray, height: float, attitude: Attitude):
    """Pixel of a world point by way of latitude and longitude: shares no line with the renderer."""
    lon, lat = transformer(EPSG).transform([grid[0], position[0]], [grid[1], position[1]], direction="INVERSE")
    point, own = LocalFrame(48.25, 16.45).enu_from_geodetic(lat, lon)
    enu_from_cam = enu_from_body(attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg) @ camera.mount
    x, y, z = camera.matrix @ enu_from_cam.T @ np.array([*(point - own), up - height])
    return np.array([x / z, y / z])


def centre_of_bright(image: np.ndarray) -> np.ndarray:
    weight = np.clip(image[..., 1].astype(float) - 100.0, 0.0, None)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
