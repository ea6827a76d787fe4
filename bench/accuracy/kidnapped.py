"""Kidnapped: somewhere on the map, no prior, heading unknown. How soon is the place known, and is it ever wrong?

    python -m bench.accuracy.kidnapped [--quick] [--starts N] [--seeds S ...]

Short runs of successive frames, at 5 Hz, from random places over simulated towns and from all along the shared
gazebo flights. Each begins with a fresh Navigator that is given height, roll and pitch, and neither place, heading
nor velocity. The same frames are flown over the map of another town, where nothing can be right. Prints one JSON
object a row.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from bench import SHARED
from bench.accuracy.flights import recorded
from bench.accuracy.truth import answered, is_false
from bench.command import parser_on_one_thread
from engine import Camera, Fix, Frame, Navigator, OrthoMap, SceneMatcher
from engine.geo import Array
from scenematch.simulator import Motion, SensorNoise, build_town, plan_flight
from scenematch.simulator.vehicle import simulate_telemetry

FRAMES = 6  # of a run
RATE_HZ, SPEED_MPS = 5.0, 7.0
HEIGHTS_M, EDGE_M = (100.0, 180.0), 70.0  # of the camera; how near it comes to the map's edge
START_NS, FAR_M = 1_000_000_000, 1e7
SEEDS = (11, 12, 13)
RECORDED = ("gazebo-a1", "gazebo-a2", "gazebo-a1-evening")
METHODS = ("sift", "ncc")


@dataclass(frozen=True)
class Flight:
    """Runs of successive frames, and where they were taken."""

    name: str
    site: OrthoMap
    camera: Camera
    runs: list[list[tuple[Frame, Array]]]


@cache
def town_site(seed: int) -> OrthoMap:
    """The map of a simulated town with its surface model; it is of noon in every light."""
    return build_town(seed).site()


def simulated(seed: int, starts: int, condition: str = "noon") -> Flight:
    """Runs over a town: any place, heading and height from which the map holds most of the frame."""
    plan = plan_flight(seed, frames=1, condition=condition)
    site, rng = town_site(seed), np.random.default_rng(seed)
    motion = wander(site, starts, rng)
    stamps = tuple((START_NS + np.rint(motion.time_s * 1e9).astype(np.int64)).tolist())
    telemetry = simulate_telemetry(motion, SensorNoise(), rng)
    plan = replace(plan, truth=motion, telemetry=telemetry, timestamps_ns=stamps)
    seen = list(zip(map(blind, plan.iter_frames()), motion.position_m[:, :2], strict=True))
    runs = [seen[k : k + FRAMES] for k in range(0, len(seen), FRAMES)]
    return Flight(f"town {seed}, {condition}", site, plan.camera, runs)


def wander(site: OrthoMap, starts: int, rng: np.random.Generator) -> Motion:
    """Straight runs of :data:`FRAMES` frames each, one after the other, about the map's middle."""
    half_m = np.array([site.width_px, site.height_px]) * site.gsd_m_per_px / 2.0 - EDGE_M

    def each(low: Any, high: Any, *size: int) -> Array:
        return np.repeat(rng.uniform(low, high, (starts, *size)), FRAMES, axis=0)

    time_s = np.arange(starts * FRAMES) / RATE_HZ
    heading = each(0.0, 360.0)
    ahead = np.stack([np.sin(np.radians(heading)), np.cos(np.radians(heading)), 0.0 * heading], axis=1)
    velocity = SPEED_MPS * ahead
    position = np.column_stack([each(-half_m, half_m, 2), each(*HEIGHTS_M)])
    position += velocity * (np.arange(len(time_s)) % FRAMES / RATE_HZ)[:, None]
    roll, pitch = each(-5.0, 5.0) + rng.normal(0.0, 1.0, len(time_s)), each(-5.0, 5.0)
    return Motion(time_s, position, velocity, roll, pitch, heading)


def shared(name: str, starts: int) -> Flight:
    """Runs from evenly spaced starts of a shared flight."""
    flown = recorded(name, 1)
    frames = [(blind(frame), place) for frame, place in flown.placed()]
    first = np.linspace(0, len(frames) - FRAMES, starts).astype(int)
    return Flight(name, flown.site, flown.camera, [frames[k : k + FRAMES] for k in first])


def blind(frame: Frame) -> Frame:
    """The frame without what a kidnapped vehicle does not know."""
    return replace(frame, heading_deg=None, east_velocity_mps=None, north_velocity_mps=None)


def matcher_for(site: OrthoMap, camera: Camera, method: str) -> SceneMatcher:
    """A warm matcher."""
    matcher = SceneMatcher(site, camera, method, "cpu")
    matcher.warmup()
    return matcher


def fly(flight: Flight, matcher: SceneMatcher) -> dict[str, Any]:
    """Every run from its own start, and every frame alone: what the navigator's patience is worth.

    A fix is wrong that is off by more than 10 m and three of its own sigmas.
    """
    within, fixes, wrong, alone, alone_wrong, refused, times = 0, 0, 0, 0, 0, 0, []
    # NCC needs a heading.
    any_heading = {"heading_deg": 0.0, "heading_sigma_deg": 180.0} if matcher.method == "ncc" else {}
    for run in flight.runs:
        frames = [(replace(frame, **any_heading),) for frame, _ in run]
        results, spent_ms = answered(Navigator(matcher).update, frames)
        times += spent_ms
        fixed = [(fix, place) for fix, (_, place) in zip(results, run, strict=True) if isinstance(fix, Fix)]
        fixes, wrong = fixes + len(fixed), wrong + sum(is_false(*each) for each in fixed)
        within += any(isinstance(result, Fix) for result in results[:3])
        refused += not fixed
        single = matcher.locate(*frames[0])
        if isinstance(single, Fix):
            alone, alone_wrong = alone + 1, alone_wrong + is_false(single, run[0][1])
    return {
        "flight": flight.name,
        "method": matcher.method,
        "starts": len(flight.runs),
        "fixed within 3 frames": within,
        "never fixed": refused,
        "fixes": fixes,
        "wrong": wrong,
        "whole-map matches of first frames": alone,
        "wrong among them": alone_wrong,
        "median_ms": round(float(np.median(times)), 1),
        "max_ms": round(float(np.max(times)), 1),
    }


def rows(seeds: list[int], starts: int, names: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """Every flight by every method, over its own map and over another."""
    flights = [simulated(seed, starts, light) for seed in seeds for light in ("noon", "evening")]
    flights += [shared(name, starts) for name in names if (SHARED / name).is_dir()]
    other = town_site(max(seeds) + 1)
    for flight in flights:
        elsewhere = replace(flight, name=f"{flight.name} over another town", site=other)
        elsewhere = replace(elsewhere, runs=[[(f, np.full(2, FAR_M)) for f, _ in run] for run in flight.runs])
        for method in METHODS:
            yield fly(flight, matcher_for(flight.site, flight.camera, method))
            yield fly(elsewhere, matcher_for(other, flight.camera, method))


def main() -> None:
    """Fly and print."""
    parser = parser_on_one_thread(__doc__)
    parser.add_argument("--quick", action="store_true", help="one town and six starts")
    parser.add_argument("--starts", type=int, default=40, help="of each flight")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS), help="of the towns")
    options = parser.parse_args()
    seeds, starts, names = options.seeds, options.starts, RECORDED
    if options.quick:
        seeds, starts, names = seeds[:1], 6, RECORDED[:1]
    for row in rows(seeds, starts, names):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
