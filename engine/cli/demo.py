"""``demo``: the built-in flight, matched by both methods in both profiles, and the paper's Table I beside ours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from engine import device as devices
from engine.cli import console
from engine.cli.arguments import check_folder, prepare_folder
from engine.cli.track import Inputs, Settings, run_track
from engine.formats.flight import write_flight_folder
from engine.sim import Plan, plan_flight
from engine.types import Prior

PAPER_TABLE = {"ncc": (2.4, 40.0), "sift": (2.1, 121.0)}
"""Table I of the paper: RMS error in metres and execution time in milliseconds."""

START_SIGMA_M = 10.0
OWNED = ("table.json", "flight/frames/[0-9]*.jpg")
_PROFILES = (("paper", "paper's recipe"), ("engine", "scenematch"))
_COLUMNS = ("Table I", "RMS m", "p50 ms", "p95 ms", "fixed", "false", "height m")


def run_demo(
    out: Path, *, frames: int | None, seed: int, device: str, force: bool, as_json: bool
) -> dict[str, Any]:
    """Fly, match, print Table I; the report folder holds the flight, one track a run, and table.json."""
    devices.resolve(device)
    check_folder(out, force)
    console.say("drawing the town and the flight over it")
    plan = plan_flight(seed, frames=frames)
    prepare_folder(out, force, OWNED)
    inputs = write_flight(out / "flight", plan)
    results: dict[str, dict[str, Any]] = {}
    for method in PAPER_TABLE:
        for profile, _ in _PROFILES:
            name = f"{method}-{profile}"
            settings = Settings(method=method, profile=profile, device=device)
            results[name] = run_track(inputs, out / name, settings, force=force)
    (out / "table.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    if as_json:
        console.print_json(results)
    else:
        _print_table(results, seed)
    console.say(f"report: {out.resolve()}")
    return results


def write_flight(directory: Path, plan: Plan) -> Inputs:
    """Put the simulated flight on disk as any other flight is; it is then read back like one."""
    truth = plan.truth_rows()
    start = Prior(lat_deg=truth[0].lat_deg, lon_deg=truth[0].lon_deg, sigma_m=START_SIGMA_M)
    names = [f"{index:06d}.jpg" for index in range(len(plan))]
    write_flight_folder(
        directory,
        frames=console.progress(zip(names, plan.iter_frames(), strict=True), len(plan), "flying"),
        truth=truth,
        camera=plan.camera,
        ortho_rgb=plan.town.ortho,
        pixel_to_crs=plan.town.pixel_to_crs,
        crs_epsg=plan.town.crs_epsg,
        surface_m=plan.town.surface_m,
        start=start,
    )
    return Inputs(
        map=directory / "map.tif",
        surface=directory / "dsm.tif",
        camera=directory / "camera.yaml",
        frames=directory / "frames",
        telemetry=directory / "telemetry.csv",
        truth=directory / "truth.csv",
    )


def _print_table(results: dict[str, dict[str, Any]], seed: int) -> None:
    rows: list[tuple[str, ...]] = []
    for method, (rms_m, time_ms) in PAPER_TABLE.items():
        rows.append((f"{method.upper()}, as published", f"{rms_m:.1f}", f"{time_ms:.0f}", "", "", "", ""))
        for profile, what in _PROFILES:
            rows.append((f"{method.upper()}, {what}", *_cells(results[f"{method}-{profile}"])))
    console.print_table(f"Built-in flight {seed}, {results['ncc-engine']['frames']} frames", _COLUMNS, rows)


def _cells(summary: dict[str, Any]) -> tuple[str, ...]:
    def shown(key: str, form: str) -> str:
        return form.format(summary[key]) if summary.get(key) is not None else "-"

    latency = summary["latency_ms"]
    return (
        shown("rms_m", "{:.2f}"),
        f"{latency['p50']:.1f}",
        f"{latency['p95']:.1f}",
        shown("availability", "{:.1%}"),
        shown("false_fixes", "{}"),
        shown("height_rms_m", "{:.2f}"),
    )
