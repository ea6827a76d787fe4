"""The command `check`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console
from scenematch.cli.options import (
    AnglesOption,
    CameraPitchOption,
    ColumnOption,
    EveryOption,
    FramesOption,
    FrameStampsOption,
    HeadingOffsetOption,
    HeightOffsetOption,
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
    ScaleCalibrationOption,
    SettingsOption,
    StartOption,
    SurfaceOption,
    TelemetryOffsetOption,
    ThreadsOption,
    corrections,
    flight_options,
    use_threads,
)


def check(
    map_path: MapOption,
    frames: FramesOption,
    camera: OptionalCameraOption = None,
    hfov_deg: HfovOption = None,
    mount: MountOption = None,
    camera_pitch_deg: CameraPitchOption = None,
    scale_calibration: ScaleCalibrationOption = False,
    telemetry: Annotated[Path | None, typer.Option("--telemetry", metavar="FILE", help="As of track.")] = None,
    every: EveryOption = 1,
    image_topic: ImageTopicOption = None,
    odometry_topic: OdometryTopicOption = None,
    frame_stamps: FrameStampsOption = None,
    log_offset_s: LogOffsetOption = 0.0,
    angles: AnglesOption = "degrees",
    columns: ColumnOption = None,
    heading_offset_deg: HeadingOffsetOption = 0.0,
    height_offset_m: HeightOffsetOption = 0.0,
    telemetry_offset_s: TelemetryOffsetOption = 0.0,
    surface: SurfaceOption = None,
    map_sigma_m: MapSigmaOption = None,
    map_bounds: MapBoundsOption = None,
    map_crs: MapCrsOption = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="FILE", help="Positions that the map is held against.")
    ] = None,
    settings_path: SettingsOption = None,
    start: StartOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """What of a flight's inputs does not fit.

    Places a few pictures on the map without the telemetry, and says which change of units, signs, offsets, mount,
    focal length or clock would make the telemetry fit them. Takes the files of track.
    """
    from scenematch.runs.checking import as_rows, diagnose_flight
    from scenematch.runs.inputs import FlightFiles
    from scenematch.runs.settings import load_settings

    use_threads(threads)
    files = FlightFiles.from_flat(
        map=map_path, surface=surface, camera=camera, frames=frames, telemetry=telemetry, truth=truth,
        frame_stamps=frame_stamps, log_offset_s=log_offset_s, image_topic=image_topic,
        odometry_topic=odometry_topic, every=every, map_sigma_m=map_sigma_m, map_bounds=map_bounds,
        map_crs=map_crs, hfov_deg=hfov_deg, mount=mount, camera_pitch_deg=camera_pitch_deg,
        scale_calibration=scale_calibration,
        corrections=corrections(angles, columns, heading_offset_deg, height_offset_m, telemetry_offset_s),
    )  # fmt: skip
    names = load_settings(settings_path).telemetry_columns
    found = diagnose_flight(files, start, columns=names, progress=console.PROGRESS)
    if as_json:
        console.print_json(asdict(found))
    else:
        console.print_pairs(f"check of {frames}", as_rows(found, corrected=not files.corrections.changes_nothing))
    given = flight_options(files, settings=settings_path, start=start)
    console.next_step(f"track {given} --out out", as_json=as_json)
