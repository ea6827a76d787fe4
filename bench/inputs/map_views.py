"""Pairs of a frame and the piece of map that it shows; the geometry comes from poses, never from features.

The built-in flight and the recorded towns have exact poses and surface models. The photographs of ``caliterra``
have positions alone: their homographies onto the map are aligned by intensities (ECC).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from bench import SHARED
from bench.accuracy.quality import Array, Gray, ViewPair
from bench.inputs.scenes import flight
from bench.inputs.views import Size, by_homography, open_shared
from engine import Camera, Frame, OrthoMap
from engine.matching.align import to_gray, view_of
from engine.values import Attitude, Truth, Window
from engine.window import level_for
from scenematch.files.telemetry import ground_amsl_m
from scenematch.files.truth import interpolate_truth, read_truth

ALIGNED = 0.75  # least correlation at which a photograph counts as aligned with its map
_PHOTOGRAPHS = "caliterra"


@dataclass(frozen=True)
class Photo:
    """An undistorted frame with its pose: east, north and up of the camera, and its attitude."""

    gray: Gray
    center_m: Array
    attitude: Attitude


@cache
def map_pairs(size: Size, count: int) -> list[ViewPair]:
    """About ``count`` pairs of pictures (width, height), shared among the flights with frames that large."""
    there = ["town", *(n for n in ("gazebo-a1", "gazebo-a2", _PHOTOGRAPHS) if (SHARED / n).is_dir())]
    names, found = [name for name in there if _camera(name).width_px >= size[0]], []
    for name in names:
        site, camera, photos = _flown(name, -(-count // len(names)))
        pairs = (_pair(name, site, camera, photo, size) for photo in photos)
        found += [_aligned(p) if name == _PHOTOGRAPHS else p for p in pairs if p is not None]
    return [pair for pair in found if pair is not None]


def _camera(name: str) -> Camera:
    return flight().camera if name == "town" else Camera.load(SHARED / name / "camera.yaml")


@cache
def _flown(name: str, count: int) -> tuple[OrthoMap, Camera, list[Photo]]:
    """Map, camera and ``count`` frames spread over a flight."""
    if name == "town":
        scene = flight()
        chosen = range(0, len(scene.frames), max(1, len(scene.frames) // count))
        poses = [(scene.frames[i], scene.truth[i], scene.truth[i].height_agl_m or 0.0) for i in chosen[:count]]
        return scene.site, scene.camera, [_photo(scene.site, scene.camera, *pose) for pose in poses]
    folder, flown = SHARED / name, open_shared(name)
    camera, truth = _camera(name), read_truth(folder / "truth.csv")
    upright = folder / "map_ortho.tif"  # here roofs do not lean, and the surface model says where they are
    site = OrthoMap.open(upright if upright.exists() else folder / "map.tif", surface=folder / "dsm.tif")
    photos = []
    for row in flown.rows[:: max(1, len(flown) // count)][:count]:
        true = interpolate_truth(truth, row.timestamp_ns)
        if true is not None:
            angles_deg = (row.heading_deg, row.roll_deg, row.pitch_deg)
            frame = Frame(flown.source.read(row.frame), row.timestamp_ns, None, *angles_deg)
            photos.append(_photo(site, camera, frame, true, _up_m(site, true, ground_amsl_m(flown.rows))))
    return site, camera, photos


def _up_m(site: OrthoMap, truth: Truth, ground_amsl: float | None) -> float:
    """Height in the surface model's datum, which is 0 at the ground that ``ground_amsl`` is the level of."""
    if truth.alt_amsl_m is not None and ground_amsl is not None:
        return truth.alt_amsl_m - ground_amsl
    return site.ground_m + (truth.height_agl_m or 0.0)


def _photo(site: OrthoMap, camera: Camera, frame: Frame, truth: Truth, up_m: float) -> Photo:
    """The frame at its true place; angles that truth does not know come from the telemetry."""
    known_attitude = frame.attitude or Attitude(0.0, 0.0, 0.0)
    known = {name: getattr(truth, name) for name in ("roll_deg", "pitch_deg", "heading_deg")}
    attitude = replace(known_attitude, **{name: value for name, value in known.items() if value is not None})
    east, north = site.frame.enu_from_geodetic(truth.lat_deg, truth.lon_deg)
    return Photo(camera.undistort(to_gray(frame)), np.array([east, north, up_m]), attitude)


def _pair(name: str, site: OrthoMap, camera: Camera, photo: Photo, size: Size) -> ViewPair | None:
    """The frame reduced to ``size``, and as many pixels of the map about the middle of its view.

    None where the view leaves the map.
    """
    width, height = size
    reduced = max(width / camera.width_px, height / camera.height_px)
    nadir = site.pixel_from_enu(photo.center_m[:2])
    above_m = float(photo.center_m[2]) - site.ground_m
    view = view_of(camera, photo.attitude, above_m, site.enu_jacobian(nadir))
    level = level_for(site.gsd_m_per_px, above_m / (camera.focal_px * reduced), site.levels)
    if view is None:
        return None
    corner = np.rint(site.level_from_full(nadir + view.center_px, level) - np.array(size) / 2.0).astype(int)
    rows, columns = site.level_shape(level)
    if (corner < 0).any() or corner[0] + width > columns or corner[1] + height > rows:
        return None
    window = Window(int(corner[0]), int(corner[1]), width, height)
    if not site.valid(window, level).all():
        return None
    turn = camera.enu_from_camera(photo.attitude).T
    picture = cv2.resize(photo.gray, None, fx=reduced, fy=reduced, interpolation=cv2.INTER_AREA)
    cut = (np.array(picture.shape[::-1]) - size) // 2

    def first_from_second(xy_px: Array) -> Array:
        map_px = site.full_from_level(xy_px + corner, level)
        seen = (site.surface_points(map_px) - photo.center_m) @ turn.T @ camera.matrix.T
        return np.asarray((seen[:, :2] / seen[:, 2:] + 0.5) * reduced - 0.5 - cut)

    first = np.ascontiguousarray(picture[cut[1] : cut[1] + height, cut[0] : cut[0] + width])
    return ViewPair(f"{name} on map", first, site.gray(window, level), first_from_second)


def _aligned(pair: ViewPair) -> ViewPair | None:
    """The pair with the homography that maximises the correlation of its intensities, coarse to fine."""
    height, width = pair.second.shape
    grid = np.stack(np.meshgrid(np.linspace(0, width, 5), np.linspace(0, height, 5)), axis=-1).reshape(-1, 2)
    homography = np.asarray(cv2.findHomography(grid, pair.first_from_second(grid))[0])
    score = 0.0
    for factor in (8, 4, 2, 1):
        if min(height, width) // factor < 32:
            continue
        small = np.array([[1 / factor, 0, 0.5 / factor - 0.5], [0, 1 / factor, 0.5 / factor - 0.5], [0, 0, 1]])
        of, onto = (
            cv2.resize(p, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
            for p in (pair.second, pair.first)
        )
        start = small @ homography @ np.linalg.inv(small)
        until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)
        try:
            score, found = cv2.findTransformECC(
                of, onto, (start / start[2, 2]).astype(np.float32), cv2.MOTION_HOMOGRAPHY, until, None, 3
            )
        except cv2.error:  # it diverged
            return None
        homography = np.linalg.inv(small) @ found.astype(np.float64) @ small
    return replace(pair, first_from_second=by_homography(homography)) if score >= ALIGNED else None
