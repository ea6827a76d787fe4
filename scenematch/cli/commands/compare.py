"""The command `compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console, tables
from scenematch.cli.options import (
    BudgetOption,
    CameraPitchOption,
    EveryOption,
    ForceOption,
    FramesOption,
    FrameStampsOption,
    HfovOption,
    ImageTopicOption,
    JsonOption,
    LogOffsetOption,
    MapBoundsOption,
    MapCrsOption,
    MapOption,
    MapSigmaOption,
    MountOption,
    OdometryTopicOption,
    OptionalCameraOption,
    OptionalDeviceOption,
    OutOption,
    ScaleCalibrationOption,
    StartOption,
    SurfaceOption,
    ThreadsOption,
    WeightsOption,
    flight_options,
    use_threads,
)


def compare(
    map_path: MapOption,
    frames: FramesOption,
    out: OutOption,
    camera: OptionalCameraOption = None,
    hfov_deg: HfovOption = None,
    mount: MountOption = None,
    camera_pitch_deg: CameraPitchOption = None,
    scale_calibration: ScaleCalibrationOption = False,
    telemetry: Annotated[
        Path | None, typer.Option("--telemetry", metavar="FILE", help="telemetry.csv, or a log; without it EXIF.")
    ] = None,
    every: EveryOption = 1,
    image_topic: ImageTopicOption = None,
    odometry_topic: OdometryTopicOption = None,
    frame_stamps: FrameStampsOption = None,
    log_offset_s: LogOffsetOption = 0.0,
    surface: SurfaceOption = None,
    map_sigma_m: MapSigmaOption = None,
    map_bounds: MapBoundsOption = None,
    map_crs: MapCrsOption = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="FILE", help="truth.csv; else the one beside the telemetry.")
    ] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option("--run", metavar="METHOD[/PROFILE]|FILE", help="Once a run; without it the paper's Table I."),
    ] = None,
    weights: WeightsOption = None,
    start: StartOption = None,
    device: OptionalDeviceOption = None,
    budget_ms: BudgetOption = None,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Several methods or settings over one flight.

    Follows the flight once a run, each into a folder of its own as track does, and compares them in one table
    and one chart.
    """
    from scenematch.runs.comparison import CHART, parse_runs
    from scenematch.runs.comparison import compare as compare_runs
    from scenematch.runs.inputs import FlightFiles
    from scenematch.runs.reporting import COMPARISON

    use_threads(threads)
    settings = parse_runs(runs or [], weights=weights or (), start=start, device=device, budget_ms=budget_ms)
    files = FlightFiles.from_flat(
        map=map_path, surface=surface, camera=camera, frames=frames, telemetry=telemetry, truth=truth,
        frame_stamps=frame_stamps, log_offset_s=log_offset_s, image_topic=image_topic,
        odometry_topic=odometry_topic, every=every, map_sigma_m=map_sigma_m, map_bounds=map_bounds,
        map_crs=map_crs, hfov_deg=hfov_deg, mount=mount, camera_pitch_deg=camera_pitch_deg,
        scale_calibration=scale_calibration,
    )  # fmt: skip
    results = compare_runs(files, out, settings, force=force, progress=console.PROGRESS)
    if as_json:
        console.print_json(results)
    else:
        tables.print_comparison(results, str(frames))
        console.say(f"written to {out}")
    # There is a page on as many runs as it has colours for, and always a chart.
    drawn = next((out / name for name in (COMPARISON, CHART) if (out / name).is_file()), out)
    settings_file = Path("scenematch.toml")
    following = f"init --out {settings_file}"
    if settings_file.exists():
        following = f"track {flight_options(files, settings=settings_file, start=start)} --out out"
    console.next_step(following, as_json=as_json, hint=f"open {console.quoted(drawn)}")
