"""``demo``: the built-in flight, matched by both methods in both profiles, and the paper's Table I beside ours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from engine.cli import console
from engine.cli.arguments import prepare_folder
from engine.cli.track import Inputs, run_track
from engine.formats.flight import write_flight_folder
from engine.sim import Plan, plan_flight
from engine.types import Prior

PAPER_TABLE = {"ncc": (2.4, 40.0), "sift": (2.1, 121.0)}
"""Table I of the paper: RMS error in metres and execution time in milliseconds."""

START_SIGMA_M = 10.0
_FIRST_ROWS = (("ncc", "NCC"), ("sift", "SIFT"))


def run_demo(
    out: Path, *, frames: int | None, seed: int, device: str, force: bool, as_json: bool
) -> dict[str, Any]:
    """Fly, match, print Table I; the report folder holds the flight, one track a run, and table.json."""
    prepare_folder(out, force)
    console.say("drawing the town and the flight over it")
    inputs = write_flight(out / "flight", plan_flight(seed, frames=frames))
    results: dict[str, dict[str, Any]] = {}
    for method, _ in _FIRST_ROWS:
        for profile in ("paper", "engine"):
            name = f"{method}-{profile}"
            results[name] = run_track(
                inputs, out / name, method=method, device=device, profile=profile, force=True
            )
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
    for method, name in _FIRST_ROWS:
        rms_m, time_ms = PAPER_TABLE[method]
        rows.append((f"{name}, as published", f"{rms_m:.1f} m", f"{time_ms:.0f} ms", "", "", "", ""))
        for profile, what in (("paper", "paper's recipe, here"), ("engine", "scenematch")):
            rows.append((f"{name}, {what}", *_cells(results[f"{method}-{profile}"])))
    columns = ("Table I", "RMS (x,y)", "p50 latency", "p95", "availability", "false fixes", "height RMS")
    console.print_table(f"Built-in flight {seed}, {results['ncc-engine']['frames']} frames", columns, rows)


def _cells(summary: dict[str, Any]) -> tuple[str, ...]:
    def shown(key: str, form: str) -> str:
        return form.format(summary[key]) if summary.get(key) is not None else "-"

    latency = summary["latency_ms"]
    return (
        shown("rms_m", "{:.2f} m"),
        f"{latency['p50']:.1f} ms",
        f"{latency['p95']:.1f} ms",
        shown("availability", "{:.1%}"),
        shown("false_fixes", "{}"),
        shown("height_rms_m", "{:.2f} m"),
    )
