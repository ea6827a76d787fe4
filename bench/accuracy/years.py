"""Grounds of real imagery, one year's pictures on the map of another: cities at 0.6 m, and farmland.

Half of the places is for fitting and half for reports, by name and once for all; years of one place are never on
both sides. The farmland is one place: its west is for fitting, its east for reports.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import permutations

import numpy as np

from bench import SHARED
from bench.accuracy.trials import Ground, Rng, Trial, ground_quad_px, mirrored, picture, turned_round
from bench.accuracy.truth import prior_about
from bench.inputs.farmland import farmland, half_of, laid_out, vintages
from engine import Camera, Frame, OrthoMap, Prior
from engine.geo import Array
from engine.values import Attitude, Window

CITIES = SHARED / "naip-cities"
YEARS = ("2016", "2018", "2020")
HALVES = ("fit", "report")
SETS = ("naip-cities", "naip")
PRIOR_SIGMA_M = 15.0
SIDES_M = {"naip-cities": (95.0, 144.0), "naip": (127.0, 185.0)}  # of a frame on the ground; chips are 154 m
FOV_DEG = 60.0
TILT_SD_DEG, HEIGHT_SHARE_SD, ATTITUDE_SD_DEG = 2.0, 0.007, (0.3, 0.3, 0.5)
MAX_SHARE = 3.0  # of frames of a larger place
_TRIES = 400
# Weights of the corners of a quadrilateral: points along its edges and in its middle.
_ALONG = np.array([np.roll([1 - t, t, 0, 0], k) for k in range(4) for t in (0.02, 0.35, 0.65)] + [[0.25] * 4])
UNANSWERABLE = ("another place", "mirrored", "turned by 180 degrees", "prior elsewhere")


@dataclass(frozen=True)
class YearPair:
    """One year's frames and another year's map of one place.

    Attributes:
        place: its name.
        years: of the frames, and of the map.
        ground: map, frames and where they were taken, by the map's own georeference.
    """

    place: str
    years: tuple[str, str]
    ground: Ground


def places(half: str) -> list[str]:
    """The places of a half: of each city every second one, in the order of their names."""
    found: list[str] = []
    names = sorted(path.name for path in CITIES.iterdir() if path.is_dir())
    for city in sorted({name.rsplit("_", 1)[0] for name in names}):
        found += [n for n in names if n.rsplit("_", 1)[0] == city][HALVES.index(half) :: 2]
    return found


def pairs(source: str, half: str, frames: int = 8, seed: int = 0) -> Iterator[YearPair]:
    """Year pairs of a half of a set, both ways.

    Args:
        source: one of :data:`SETS`.
        half: "fit" or "report".
        frames: of a single chip; a larger place has up to :data:`MAX_SHARE` times as many.
        seed: of places, heights and errors.
    """
    for index, place in enumerate(places(half) if source == "naip-cities" else [source]):
        years = YEARS if source == "naip-cities" else vintages()
        for number, (seen, mapped) in enumerate(permutations(years, 2)):
            rng = np.random.default_rng([seed, SETS.index(source), HALVES.index(half), index, number])
            yield YearPair(place, (seen, mapped), _ground(source, half, place, seen, mapped, frames, rng))


def _ground(source: str, half: str, place: str, seen: str, mapped: str, frames: int, rng: Rng) -> Ground:
    taken, site = (opened(source, half, place, year) for year in (seen, mapped))
    shift_px = shift(place, seen, mapped) if source == "naip-cities" else np.zeros(2)
    camera, out, where = Camera.from_fov(300, 300, FOV_DEG), [], []
    share = min(MAX_SHARE, max(1.0, taken.width_px * taken.height_px / 256**2))
    for _ in range(round(frames * share)):
        drawn = _drawn(taken, camera, SIDES_M[source], rng)
        if drawn is not None:
            frame, place_px = drawn
            out.append(frame)
            where.append(site.enu_from_pixel(place_px + shift_px))
    return Ground(f"{place} {seen} on {mapped}", site, camera, out, np.array(where))


def _drawn(taken: OrthoMap, camera: Camera, sides_m: tuple[float, float], rng: Rng) -> tuple[Frame, Array] | None:
    """A frame that shows nothing but map, with telemetry that errs; and where it was taken, in map pixels."""
    whole, size_px = Window(0, 0, taken.width_px, taken.height_px), np.array([taken.width_px, taken.height_px])
    gray, valid = taken.gray(whole), taken.valid(whole).astype(np.uint8)
    middle_m = taken.enu_from_pixel(size_px / 2.0)
    for _ in range(_TRIES):
        height_m = rng.uniform(*sides_m) * camera.focal_px / camera.width_px
        heading_deg, (roll_deg, pitch_deg) = rng.uniform(0.0, 360.0), rng.normal(0.0, TILT_SD_DEG, 2)
        pose = height_m, Attitude(float(roll_deg), float(pitch_deg), heading_deg)
        reach_px = ground_quad_px(taken, camera, middle_m, *pose) - size_px / 2.0
        low, high = 1.0 - reach_px.min(axis=0), size_px - 2.0 - reach_px.max(axis=0)
        if (low > high).any():
            continue
        place_px = rng.uniform(low, high)
        columns, rows = (place_px + _ALONG @ reach_px).astype(int).T
        if not valid[rows, columns].all():
            continue  # most gaps, found without drawing anything
        place_m = taken.enu_from_pixel(place_px)
        if not picture(valid, taken, camera, place_m, *pose).all():
            continue
        image = picture(gray, taken, camera, place_m, *pose)
        roll, pitch, turn = np.array([roll_deg, pitch_deg, heading_deg]) + rng.normal(0.0, ATTITUDE_SD_DEG)
        stated_m = height_m * rng.normal(1.0, HEIGHT_SHARE_SD)
        return Frame(image, None, stated_m, turn % 360.0, roll, pitch), place_px
    return None


@cache
def opened(source: str, half: str, place: str, year: str) -> OrthoMap:
    """The map of a place in a year; of farmland, which is at 5 m, as if it were at 0.5 m, its half."""
    if source == "naip-cities":
        return OrthoMap.open(CITIES / place / f"{year}.tif")
    return laid_out(half_of(farmland(year), east=half == "report"))


@cache
def _shifts() -> dict[tuple[str, str, str], list[tuple[float, float]]]:
    """Reliable measured shifts of the later year against the earlier, in pixels, by place and years."""
    found: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    with (CITIES / "pairs.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["reliable"] == "1":
                key = (row["place"], row["year_a"], row["year_b"])
                found.setdefault(key, []).append((float(row["dx_px"]), float(row["dy_px"])))
    return found


def shift(place: str, seen: str, mapped: str) -> Array:
    """Where the map of a year shows what another year shows at the origin, (2,) pixels; 0 where not measured."""
    forth, back = _shifts().get((place, seen, mapped)), _shifts().get((place, mapped, seen))
    if forth:
        return np.median(np.array(forth), axis=0)
    return -np.median(np.array(back), axis=0) if back else np.zeros(2)


def trial(pair: YearPair, other: YearPair, number: int, rng: Rng) -> Trial:
    """One match: every second has an answer."""
    here = pair.ground
    index = int(rng.integers(len(here.frames)))
    frame, place = here.frames[index], here.places_m[index]
    kind = "another year" if number % 2 == 0 else UNANSWERABLE[number // 2 % len(UNANSWERABLE)]
    far = [p for p in here.places_m if np.hypot(*(p - place)) > 4.0 * PRIOR_SIGMA_M]
    if kind == "another place" or (kind == "prior elsewhere" and not far):
        there_m = other.ground.places_m
        return Trial("another place", "other", frame, _prior(there_m[int(rng.integers(len(there_m)))], rng), None)
    said, truth = place, place
    if kind == "mirrored":
        frame, truth = mirrored(frame), None
    elif kind == "turned by 180 degrees":
        frame = turned_round(frame)
    elif kind == "prior elsewhere":
        said = far[int(rng.integers(len(far)))]
    return Trial(kind, "own", frame, _prior(said, rng), truth)


def _prior(place_m: Array, rng: Rng) -> Prior:
    return prior_about(place_m, PRIOR_SIGMA_M, rng)
