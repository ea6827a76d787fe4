"""The command `track`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console, tables
from scenematch.cli.options import (
    AnglesOption,
    BudgetOption,
    CameraPitchOption,
    ColumnOption,
    EveryOption,
    ForceOption,
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
    OdometryOption,
    OdometryTopicOption,
    OptionalCameraOption,
    OptionalDeviceOption,
    OutOption,
    RerunConnectOption,
    RerunOption,
    ScaleCalibrationOption,
    SettingsOption,
    StartOption,
    SurfaceOption,
    TelemetryOffsetOption,
    ThreadsOption,
    WeightsOption,
    after_track,
    corrections,
    use_threads,
)


def track(
    map_path: MapOption,
    frames: FramesOption,
    out: OutOption,
    camera: OptionalCameraOption = None,
    hfov_deg: HfovOption = None,
    mount: MountOption = None,
    camera_pitch_deg: CameraPitchOption = None,
    scale_calibration: ScaleCalibrationOption = False,
    telemetry: Annotated[
        Path | None,
        typer.Option(
            "--telemetry",
            metavar="FILE",
            help="telemetry.csv, or a log: .BIN, .ulg, .SRT, bag; else a video's .SRT, or EXIF.",
        ),
    ] = None,
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
        Path | None,
        typer.Option(
            "--truth", metavar="FILE", help="truth.csv, a log or photographs; else the one beside the telemetry."
        ),
    ] = None,
    settings_path: SettingsOption = None,
    method: Annotated[
        str | None,
        typer.Option("--method", metavar="ncc|sift|auto|learned", help="ncc, unless the settings say otherwise."),
    ] = None,
    weights: WeightsOption = None,
    start: StartOption = None,
    odometry: OdometryOption = False,
    device: OptionalDeviceOption = None,
    budget_ms: BudgetOption = None,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile", metavar="engine|paper", help="paper is the paper's own recipe; engine unless given."
        ),
    ] = None,
    recording: RerunOption = None,
    viewer: RerunConnectOption = None,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Follow a flight; track.csv and figures.

    Writes track.csv (one row a frame), summary.json and figures into the output folder. Without --start the
    flight begins at the first position in the telemetry, and where that has none, anywhere on the map.
    """
    from scenematch.runs.inputs import FlightFiles
    from scenematch.runs.live_viewing import LiveViewTarget
    from scenematch.runs.settings import load_settings
    from scenematch.runs.tracking import track as track_flight

    use_threads(threads)
    files = FlightFiles.from_flat(
        map=map_path, surface=surface, camera=camera, frames=frames, telemetry=telemetry, truth=truth,
        frame_stamps=frame_stamps, log_offset_s=log_offset_s, image_topic=image_topic,
        odometry_topic=odometry_topic, every=every, map_sigma_m=map_sigma_m, map_bounds=map_bounds,
        map_crs=map_crs, hfov_deg=hfov_deg, mount=mount, camera_pitch_deg=camera_pitch_deg,
        scale_calibration=scale_calibration,
        corrections=corrections(angles, columns, heading_offset_deg, height_offset_m, telemetry_offset_s),
    )  # fmt: skip
    settings = load_settings(
        settings_path, weights=weights or (), method=method, profile=profile, device=device, start=start,
        budget_ms=budget_ms, odometry=odometry,
    )  # fmt: skip
    live_view = LiveViewTarget(recording, viewer)
    summary = track_flight(files, out, settings, force=force, live_view=live_view, progress=console.PROGRESS)
    title = f"{settings.method} ({settings.profile} profile) on {frames}"
    tables.print_summary(summary, as_json, title=title, out=out)
    page = f"open {out / 'report.html'}"
    following = after_track(files, out, summary["fixes"], settings=settings_path, start=start)
    console.next_step(following, as_json=as_json, hint=page)
