"""What the field is like, simulated and drawn anew: snow, a city on a map that is 5 m off, an oblique camera.

    python -m bench.accuracy.scenes [--scenes snow ...] [--methods ncc sift auto] [--seeds N] [--quick]
                                    [--docs DIR]

Every frame is matched by itself about a prior that is drawn (sigma 15 m), and the flight is followed from its true
start. Writes docs/results/field-simulated.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial

import cv2
import numpy as np

from bench.accuracy.field import figures
from bench.accuracy.rebuilt import rebuilt
from bench.accuracy.truth import START_SIGMA_M, answered, prior_about, prior_at, rows_of, true_places_m
from bench.command import parser_on_one_thread
from bench.pages import scenes as page
from engine import Camera, Fix, Frame, MatcherOptions, Navigator, NoFix, OrthoMap, SceneMatcher
from engine.geo import Array, enu_from_body
from engine.values import Attitude, Truth
from scenematch.report.metrics import errors_en_m
from scenematch.simulator import FlightStyle, build_town, plan_flight, render_frame
from scenematch.simulator.flight import paper_camera
from scenematch.simulator.render import grid_from_enu
from scenematch.simulator.town import MAP_SENSOR

FIRST_SEED = 9100
"""No constant of the engine was fitted on towns from here on."""
RATE_HZ = 0.28
CITY_SHIFT_M, CITY_TILT_DEG, CITY_HEIGHT_M = 5.0, 9.0, 120.0
CITY_CHANGED, LEAN_DEG, LEAN_FROM_M = 0.2, 12.0, 6000.0
HILLS_M, HILLS_HEIGHT_M = 60.0, 120.0
SEASONS = ("autumn", "winter")
METHODS = ("ncc", "sift", "auto")
SIZE_PX, FOV_DEG = (640, 480), 62.0
"""Of the camera of a photographing drone; snow is flown with the paper's."""


@dataclass(frozen=True)
class Scene:
    """A flight as a matcher meets it.

    Attributes:
        name: of the scene.
        site: the map.
        camera: as the matcher is given it.
        frames: with what the telemetry tells.
        truth: true positions of the vehicle.
        map_shift_m: (2,) how far east and north everything lies on the map of where it is.
    """

    name: str
    site: OrthoMap
    camera: Camera
    frames: list[Frame]
    truth: list[Truth]
    map_shift_m: Array


def snow(seed: int, frames: int | None) -> Scene:
    """The paper's flight in winter, on the map of summer."""
    plan = plan_flight(seed, frames=frames, rate_hz=RATE_HZ, condition="winter")
    return Scene("snow", plan.town.site(), plan.camera, list(plan.iter_frames()), plan.truth_rows(), np.zeros(2))


def city(seed: int, frames: int | None) -> Scene:
    """A city from 120 m, its map without heights 5 m off, its camera tilted by 9 degrees that nothing tells."""
    rng = np.random.default_rng([seed, 5])
    town = build_town(seed, condition="overcast", rebuild=rebuilt(seed, CITY_CHANGED))
    calibrated, style = _photographing(), FlightStyle(height_agl_m=CITY_HEIGHT_M)
    side = rng.uniform(0.0, 2.0 * np.pi)
    tilt = enu_from_body(0.0, 0.0, 0.0).T @ enu_from_body(
        CITY_TILT_DEG * np.cos(side), CITY_TILT_DEG * np.sin(side), 0.0
    )
    true = replace(calibrated, mount=tilt @ calibrated.mount)
    plan = plan_flight(seed, frames=frames, rate_hz=RATE_HZ, town=town, camera=true, style=style)
    toward = rng.uniform(0.0, 2.0 * np.pi)
    shift = CITY_SHIFT_M * np.array([np.cos(toward), np.sin(toward)])
    level = [replace(frame, roll_deg=None, pitch_deg=None) for frame in plan.iter_frames()]
    return Scene("city", _web_map(seed, rng, shift), calibrated, level, plan.truth_rows(), shift)


def _web_map(seed: int, rng: np.random.Generator, shift_m: Array) -> OrthoMap:
    """The city of noon as a mosaic of satellite pictures shows it: roofs lean, and everything lies so far off.

    A camera high up whose principal point is far aside sees the ground as on a map, and what stands on it leaning.
    It has no heights, and states no accuracy.
    """
    town, side = build_town(seed), rng.uniform(0.0, 2.0 * np.pi)
    shape, gsd, to_crs = town.ortho.shape[:2], town.gsd_m_per_px, town.pixel_to_crs
    aside_px = LEAN_FROM_M / gsd * np.tan(np.radians(LEAN_DEG)) * np.array([np.cos(side), np.sin(side)])
    middle = np.array([shape[1] - 1, shape[0] - 1]) / 2.0
    place = to_crs @ (*(middle + aside_px), 1.0)
    from_enu = grid_from_enu(town.crs_epsg, (float(place[0]), float(place[1])))
    focal_px = LEAN_FROM_M / gsd * np.sqrt(np.linalg.det(from_enu))
    x, y = middle + aside_px
    matrix = np.array([[focal_px, 0.0, x], [0.0, focal_px, y], [0.0, 0.0, 1.0]])
    grid_north_deg = np.degrees(np.arctan2(-from_enu[0, 1], from_enu[0, 0]))
    camera, attitude = Camera(shape[1], shape[0], matrix), Attitude(0.0, 0.0, float(grid_north_deg) % 360.0)
    seen = render_frame(town.world, camera, (float(place[0]), float(place[1])), LEAN_FROM_M, attitude)
    moved = to_crs + np.c_[np.zeros((2, 2)), shift_m]
    gray = cv2.cvtColor(MAP_SENSOR.develop(seen, rng), cv2.COLOR_RGB2GRAY)
    return OrthoMap.from_arrays(np.asarray(gray, np.uint8), moved, f"EPSG:{town.crs_epsg}")


def oblique(seed: int, frames: int | None, off_deg: float = 45.0, side_px: int = 1000) -> Scene:
    """A camera off the vertical over hills of 60 m in autumn or winter, on the map of summer with its surface."""
    season = SEASONS[seed % len(SEASONS)]
    hilly = {"width_px": side_px, "height_px": side_px + 100, "relief_m": HILLS_M, "river": True}
    town = build_town(seed, **hilly, condition=season, rebuild=rebuilt(seed, 0.05))
    camera = replace(_photographing(), mount=paper_camera(off_deg - 90.0).mount)
    height_m = float(town.world.height_m.max()) + 0.5 * HILLS_HEIGHT_M  # clears every roof
    style = FlightStyle(height_agl_m=height_m)
    plan = plan_flight(seed, frames=frames, rate_hz=RATE_HZ, town=town, camera=camera, style=style)
    name = f"oblique-{off_deg:.0f}"
    return Scene(name, town.site(), camera, list(plan.iter_frames()), plan.truth_rows(), np.zeros(2))


def _photographing() -> Camera:
    return Camera.from_fov(*SIZE_PX, FOV_DEG)


SCENES: dict[str, Callable[[int, int | None], Scene]] = {"snow": snow, "city": city, "oblique-45": oblique}
SCENES["oblique-60"] = partial(oblique, off_deg=60.0, side_px=1600)


# ------------------------------------------------------------------------------------------- matching


@dataclass(frozen=True)
class Result:
    """What one method made of the frames of one scene, pooled over its seeds.

    Attributes:
        scene, method, how: names; ``how`` is "each frame" or "track".
        distance_m: (N,) error of every frame against the truth, NaN where refused.
        on_map_m: (N,) the same against where the truth lies on the map.
        squared: (N,) normalised squared error.
        spent_ms: (N,).
    """

    scene: str
    method: str
    how: str
    distance_m: Array
    on_map_m: Array
    squared: Array
    spent_ms: list[float]


def match(scene: Scene, method: str, seed: int) -> Iterator[Result]:
    """Every frame by itself, then the whole flight."""
    matcher = SceneMatcher(scene.site, scene.camera, method, "cpu", MatcherOptions())
    matcher.warmup()
    rng, places_m = np.random.default_rng([seed, 7]), true_places_m(scene.site, scene.truth)
    priors = [prior_about(place, START_SIGMA_M, rng) for place in places_m]
    alone = answered(matcher.locate, zip(scene.frames, priors, strict=True))
    yield _judged(scene, method, "each frame", *alone)
    navigator = Navigator(matcher, prior_at(places_m[0], START_SIGMA_M))
    yield _judged(scene, method, "track", *answered(navigator.update, ((frame,) for frame in scene.frames)))


def _judged(scene: Scene, method: str, how: str, results: list[Fix | NoFix], spent: list[float]) -> Result:
    errors = errors_en_m(rows_of(results, spent), scene.truth, scene.site.frame)
    on_map = np.hypot(*(errors.error_en_m - scene.map_shift_m).T)
    return Result(scene.name, method, how, errors.distance_m, on_map, errors.normalised_squared_errors, spent)


def pooled(results: list[Result]) -> page.Row:
    """The figures of all seeds together."""
    first = results[0]
    distance, on_map, squared = (
        np.concatenate([getattr(result, name) for result in results])
        for name in ("distance_m", "on_map_m", "squared")
    )
    spent = [ms for result in results for ms in result.spent_ms]
    what = (first.scene, first.method, 1)
    true, there = figures(what, distance, squared, spent), figures(what, on_map, None, spent)
    return page.Row(first.scene, first.method, first.how, true, there)


def main() -> None:
    """Match, print, and write the page."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--seeds", type=int, default=2, help="how many towns of each scene")
    parser.add_argument("--quick", action="store_true", help="eight frames of each town")
    options = parser.parse_args()
    results: dict[tuple[str, str, str], list[Result]] = {}
    for name in options.scenes:
        for seed in range(FIRST_SEED, FIRST_SEED + options.seeds):
            scene = SCENES[name](seed + 100 * list(SCENES).index(name), 8 if options.quick else None)
            for method in options.methods:
                for result in match(scene, method, seed):
                    results.setdefault((name, method, result.how), []).append(result)
                    print(json.dumps([seed, asdict(pooled([result]))]), flush=True)
    rows = [pooled(same) for same in results.values()]
    page.write(options.docs, rows)


if __name__ == "__main__":
    main()
