"""``demo``: the built-in flight, matched by both methods in both profiles, and the paper's Table I beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from engine.cli import console
from engine.cli.arguments import check_device, check_folder, prepare_folder
from engine.formats.flight import write_flight_folder
from engine.runs.comparison import CHART, COLUMNS, TABLE, USUAL, cells, parse_runs, run_compare
from engine.runs.tracking import FlightFiles, folder_inputs
from engine.sim import FlightPlan, plan_flight
from engine.sim.town import EXACT
from engine.values import Prior

PAPER_TABLE = {"ncc": (2.4, 40.0), "sift": (2.1, 121.0)}
"""Table I of the paper: RMS error in metres and execution time in milliseconds."""

START_SIGMA_M = 10.0
OWNED = (TABLE, CHART, "flight/frames/[0-9]*.jpg")


def run_demo(
    out: Path, *, frames: int | None, seed: int, device: str, force: bool, as_json: bool
) -> dict[str, Any]:
    """Fly, match, print Table I; the report folder holds the flight, and what ``compare`` writes."""
    check_device("--device", device)
    check_folder(out, force)
    console.say("drawing the town and the flight over it")
    plan = plan_flight(seed, frames=frames)
    prepare_folder(out, force, OWNED)
    inputs = write_flight(out / "flight", plan)
    results = run_compare(inputs, out, parse_runs(USUAL, device=device), force=True)
    if as_json:
        console.print_json(results)
    else:
        _print_table(results, seed)
    console.say(f"report: {out.resolve()}")
    return results


def write_flight(directory: Path, plan: FlightPlan) -> FlightFiles:
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
        georeference_sigma_m=EXACT,
        slope_sigma_deg=EXACT,
    )
    return folder_inputs(directory)


def _print_table(results: dict[str, dict[str, Any]], seed: int) -> None:
    rows: list[tuple[str, ...]] = []
    for method, (rms_m, time_ms) in PAPER_TABLE.items():
        rows.append((f"{method.upper()}, as published", f"{rms_m:.1f}", f"{time_ms:.0f}", *[""] * 5))
        for run, what in ((f"{method}-paper", "paper's recipe"), (f"{method}-engine", "scenematch")):
            rows.append((f"{method.upper()}, {what}", *cells(results[run])))
    title = f"Built-in flight {seed}, {results['ncc-engine']['frames']} frames"
    console.print_table(title, ("Table I", *COLUMNS), rows)
