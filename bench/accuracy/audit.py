"""Audits against matches: how well the raster tells where a changed frame is matched, and whole flights.

    python -m bench.accuracy.audit [--quick] [--fit] [--docs DIR]

Fills in docs/results/audit.md. ``--fit`` fits the rule on grounds of its own, which
are not reported on, prints its weights, and writes nothing.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from bench import SHARED
from bench.accuracy.flights import STEPS, recorded
from bench.accuracy.trials import picture
from bench.accuracy.truth import off, prior_about, true_start
from bench.command import parser_on_one_thread
from bench.inputs.farmland import farmland, half_of
from bench.inputs.scenes import mosaic, town_gray
from bench.pages.integrity import auc
from bench.pages.text import fill, measured, shown, table
from engine import Camera, Fix, Frame, Navigator, NoFix, OrthoMap, SceneMatcher
from engine.geo import Array
from engine.values import Attitude, Window
from scenematch.check.availability import audit_of, regressors
from scenematch.check.plan import plan_audit
from scenematch.report.metrics import WRONG_M

Gray = NDArray[np.uint8]

CAMERA = Camera.from_fov(300, 300, 60.0)
HEIGHTS_M = (40.0, 60.0, 120.0)
PRIOR_SIGMA_M = 10.0  # as AuditOptions
FIT_TOWNS, FIT_YEARS = (11, 12, 13), ("2010", "2015")
TOWNS, YEARS = (31, 32, 33), ("2012", "2016", "2018", "2020")
UTM = "EPSG:32614"
GRID = np.array([[0.5, 0.0, 600_000.0], [0.0, -0.5, 4_500_000.0]])


@dataclass(frozen=True)
class Ground:
    """A map, and what frames over it are drawn from: itself, or another date."""

    site: OrthoMap
    seen: Gray


@dataclass(frozen=True)
class Trial:
    """One frame: where its middle looked, from which height, what the audit held of it, and what came of it."""

    height_m: float
    predicted: float
    features: Array
    right: bool
    wrong: bool


# ---------------------------------------------------------------------------------------------------- grounds


def arrays(gray: Gray, seen: Gray | None = None) -> Ground:
    """A ground of 0.5 m a pixel."""
    return Ground(OrthoMap.from_arrays(gray, GRID, UTM), gray if seen is None else seen)


def town(seed: int) -> Ground:
    return arrays(town_gray(seed))


def patchwork(seed: int) -> Ground:
    """A town of which three quarters are water, forest and fields that repeat; water and leaves move."""
    gray = town(seed).seen.copy()
    rng = np.random.default_rng(seed)
    seen, (height, width) = gray.copy(), (n // 2 for n in gray.shape)

    def grain(blur_px: float) -> Array:
        noise = cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), blur_px)
        return np.asarray(noise / noise.std())

    def gray_levels(picture: Array) -> Gray:
        return np.asarray(np.clip(picture, 0, 255), np.uint8)

    waters = [gray_levels(70.0 + 3.0 * grain(4.0)) for _ in range(2)]
    crowns = grain(1.2)
    woods = [gray_levels(80.0 + 20.0 * part) for part in (crowns, 0.6 * crowns + 0.8 * grain(1.2))]
    tile = cv2.GaussianBlur(rng.uniform(60.0, 180.0, (40, 56)), (0, 0), 2.0)
    field = np.tile(tile, (-(-height // 40), -(-width // 56)))[:height, :width]
    fields = [gray_levels(field + 2.0 * grain(1.0)) for _ in range(2)]
    corners = rng.permutation([(0, 0), (0, width), (height, 0), (height, width)])[:3]
    for (y, x), (on_map, in_frame) in zip(corners, (waters, woods, fields), strict=True):
        gray[y : y + height, x : x + width], seen[y : y + height, x : x + width] = on_map, in_frame
    return arrays(gray, seen)


def whole(site: OrthoMap) -> Ground:
    rows, columns = site.level_shape(0)
    return Ground(site, site.gray(Window(0, 0, columns, rows)))


def fitted_on() -> Iterator[Ground]:
    yield from map(town, FIT_TOWNS)
    yield from map(patchwork, FIT_TOWNS)
    yield from (arrays(half_of(farmland(year), east=False)) for year in FIT_YEARS)


def reported_on() -> Iterator[tuple[str, Callable[[], list[Ground]]]]:
    """Names of groups, and their grounds."""
    yield "three other simulated towns", lambda: list(map(town, TOWNS))
    yield "their patchwork with water, forest and repeated fields", lambda: list(map(patchwork, TOWNS))
    if not SHARED.is_dir():
        return
    years = reported_years()
    yield "the other half of the farmland, four other years", lambda: [arrays(years[year]) for year in YEARS]
    pairs = list(pairwise(YEARS))
    yield "the same, each year's frames on the map before", lambda: [arrays(years[a], years[b]) for a, b in pairs]
    for name in ("gazebo-a1", "nust"):
        yield f"map of {name}", lambda name=name: [whole(OrthoMap.open(SHARED / name / "map.tif"))]  # type: ignore[misc]


def reported_years() -> dict[str, Gray]:
    """The other half of the farmland, by year."""
    return {year: half_of(farmland(year), east=True) for year in YEARS}


# ----------------------------------------------------------------------------------------------------- frames


def changed(gray: Gray, rng: np.random.Generator) -> Gray:
    """A frame at another hour: shadows, things that moved, exposure, haze, blur and noise, of one strength."""
    height, width = gray.shape
    out, side = gray.astype(np.float32), min(gray.shape)

    def boxes(count: int, largest: float) -> Iterator[NDArray[np.int32]]:
        for _ in range(count):
            middle, size = rng.uniform(0, (width, height)), rng.uniform(0.02, largest, 2) * side
            corners = cv2.boxPoints((tuple(middle.tolist()), tuple(size.tolist()), float(rng.uniform(0, 180))))
            yield np.rint(corners).astype(np.int32)

    for box in boxes(120, 0.08):
        shadow = np.zeros(gray.shape, np.uint8)
        cv2.fillConvexPoly(shadow, box, 1)
        out[shadow > 0] *= 0.6
    turned = cv2.rotate(gray, cv2.ROTATE_180)
    for box in boxes(120, 0.1):
        moved = np.zeros(gray.shape, np.uint8)
        cv2.fillConvexPoly(moved, box, 1)
        out[moved > 0] = turned[moved > 0]
    out = 255.0 * np.clip(out / 255.0, 0.0, 1.0) ** rng.uniform(0.8, 1.25)
    out = cv2.GaussianBlur(0.8 * out + 25.0, (0, 0), 1.0) + rng.normal(0.0, 3.0, out.shape)
    return np.asarray(np.clip(out, 0, 255), np.uint8)


def photograph(ground: Ground, place_m: Array, height_m: float, rng: np.random.Generator) -> Frame:
    """A changed frame over a place, with telemetry a little off."""
    heading = float(rng.uniform(0.0, 360.0))
    roll, pitch = rng.normal(0.0, 2.0, 2)
    attitude = Attitude(float(roll), float(pitch), heading)
    seen = picture(ground.seen, ground.site, CAMERA, place_m, height_m, attitude, cv2.BORDER_REFLECT)
    telemetry = (
        height_m * (1.0 + rng.normal(0.0, 0.01)),
        heading + rng.normal(0.0, 1.0),
        *(angle + rng.normal(0.0, 0.5) for angle in (roll, pitch)),
    )
    return Frame(changed(seen, rng), None, *map(float, telemetry))


def trials(ground: Ground, height_m: float, count: int, rng: np.random.Generator) -> list[Trial]:
    """Frames at random places of a map, matched by the engine, beside what the audit says of each place."""
    site = ground.site
    found = audit_of(plan_audit(site, CAMERA, height_m))
    matcher = SceneMatcher(site, CAMERA, "ncc", "cpu")
    statistics = found.statistics
    at_places = regressors(statistics.texture, statistics.score, statistics.lead)
    out: list[Trial] = []
    edge = np.hypot(*found.plan.view.footprint_px) * 2.0**found.plan.level / 2.0 + 2.0
    low, high = np.full(2, edge), np.array([site.width_px, site.height_px]) - edge
    if (low >= high).any():
        return out
    while len(out) < count:
        place = rng.uniform(low, high)
        j, i = (int(v) for v in ((place + 0.5) // found.plan.spacing_px)[::-1])
        if np.isnan(at_places[j, i]).any():
            count -= 1  # nodata is no question
            continue
        truth = site.enu_from_pixel(place)
        prior = prior_about(truth, PRIOR_SIGMA_M, rng)
        fix = matcher.locate(photograph(ground, truth, height_m, rng), prior)
        right = is_right(fix, truth)
        wrong = isinstance(fix, Fix) and not right
        out.append(Trial(height_m, float(found.at(place)), at_places[j, i], right, wrong))
    return out


def all_trials(grounds: list[Ground], count: int, seed: int) -> list[Trial]:
    rng = np.random.default_rng(seed)
    return [one for ground in grounds for height_m in HEIGHTS_M for one in trials(ground, height_m, count, rng)]


# ---------------------------------------------------------------------------------------------------- figures


def auc_of(found: list[Trial]) -> float:
    return auc(np.array([t.predicted for t in found]), np.array([t.right for t in found], bool))


def fit(found: list[Trial]) -> tuple[float, ...]:
    """Weights of the logistic rule by maximum likelihood, by Newton's method.

    A whisper of ridge keeps them finite.
    """
    x = np.column_stack([np.ones(len(found)), np.array([t.features for t in found])])
    weights, y = np.zeros(x.shape[1]), np.array([t.right for t in found], np.float64)
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-np.clip(x @ weights, -30, 30)))
        hessian = (x * (p * (1.0 - p))[:, None]).T @ x + 0.1 * np.eye(x.shape[1])
        step = np.linalg.solve(hessian, x.T @ (y - p) - 0.1 * weights)
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return tuple(float(round(w, 3)) for w in weights)


def places_rows(count: int) -> list[list[str]]:
    """A row for each group of grounds, and one for all."""
    every: list[Trial] = []
    rows = []
    for name, grounds in reported_on():
        found = all_trials(grounds(), count, 1)
        every += found
        rows.append(places_row(name, found))
    return [*rows, places_row("all of these", every)]


def places_row(name: str, found: list[Trial]) -> list[str]:
    by_height = [auc_of([t for t in found if t.height_m == height]) for height in HEIGHTS_M]
    heights = ", ".join(map(shown, by_height))
    share, held = np.mean([t.right for t in found]), np.mean([t.predicted for t in found])
    wrong = str(sum(t.wrong for t in found))
    row = [name, str(len(found)), f"{held:.0%}", f"{share:.0%}", wrong, f"{auc_of(found):.3f}", heights]
    print(" | ".join(row), flush=True)
    return row


def other_rows(count: int) -> list[list[str]]:
    """Farmland four years on."""
    if not SHARED.is_dir():
        return []
    years = reported_years()
    grounds = [arrays(years[first], years[last]) for first, last in zip(YEARS, YEARS[2:], strict=False)]
    return [places_row("one year alone", all_trials(grounds, count, 1))]


def flight_rows(quick: bool) -> list[list[str]]:
    """Predicted and measured availability of the recorded flights."""
    rows = []
    for name, step in STEPS.items():
        if not (SHARED / name).is_dir():
            continue
        flight = recorded(name, step * (10 if quick else 2))
        heights = [frame.height_agl_m for frame, _ in flight.frames if frame.height_agl_m is not None]
        found = audit_of(plan_audit(flight.site, flight.camera, float(np.median(heights))))
        navigator = Navigator(SceneMatcher(flight.site, flight.camera, "ncc", "cpu"), true_start(flight.truth))
        results = [navigator.update(*each) for each in flight.frames]
        places = [(result, flight.true_place_m(result.timestamp_ns)) for result in results]
        placed = [(result, place) for result, place in places if place is not None]
        predicted = np.array([found.at(flight.site.pixel_from_enu(place)) for _, place in placed])
        right = np.array([is_right(*each) for each in placed])
        known = np.isfinite(predicted)
        inside = auc(predicted[known], right[known])
        shares = [f"{values[known].mean():.1%}" for values in (predicted, right)]
        rows.append([name, str(int(known.sum())), *shares, shown(inside)])
        print(" | ".join(rows[-1]), flush=True)
    return rows


def is_right(result: Fix | NoFix, place_m: Array) -> bool:
    """Whether there is a fix, and that near the truth."""
    return isinstance(result, Fix) and off(result, place_m)[0] <= WRONG_M


def time_rows() -> list[list[str]]:
    """Seconds of an audit of maps of several sizes, at the paper's height."""
    rows = []
    for side in (1000, 4000):
        site = OrthoMap.from_arrays(mosaic(side), GRID, UTM)
        start = time.perf_counter()
        found = audit_of(plan_audit(site, CAMERA, 150.0))
        spent_s = time.perf_counter() - start
        rows.append([f"{side:,} x {side:,} px", str(len(found.plan)), f"{spent_s:.0f} s"])
        print(" | ".join(rows[-1]), flush=True)
    return rows


def main() -> None:
    """Measure, and fill in the page; or fit."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--quick", action="store_true", help="few frames")
    parser.add_argument("--fit", action="store_true", help="fit the rule and print its weights")
    options = parser.parse_args()
    count = 15 if options.quick else 60
    if options.fit:
        found = all_trials(list(fitted_on()), count, 0)
        print(
            "WEIGHTS =", np.round(fit(found), 2).tolist(), "of", len(found), "frames; AUC", round(auc_of(found), 3)
        )
        return
    columns = ["ground", "frames", "predicted", "measured", "wrong fixes", "AUC", "AUC by height"]
    sections = {
        "places": table(columns, places_rows(count)),
        "another date": table(columns, other_rows(count)),
        "flights": table(["flight", "frames", "predicted", "measured", "AUC"], flight_rows(options.quick)),
        "time": table(["map", "places", "time"], time_rows()),
    }
    fill(options.docs / "audit.md", measured() | sections)


if __name__ == "__main__":
    main()
