"""Audits against matches: how well the raster tells where a changed frame is matched, and whole flights.

    python -m bench.accuracy.audit [--quick] [--fit] [--page FILE]

Rewrites docs/results/audit.md below its marker. ``--fit`` fits the rule on grounds of its own, which
are not reported on, prints its weights, and writes nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench import RESULTS, SHARED
from bench.accuracy.flights import STEPS, Recorded, recorded
from bench.command import parser_on_one_thread
from bench.inputs.farmland import farmland
from bench.inputs.scenes import mosaic
from bench.pages.integrity import auc
from bench.pages.text import machine, paragraph, table
from engine import Camera, Fix, Frame, Navigator, NoFix, OrthoMap, Prior, SceneMatcher
from engine.geo import Array
from engine.matching.align import view_of
from engine.values import Attitude, Window
from scenematch.check.availability import Audit, audit_site, regressors
from scenematch.simulator import build_town

Gray = NDArray[np.uint8]

PAGE = RESULTS / "audit.md"
MEASURED = "<!-- bench.accuracy.audit -->\n"
WRONG_M = 10.0
START_SIGMA_M = 15.0
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
    return arrays(np.asarray(cv2.cvtColor(build_town(seed).ortho, cv2.COLOR_RGB2GRAY), np.uint8))


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


def half(gray: Gray, *, east: bool) -> Gray:
    """One half of the farmland: one to fit on, one to report on."""
    middle = gray.shape[1] // 2
    return np.ascontiguousarray(gray[:, middle:] if east else gray[:, :middle])


def fitted_on() -> Iterator[Ground]:
    yield from map(town, FIT_TOWNS)
    yield from map(patchwork, FIT_TOWNS)
    yield from (arrays(half(farmland(year), east=False)) for year in FIT_YEARS)


def reported_on() -> Iterator[tuple[str, Callable[[], list[Ground]]]]:
    """Names of groups, and their grounds."""
    yield "three other simulated towns", lambda: list(map(town, TOWNS))
    yield "their patchwork with water, forest and repeated fields", lambda: list(map(patchwork, TOWNS))
    if not SHARED.is_dir():
        return
    years = {year: half(farmland(year), east=True) for year in YEARS}
    yield "the other half of the farmland, four other years", lambda: [arrays(years[year]) for year in YEARS]
    pairs = list(pairwise(YEARS))
    yield "the same, each year's frames on the map before", lambda: [arrays(years[a], years[b]) for a, b in pairs]
    for name in ("gazebo-a1", "nust"):
        yield f"map of {name}", lambda name=name: [whole(OrthoMap.open(SHARED / name / "map.tif"))]  # type: ignore[misc]


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


def photograph(ground: Ground, nadir_px: Array, height_m: float, rng: np.random.Generator) -> Frame:
    """A changed frame over a place, with telemetry a little off."""
    site, heading = ground.site, float(rng.uniform(0.0, 360.0))
    roll, pitch = rng.normal(0.0, 2.0, 2)
    view = view_of(CAMERA, Attitude(roll, pitch, heading), height_m, site.enu_jacobian(nadir_px))
    assert view is not None
    moved = np.array([[1.0, 0.0, -nadir_px[0]], [0.0, 1.0, -nadir_px[1]], [0.0, 0.0, 1.0]])
    size = (CAMERA.width_px, CAMERA.height_px)
    picture = cv2.warpPerspective(ground.seen, view.image_from_map @ moved, size, borderMode=cv2.BORDER_REFLECT)
    telemetry = (
        height_m * (1.0 + rng.normal(0.0, 0.01)),
        heading + rng.normal(0.0, 1.0),
        *(angle + rng.normal(0.0, 0.5) for angle in (roll, pitch)),
    )
    return Frame(changed(np.asarray(picture, np.uint8), rng), None, *map(float, telemetry))


def trials(ground: Ground, height_m: float, count: int, rng: np.random.Generator) -> list[Trial]:
    """Frames at random places of a map, matched by the engine, beside what the audit says of each place."""
    site = ground.site
    found = audit_site(site, CAMERA, height_m)
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
        east, north = truth + rng.normal(0.0, PRIOR_SIGMA_M, 2)
        prior = Prior(east_m=float(east), north_m=float(north), sigma_m=PRIOR_SIGMA_M)
        fix = matcher.locate(photograph(ground, place, height_m, rng), prior)
        right = isinstance(fix, Fix) and np.hypot(fix.east_m - truth[0], fix.north_m - truth[1]) <= WRONG_M
        out.append(
            Trial(height_m, float(found.at(place)), at_places[j, i], right, isinstance(fix, Fix) and not right)
        )
    return out


def all_trials(grounds: list[Ground], count: int, seed: int) -> list[Trial]:
    rng = np.random.default_rng(seed)
    return [one for ground in grounds for height_m in HEIGHTS_M for one in trials(ground, height_m, count, rng)]


# ---------------------------------------------------------------------------------------------------- figures


def auc_of(found: list[Trial]) -> float:
    return auc(np.array([t.predicted for t in found]), np.array([t.right for t in found], bool))


def fitted(x: NDArray[np.float64], right: NDArray[np.bool_]) -> tuple[float, ...]:
    """Weights by maximum likelihood, by Newton's method with a whisper of ridge that keeps it finite.

    Args:
        x: (N, K) terms.
        right: (N,) whether each place was right.
    """
    weights, y = np.zeros(x.shape[1]), right.astype(np.float64)
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-np.clip(x @ weights, -30, 30)))
        hessian = (x * (p * (1.0 - p))[:, None]).T @ x + 0.1 * np.eye(x.shape[1])
        step = np.linalg.solve(hessian, x.T @ (y - p) - 0.1 * weights)
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return tuple(float(round(w, 3)) for w in weights)


def fit(found: list[Trial]) -> tuple[float, ...]:
    """Weights of the logistic rule."""
    x = np.column_stack([np.ones(len(found)), np.array([t.features for t in found])])
    return fitted(x, np.array([t.right for t in found], bool))


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
    shown = ", ".join("-" if np.isnan(value) else f"{value:.2f}" for value in by_height)
    share, held = np.mean([t.right for t in found]), np.mean([t.predicted for t in found])
    wrong = str(sum(t.wrong for t in found))
    row = [name, str(len(found)), f"{held:.0%}", f"{share:.0%}", wrong, f"{auc_of(found):.3f}", shown]
    print(" | ".join(row), flush=True)
    return row


def other_rows(count: int) -> list[list[str]]:
    """Farmland four years on."""
    if not SHARED.is_dir():
        return []
    years = {year: half(farmland(year), east=True) for year in YEARS}
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
        found = audit_site(flight.site, flight.camera, float(np.median(heights)))
        first = flight.truth[0]
        start = Prior(lat_deg=first.lat_deg, lon_deg=first.lon_deg, sigma_m=START_SIGMA_M)
        navigator = Navigator(SceneMatcher(flight.site, flight.camera, "ncc", "cpu"), start)
        right = np.array([is_right(navigator.update(frame, prior), flight) for frame, prior in flight.frames])
        predicted = np.array([held(found, flight, frame) for frame, _ in flight.frames])
        known = np.isfinite(predicted)
        inside = auc(predicted[known], right[known])
        rows.append([
            name, str(int(known.sum())), f"{predicted[known].mean():.1%}", f"{right[known].mean():.1%}",
            "-" if np.isnan(inside) else f"{inside:.2f}",
        ])  # fmt: skip
        print(" | ".join(rows[-1]), flush=True)
    return rows


def is_right(result: Fix | NoFix, flight: Recorded) -> bool:
    """Whether there is a fix, and that near the truth."""
    place_m = flight.true_place_m(result.timestamp_ns)
    if not isinstance(result, Fix) or place_m is None:
        return False
    return math.hypot(result.east_m - place_m[0], result.north_m - place_m[1]) <= WRONG_M


def held(found: Audit, flight: Recorded, frame: Frame) -> float:
    """What the audit says of where a frame was taken; NaN where nobody knows where that was."""
    place_m = flight.true_place_m(frame.timestamp_ns)
    return float("nan") if place_m is None else float(found.at(flight.site.pixel_from_enu(place_m)))


def time_rows() -> list[list[str]]:
    """Seconds of an audit of maps of several sizes, at the paper's height."""
    rows = []
    for side in (1000, 4000):
        site = OrthoMap.from_arrays(mosaic(side), GRID, UTM)
        start = time.perf_counter()
        found = audit_site(site, CAMERA, 150.0)
        spent_s = time.perf_counter() - start
        rows.append([f"{side:,} x {side:,} px", str(len(found.plan)), f"{spent_s:.0f} s"])
        print(" | ".join(rows[-1]), flush=True)
    return rows


def section(
    places: list[list[str]], others: list[list[str]], flights: list[list[str]], times: list[list[str]]
) -> list[str]:
    """What follows the heading."""
    lines = ["", *paragraph(f"By `python -m bench.accuracy.audit`. One thread, {machine()}.")]
    heights = ", ".join(f"{height:g}" for height in HEIGHTS_M)
    lines += paragraph(
        "**Places.** Frames of 300 x 300 px and 60 degrees are drawn from the map at random places and headings, "
        f"from {heights} m, and changed: shadows, things that moved, exposure, haze, blur, noise, telemetry a "
        f"little off. NCC matches each with a prior off by {PRIOR_SIGMA_M:g} m (one sigma). A place is right if "
        f"there is a fix within {WRONG_M:g} m. AUC: how often a right place was rated higher than a wrong "
        "one. The rule was fitted on other towns and patchworks by the same generator, and on the other half of "
        "the farmland in other years."
    )
    columns = ["ground", "frames", "predicted", "measured", "wrong fixes", "AUC", "AUC by height"]
    lines += table(columns, places)
    lines += paragraph(
        "**Another date.** The farmland again, its frames from years after the map's: almost nothing matches, and "
        "an audit of one year predicts far too much. With so few right ones the AUC is not significant."
    )
    lines += table(columns, others)
    lines += paragraph(
        "**Flights.** The mean of the prediction at the true places, the share of frames that the navigator fixed "
        f"by NCC within {WRONG_M:g} m, and the AUC within the flight where some were not. Nothing was fitted to "
        "these flights."
    )
    lines += table(["flight", "frames", "predicted", "measured", "AUC"], flights)
    lines += paragraph("**Time**, from 150 m at 0.5 m a pixel.")
    return [*lines, *table(["map", "places", "time"], times)]


def main() -> None:
    """Measure, and write the section of the page; or fit."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--quick", action="store_true", help="few frames")
    parser.add_argument("--fit", action="store_true", help="fit the rule and print its weights")
    parser.add_argument("--page", type=Path, default=PAGE, help="what to rewrite")
    options = parser.parse_args()
    count = 15 if options.quick else 60
    if options.fit:
        found = all_trials(list(fitted_on()), count, 0)
        print(
            "WEIGHTS =", np.round(fit(found), 2).tolist(), "of", len(found), "frames; AUC", round(auc_of(found), 3)
        )
        return
    head = options.page.read_text(encoding="utf-8").split(MEASURED)[0]
    lines = section(places_rows(count), other_rows(count), flight_rows(options.quick), time_rows())
    options.page.write_text(head + MEASURED + "\n".join(lines).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
