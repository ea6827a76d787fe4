"""``track`` and ``evaluate``: a flight in, track.csv, summary.json and figures out."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engine.budget import Budget
from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import parse_position, prepare_folder
from engine.errors import TelemetryError
from engine.formats.flight import Flight, open_flight
from engine.formats.telemetry import ground_amsl_m
from engine.formats.track import TrackRow, TrackWriter, read_track, track_row
from engine.formats.truth import read_truth
from engine.matcher import MatcherOptions, SceneMatcher
from engine.navigator import Navigator
from engine.orthomap import OrthoMap
from engine.report.figures import draw_figures
from engine.report.metrics import Ground, summarise
from engine.types import Truth


@dataclass(frozen=True, slots=True)
class Inputs:
    """The files of one flight."""

    map: Path
    surface: Path | None
    camera: Path
    frames: Path
    telemetry: Path | None
    truth: Path | None

    def find_truth(self) -> Path | None:
        """The truth that was named, else ``truth.csv`` beside the telemetry where there is one."""
        if self.truth is not None or self.telemetry is None:
            return self.truth
        beside = self.telemetry.with_name("truth.csv")
        return beside if beside.is_file() else None


def run_track(
    inputs: Inputs,
    out: Path,
    *,
    method: str,
    start: str | None = None,
    device: str = "auto",
    budget_ms: float | None = None,
    profile: str = "engine",
    force: bool = False,
) -> dict[str, Any]:
    """Follow a flight and write the output folder; returns the summary.

    Everything that can be wrong with the input is found before the output folder is made.
    """
    site = OrthoMap.open(inputs.map, surface=inputs.surface)
    camera = Camera.load(inputs.camera)
    flight = open_flight(inputs.frames, inputs.telemetry, camera)
    truth_path = inputs.find_truth()
    truth = read_truth(truth_path) if truth_path is not None else None
    prior = parse_position("--start", start) if start is not None else None
    budget = Budget(total_ms=budget_ms) if budget_ms is not None else None
    matcher = SceneMatcher(site, camera, method, device, MatcherOptions(profile=profile))
    prepare_folder(out, force)
    if flight.unused:
        console.say(f"{flight.unused} pictures have no row in the telemetry and are left out")
    matcher.warmup()
    rows = follow(flight, Navigator(matcher, prior, budget), out / "track.csv", budget, f"{profile} {method}")
    ground = Ground(site.ground_m, ground_amsl_m(flight.rows))
    settings = {
        "map": str(inputs.map.resolve()),
        "surface": str(inputs.surface.resolve()) if inputs.surface else None,
        "truth": str(truth_path.resolve()) if truth_path else None,
        "method": method,
        "profile": profile,
        "device": str(matcher.device),
        "origin": {"lat_deg": site.frame.lat_deg, "lon_deg": site.frame.lon_deg},
        "ground_m": ground.ground_m,
        "ground_amsl_m": ground.ground_amsl_m,
    }
    return conclude(out, rows, truth, site, ground, settings)


def follow(flight: Flight, navigator: Navigator, path: Path, budget: Budget | None, what: str) -> list[TrackRow]:
    """Every frame through the navigator, each row on disk as soon as it is known."""
    rows = []
    started = False
    with TrackWriter(path) as writer:
        for item in console.progress(flight, len(flight), what):
            # Only where the flight begins is the telemetry's position used: afterwards the fixes carry on.
            prior = None if started else item.prior
            begin = time.perf_counter()
            result = navigator.update(item.frame, prior)
            latency_ms = (time.perf_counter() - begin) * 1e3
            started = started or navigator.tracking
            met = None if budget is None else latency_ms <= budget.total_ms
            row = track_row(item.name, result, latency_ms=latency_ms, deadline_met=met)
            writer.write(row)
            rows.append(row)
    return rows


def conclude(
    out: Path,
    rows: list[TrackRow],
    truth: list[Truth] | None,
    site: OrthoMap,
    ground: Ground,
    settings: dict[str, Any],
) -> dict[str, Any]:
    """Write summary.json and the figures."""
    summary = summarise(rows, truth, frame=site.frame, ground=ground) | {"settings": settings}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    title = f"{settings['method']} ({settings['profile']} profile)"
    draw_figures(out, rows, truth, site=site, title=title, frame=site.frame, ground=ground)
    return summary


def run_evaluate(directory: Path, truth_path: Path | None) -> dict[str, Any]:
    """Score a finished track again.

    Raises:
        TelemetryError: the folder holds no finished track, or no truth is known.
    """
    rows = read_track(directory / "track.csv")
    try:
        settings = json.loads((directory / "summary.json").read_text(encoding="utf-8"))["settings"]
    except (OSError, ValueError, KeyError, TypeError):
        raise TelemetryError(f"{directory}: expected a summary.json that track wrote, found none") from None
    if truth_path is None:
        if settings.get("truth") is None:
            raise TelemetryError(f"{directory}: the track was made without truth; name one with --truth")
        truth_path = Path(settings["truth"])
    truth = read_truth(truth_path)
    site = OrthoMap.open(settings["map"], surface=settings["surface"])
    ground = Ground(settings["ground_m"], settings["ground_amsl_m"])
    return conclude(directory, rows, truth, site, ground, settings | {"truth": str(truth_path.resolve())})
