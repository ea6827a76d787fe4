"""Matches with an answer and without one: grounds, and what is done to a frame, its prior or its map.

Grounds are simulated towns, the shared flights, and farmland of one year over the map of another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.accuracy.flights import recorded, where_truth_is
from bench.accuracy.truth import prior_about, true_places_m
from bench.inputs.farmland import farmland, laid_out
from engine import Camera, Fix, Frame, OrthoMap, Prior
from engine.geo import Array
from engine.values import Attitude, Window
from scenematch.simulator import plan_flight

Image = NDArray[np.uint8]
Rng = np.random.Generator

FRAMES = 80  # of each town, in each light
STEPS = {"gazebo-a1": 6, "gazebo-a2": 6, "gazebo-a1-evening": 6, "nust": 1, "caliterra": 1}
YEARS = {"farmland 2012 on 2016": ("2012", "2016"), "farmland 2018 on 2020": ("2018", "2020")}
PRIOR_SIGMAS_M = (4.0, 8.0, 16.0, 24.0)
TILE_M, BLOCK_M, REBUILT = 30.0, 12.0, 0.35


@dataclass
class Ground:
    """A map, and frames taken over it with their true east and north.

    Attributes:
        name: of the place.
        site: the map.
        camera: of the frames.
        frames: as they were taken.
        places_m: (N, 2) where.
        evening: the same places again in evening light, where there are such frames.
    """

    name: str
    site: OrthoMap
    camera: Camera
    frames: list[Frame]
    places_m: Array
    evening: list[Frame] = field(default_factory=list)

    def seen(self, fix: Fix) -> Fix:
        """A fix at the place that the truth is of."""
        return where_truth_is(self.name, self.site, self.camera, fix)

    @cached_property
    def gray(self) -> Image:
        """The whole map."""
        return self.site.gray(self._whole)

    @property
    def _whole(self) -> Window:
        return Window(0, 0, self.site.width_px, self.site.height_px)

    def relaid(self, gray: Image) -> OrthoMap:
        """Another picture laid out as this map is."""
        site, surface = self.site, None
        if site.has_surface:
            columns, rows = np.meshgrid(np.arange(site.width_px), np.arange(site.height_px))
            surface = site.surface_at(np.c_[columns.ravel(), rows.ravel()]).reshape(gray.shape)
        valid = site.valid(self._whole)
        return OrthoMap.from_arrays(gray, site.grid.pixel_to_crs, site.crs, surface_m=surface, valid=valid)

    @cached_property
    def old(self) -> OrthoMap:
        """The map before a part of its houses was built: blocks of it are from elsewhere, and mirrored."""
        out, rng = self.gray.copy(), np.random.default_rng(0)
        side = max(4, round(BLOCK_M / self.site.gsd_m_per_px))
        for y in range(0, out.shape[0] - side, side):
            for x in range(0, out.shape[1] - side, side):
                if rng.random() < REBUILT:
                    v, u = (int(rng.integers(n - side)) for n in out.shape)
                    out[y : y + side, x : x + side] = self.gray[v : v + side, u : u + side][:, ::-1]
        return self.relaid(out)

    @cached_property
    def tiled(self) -> OrthoMap:
        """A flat map that repeats the liveliest of its tiles."""
        side = round(TILE_M / self.site.gsd_m_per_px)
        corners = [(y, x) for y in range(0, self.gray.shape[0] - side, side)
                   for x in range(0, self.gray.shape[1] - side, side)]  # fmt: skip
        tiles = [self.gray[y : y + side, x : x + side] for y, x in corners]
        best = max(tiles, key=lambda tile: float(tile.std()))
        repeats = [-(-n // side) for n in self.gray.shape]
        out = np.ascontiguousarray(np.tile(best, repeats)[: self.gray.shape[0], : self.gray.shape[1]])
        return OrthoMap.from_arrays(out, self.site.grid.pixel_to_crs, self.site.crs)


@dataclass(frozen=True)
class Trial:
    """One match.

    Attributes:
        kind: what was done.
        on: which map: "own", "old", "tiled" or "other".
        frame: to be matched.
        prior: where it is said to be.
        truth_m: (2,) where it was taken, or None: not on this map.
    """

    kind: str
    on: str
    frame: Frame
    prior: Prior
    truth_m: Array | None


# --------------------------------------------------------------------------------------------------- grounds


def ground(name: int | str, *, map_only: bool = False) -> Ground:
    """A simulated town by its seed, a shared flight or a pair of years by its name.

    Args:
        name: of the ground.
        map_only: the map and places over it, but few frames or none.
    """
    if isinstance(name, int):
        return _town(name, map_only)
    return _farmland(name) if name in YEARS else flown(name, STEPS[name] * (8 if map_only else 1))


def _town(seed: int, map_only: bool) -> Ground:
    lights = {light: plan_flight(seed, rate_hz=0.56, condition=light) for light in ("noon", "evening")}
    plan = lights["noon"]
    site = plan.town.site()
    noon, evening = (
        [frame for _, frame in zip(range(0 if map_only else FRAMES), one.iter_frames(), strict=False)]
        for one in lights.values()
    )
    places_m = true_places_m(site, plan.truth_rows()[:FRAMES])
    return Ground(f"town {seed}", site, plan.camera, noon, places_m, evening)


def flown(name: str, step: int) -> Ground:
    """Every ``step``-th frame of a shared flight whose place, height and heading are known."""
    flight = recorded(name, step)
    known = [
        (f, place) for f, place in flight.placed() if f.height_agl_m is not None and f.heading_deg is not None
    ]
    frames, places = zip(*known, strict=True)
    return Ground(name, flight.site, flight.camera, list(frames), np.array(places))


def _farmland(name: str) -> Ground:
    """A level camera's pictures of one year over the map of another; telemetry errs as a flight's does."""
    seen, mapped = (farmland(year) for year in YEARS[name])
    site, taken = laid_out(mapped), laid_out(seen)
    camera, rng = plan_flight(1, frames=1).camera, np.random.default_rng(0)
    low, high = site.enu_from_pixel(np.array([[210.0, seen.shape[0] - 210.0], [seen.shape[1] - 210.0, 210.0]]))
    frames, places = [], rng.uniform(low, high, (FRAMES, 2))
    for place in places:
        height_m, heading_deg = rng.uniform(110.0, 160.0), rng.uniform(0.0, 360.0)
        image = picture(seen, taken, camera, place, height_m, Attitude(0.0, 0.0, heading_deg))
        roll, pitch, turn = rng.normal(0.0, [0.3, 0.3, 0.5])
        frames.append(Frame(image, None, height_m * rng.normal(1.0, 0.007), heading_deg + turn, roll, pitch))
    return Ground(name, site, camera, frames, places)


def ground_quad_px(site: OrthoMap, camera: Camera, place_m: Array, height_m: float, attitude: Attitude) -> Array:
    """(4, 2) map pixels of flat ground that the frame's corners see, clockwise from its top left."""
    rays = np.c_[_corners_px(camera), np.ones(4)] @ np.linalg.inv(camera.matrix).T
    rays = rays @ camera.enu_from_camera(attitude).T
    return site.pixel_from_enu(place_m + rays[:, :2] * (height_m / -rays[:, 2:]))


def _corners_px(camera: Camera) -> Array:
    right, bottom = camera.width_px - 1, camera.height_px - 1
    return np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float64)


def picture(
    gray: Image,
    site: OrthoMap,
    camera: Camera,
    place_m: Array,
    height_m: float,
    attitude: Attitude,
    border: int = cv2.BORDER_CONSTANT,
) -> Image:
    """What a camera without distortion sees of a flat map."""
    quad_px = ground_quad_px(site, camera, place_m, height_m, attitude)
    seen = cv2.getPerspectiveTransform(quad_px.astype(np.float32), _corners_px(camera).astype(np.float32))
    size = (camera.width_px, camera.height_px)
    return np.asarray(cv2.warpPerspective(gray, seen, size, flags=cv2.INTER_LINEAR, borderMode=border), np.uint8)


# ------------------------------------------------------------------------------------------- changes of a frame

Change = Callable[[Frame, Rng], Frame]


def _seen(change: Callable[[Image, Rng], Image]) -> Change:
    return lambda frame, rng: replace(frame, image=change(np.asarray(frame.image), rng))


def _levels(image: Image, gain: float, offset: float) -> Image:
    return np.clip(image * gain + offset, 0, 255).astype(np.uint8)


def _noisy(image: Image, rng: Rng, sd: float) -> Image:
    noise = rng.normal(0.0, sd, image.shape[:2])
    return np.clip(image + (noise if image.ndim == 2 else noise[..., None]), 0, 255).astype(np.uint8)


def _blurred(image: Image, rng: Rng) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0 * image.shape[1] / 300.0), np.uint8)


def _occluded(image: Image, rng: Rng) -> Image:
    out = image.copy()
    x, y = rng.integers(0, image.shape[1] // 2), rng.integers(0, image.shape[0] // 2)
    out[y : y + image.shape[0] // 2, x : x + image.shape[1] // 2] = rng.integers(0, 255)
    return out


def _night(image: Image, rng: Rng) -> Image:
    """Little light, much noise, and lamps that no map shows."""
    out = _noisy(_levels(image, 0.08, 4.0), rng, 3.0)
    for _ in range(12):
        x, y = (int(rng.integers(n)) for n in image.shape[1::-1])
        cv2.circle(out, (x, y), max(1, image.shape[1] // 150), (200,) * 3, -1)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.7), np.uint8)


def _winter(image: Image, rng: Rng) -> Image:
    """Green turns to the white of snow, by how green it is."""
    if image.ndim == 2:
        return _levels(image, -0.5, 220.0)  # no colour to go by: dark becomes bright
    hue, saturation, _ = cv2.split(cv2.cvtColor(image, cv2.COLOR_RGB2HSV))
    green = np.clip(1.0 - np.abs(hue.astype(np.float64) - 50.0) / 30.0, 0.0, 1.0) * np.minimum(
        saturation / 60.0, 1
    )
    return (image + green[..., None] * (225.0 - image)).astype(np.uint8)


def _autumn(image: Image, rng: Rng) -> Image:
    """Green turns to brown."""
    if image.ndim == 2:
        return image
    hue, saturation, value = cv2.split(cv2.cvtColor(image, cv2.COLOR_RGB2HSV))
    hue = np.where((hue > 25) & (hue < 85), 12, hue).astype(np.uint8)
    value = np.clip(value * 1.15, 0, 255).astype(np.uint8)
    return np.asarray(cv2.cvtColor(cv2.merge([hue, saturation, value]), cv2.COLOR_HSV2RGB), np.uint8)


CHANGES: dict[str, Change] = {
    "as it is": lambda frame, rng: frame,
    "haze": _seen(lambda image, rng: _levels(image, 0.35, 130.0)),
    "blur": _seen(_blurred),
    "dusk": _seen(lambda image, rng: _noisy(_levels(image, 0.12, 5.0), rng, 3.0)),
    "night": _seen(_night),
    "noise": _seen(lambda image, rng: _noisy(image, rng, 25.0)),
    "a quarter hidden": _seen(_occluded),
    "autumn": _seen(_autumn),
    "winter": _seen(_winter),
    "heading off by 5 degrees": lambda frame, rng: replace(frame, heading_deg=(frame.heading_deg or 0.0) + 5.0),
    "height off by 5 %": lambda frame, rng: replace(frame, height_agl_m=(frame.height_agl_m or 0.0) * 1.05),
}
UNSUITABLE = ("heading off by 5 degrees", "height off by 5 %")  # five times what is assumed of telemetry
SUITABLE = (*(kind for kind in CHANGES if kind not in UNSUITABLE), "evening light", "old map")
ANSWERABLE = (*SUITABLE, *UNSUITABLE)
UNANSWERABLE = ("prior elsewhere", "another map", "mirrored", "heading off by 180 degrees", "repeated tiles")


def trial(here: Ground, number: int, rng: Rng) -> Trial:
    """One match of a ground: every second has an answer, and the kinds take turns."""
    index = int(rng.integers(len(here.frames)))
    frame, place = here.frames[index], here.places_m[index]
    kinds = UNANSWERABLE if number % 2 else ANSWERABLE
    kind = kinds[number // 2 % len(kinds)]
    on, said, truth = "own", place, place
    if kind in CHANGES:
        frame = CHANGES[kind](frame, rng)
    elif kind == "evening light":
        kind, frame = (kind, here.evening[index]) if here.evening else ("as it is", frame)
    elif kind == "old map":
        on = "old"
    elif kind == "repeated tiles":
        on, frame = "tiled", _of_tiles(here, frame, place, rng)
    elif kind == "prior elsewhere":
        said = _elsewhere(here, frame, place, rng)
    elif kind == "another map":
        on, said, truth = "other", np.zeros(2), None  # the caller knows where it lies
    elif kind == "mirrored":
        frame, truth = mirrored(frame), None
    else:
        frame = turned_round(frame)  # features may still find the place
    return Trial(kind, on, frame, drawn_prior(said, rng), truth)


def mirrored(frame: Frame) -> Frame:
    """What no place looks like."""
    return replace(frame, image=np.ascontiguousarray(np.asarray(frame.image)[:, ::-1]))


def turned_round(frame: Frame) -> Frame:
    """The frame with a heading that is off by 180 degrees."""
    return replace(frame, heading_deg=(frame.heading_deg or 0.0) + 180.0)


def _of_tiles(here: Ground, frame: Frame, place: Array, rng: Rng) -> Frame:
    """A frame drawn from the repeated map itself, so that every copy of the place is as good as the true one."""
    assert frame.height_agl_m is not None
    assert frame.heading_deg is not None
    site, level = here.tiled, Attitude(0.0, 0.0, frame.heading_deg)
    gray = site.gray(Window(0, 0, site.width_px, site.height_px))
    image = picture(gray, site, here.camera, place, frame.height_agl_m, level)
    return replace(frame, image=_noisy(image, rng, 4.0), roll_deg=0.0, pitch_deg=0.0)


def _elsewhere(here: Ground, frame: Frame, place: Array, rng: Rng) -> Array:
    """A place of the map so far off that the window cannot hold the true one."""
    site, camera = here.site, here.camera
    far_m = (frame.height_agl_m or 0.0) * camera.width_px / camera.focal_px + 4.0 * PRIOR_SIGMAS_M[-1]
    corners = site.enu_from_pixel(np.array([[0.0, 0.0], [site.width_px - 1.0, site.height_px - 1.0]]))
    for _ in range(50):
        guess = rng.uniform(corners.min(axis=0), corners.max(axis=0))
        if np.hypot(*(guess - place)) > far_m:
            return guess
    return place + np.array([4.0 * far_m, 0.0])


def drawn_prior(place_m: Array, rng: Rng) -> Prior:
    """As far off as it says."""
    return prior_about(place_m, float(rng.choice(PRIOR_SIGMAS_M)), rng)
