"""Matches that have an answer and matches that have none: how often is a wrong place believed?

    python -m bench.integrity [--matches N] [--docs DIR]

Frames of simulated towns are matched one by one, each with a prior of its own. Half of the matches have an answer:
the frame as it is, or through haze, blur, dusk, noise, an occlusion, or with telemetry that is off. The other half
has none: the prior points elsewhere, the map is another town's, or the frame is mirrored. A fix is wrong that is
more than 10 m and 3 of its own sigmas off; on another map or of a mirrored frame every fix is.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from engine import Fix, Frame, MatcherOptions, OrthoMap, Prior, SceneMatcher
from engine.device import set_threads
from engine.methods.laid import NccOptions
from engine.report.metrics import FALSE_SIGMAS, WRONG_M
from engine.sim import plan_flight

SEEDS = (31, 32, 33, 34)  # no threshold was chosen on these towns
FRAMES = 100  # of each town
PRIOR_SIGMA_M = 8.0
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Town:
    """A map and frames over it, with their true east and north."""

    site: OrthoMap
    matchers: dict[str, SceneMatcher]
    frames: list[Frame]
    places_m: NDArray[np.float64]


@dataclass
class Count:
    """What became of the matches of one kind."""

    matches: int = 0
    fixes: int = 0
    wrong: int = 0


def town(seed: int) -> Town:
    """One simulated flight, drawn once."""
    plan = plan_flight(seed, rate_hz=0.7)
    drawn = plan.town
    gray = cv2.cvtColor(drawn.ortho, cv2.COLOR_RGB2GRAY)
    site = OrthoMap.from_arrays(gray, drawn.pixel_to_crs, f"EPSG:{drawn.crs_epsg}", surface_m=drawn.surface_m)
    frames = [frame for _, frame in zip(range(FRAMES), plan.iter_frames(), strict=False)]
    places = [site.frame.enu_from_geodetic(t.lat_deg, t.lon_deg) for t in plan.truth_rows()[: len(frames)]]
    peak = MatcherOptions(ncc=NccOptions(refine=False))
    matchers = {
        "NCC, peak": SceneMatcher(site, plan.camera, "ncc", "cpu", peak),
        "NCC, refined": SceneMatcher(site, plan.camera, "ncc", "cpu"),
        "SIFT": SceneMatcher(site, plan.camera, "sift", "cpu"),
        "auto": SceneMatcher(site, plan.camera, "auto", "cpu"),
    }
    for matcher in matchers.values():
        matcher.warmup()
    return Town(site, matchers, frames, np.array(places))


def _occluded(image: Image, rng: np.random.Generator) -> Image:
    out = image.copy()
    x, y = rng.integers(0, image.shape[1] // 2), rng.integers(0, image.shape[0] // 2)
    out[y : y + image.shape[0] // 2, x : x + image.shape[1] // 2] = rng.integers(0, 255)
    return out


def _levels(image: Image, gain: float, offset: float) -> Image:
    return np.clip(image * gain + offset, 0, 255).astype(np.uint8)


def _noisy(image: Image, rng: np.random.Generator, sd: float) -> Image:
    return np.clip(image + rng.normal(0.0, sd, image.shape), 0, 255).astype(np.uint8)


Change = Callable[[Frame, np.random.Generator], Frame]


def _seen(change: Callable[[Image, np.random.Generator], Image]) -> Change:
    return lambda frame, rng: replace(frame, image=change(np.asarray(frame.image), rng))


ANSWERABLE: dict[str, Change] = {
    "as it is": lambda frame, rng: frame,
    "haze": _seen(lambda image, rng: _levels(image, 0.35, 130.0)),
    "blur": _seen(lambda image, rng: cv2.GaussianBlur(image, (0, 0), 2.0)),
    "dusk": _seen(lambda image, rng: _noisy(_levels(image, 0.12, 5.0), rng, 3.0)),
    "noise": _seen(lambda image, rng: _noisy(image, rng, 25.0)),
    "a quarter hidden": _seen(_occluded),
    "heading off by 5 degrees": lambda frame, rng: replace(frame, heading_deg=(frame.heading_deg or 0.0) + 5.0),
    "height off by 5 %": lambda frame, rng: replace(frame, height_agl_m=(frame.height_agl_m or 0.0) * 1.05),
}
UNANSWERABLE = ("prior elsewhere", "another town's map", "mirrored frame")


def run(matches: int) -> dict[tuple[str, str], Count]:
    """Counts by kind and method."""
    towns, rng = [town(seed) for seed in SEEDS], np.random.default_rng(0)
    counts: dict[tuple[str, str], Count] = {}
    shares = {"NCC, peak": 0.6, "NCC, refined": 0.15, "SIFT": 0.15, "auto": 0.1}
    for method, share in shares.items():
        for number in range(round(matches * share)):
            own = towns[rng.integers(len(towns))]
            index = int(rng.integers(len(own.frames)))
            if number % 2:
                kind = UNANSWERABLE[number // 2 % len(UNANSWERABLE)]
                result = _without_answer(kind, own, towns, index, method, rng)
                truth = own.places_m[index] if kind == "prior elsewhere" else None
            else:
                kind = list(ANSWERABLE)[number // 2 % len(ANSWERABLE)]
                truth = own.places_m[index]
                frame = ANSWERABLE[kind](own.frames[index], rng)
                result = own.matchers[method].locate(frame, _prior(truth, rng))
            count = counts.setdefault((kind, method), Count())
            count.matches += 1
            if isinstance(result, Fix):
                count.fixes += 1
                count.wrong += truth is None or _is_wrong(result, truth)
    return counts


def _without_answer(
    kind: str, own: Town, towns: list[Town], index: int, method: str, rng: np.random.Generator
) -> object:
    frame, place, where = own.frames[index], own.places_m[index], own
    if kind == "mirrored frame":
        frame = replace(frame, image=np.ascontiguousarray(np.asarray(frame.image)[:, ::-1]))
    elif kind == "prior elsewhere":
        far = np.hypot(*(own.places_m - place).T) > 150.0  # the frame's own place lies beyond the window
        place = own.places_m[rng.choice(np.flatnonzero(far))]
    else:
        where = next(t for t in towns[int(rng.integers(len(towns))) :] + towns if t is not own)
    return where.matchers[method].locate(frame, _prior(place, rng))


def _prior(place_m: NDArray[np.float64], rng: np.random.Generator) -> Prior:
    east, north = place_m + rng.normal(0.0, PRIOR_SIGMA_M / 2, 2)
    return Prior(east_m=float(east), north_m=float(north), sigma_m=PRIOR_SIGMA_M)


def _is_wrong(fix: Fix, truth_m: NDArray[np.float64]) -> bool:
    off_m = float(np.hypot(fix.east_m - truth_m[0], fix.north_m - truth_m[1]))
    return off_m > WRONG_M and off_m > FALSE_SIGMAS * fix.sigma_m


def page(counts: dict[tuple[str, str], Count]) -> str:
    """The table as Markdown."""
    methods = list(dict.fromkeys(method for _, method in counts))
    lines = ["# Matches with and without an answer", "", *(__doc__ or "").splitlines()[4:], ""]
    lines += ["Each cell: matches, share that got a fix, wrong fixes.", ""]
    lines += ["| kind | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
    for kind in (*ANSWERABLE, *UNANSWERABLE):
        cells = [counts.get((kind, method), Count()) for method in methods]
        shown = [f"{c.matches:,}, {100 * c.fixes / max(1, c.matches):.1f} %, {c.wrong}" for c in cells]
        lines.append(f"| {kind} | " + " | ".join(shown) + " |")
    total = sum(c.matches for c in counts.values())
    wrong = sum(c.wrong for c in counts.values())
    answered = [c for (kind, _), c in counts.items() if kind in ANSWERABLE]
    share = sum(c.fixes - c.wrong for c in answered) / sum(c.matches for c in answered)
    lines += [
        "",
        f"{wrong} wrong fixes in {total:,} matches; {100 * share:.1f} % of those with an answer got it.",
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--matches", type=int, default=100_000)
    parser.add_argument("--docs", type=Path, default=Path(__file__).parents[1] / "docs")
    options = parser.parse_args()
    set_threads(1)
    text = page(run(options.matches))
    (options.docs / "matches.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
