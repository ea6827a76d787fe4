"""The commands that work on a flight: what each takes, and whom it calls. The work is in files of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from engine.cli import console
from engine.cli.options import (
    BudgetOption,
    CameraOption,
    DeviceOption,
    ForceOption,
    FrameStampsOption,
    ImageTopicOption,
    JsonOption,
    LogOffsetOption,
    MapOption,
    MapSigmaOption,
    MethodOption,
    OtherDeviceOption,
    OutOption,
    RerunConnectOption,
    RerunOption,
    SettingsOption,
    StartOption,
    SurfaceOption,
    ThreadsOption,
    use_threads,
)
from engine.errors import OptionError


def demo(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Report folder.")] = Path("demo-report"),
    frames: Annotated[
        int | None, typer.Option("--frames", min=2, metavar="N", help="Fly only the first N frames.")
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, metavar="N", help="Another number, another town and flight.")
    ] = 1,
    device: DeviceOption = "auto",
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Built-in flight, both methods, Table I.

    Draws a town and the paper's flight over it, follows it with NCC and SIFT, each in the paper's own recipe
    and as this engine does it, and prints the paper's Table I beside the results. Needs no data.
    """
    from engine.runs.demo import run_demo

    use_threads(threads)
    run_demo(out, frames=frames, seed=seed, device=device, force=force, as_json=as_json)


def track(
    map_path: MapOption,
    frames: Annotated[
        Path, typer.Option("--frames", metavar="DIR|VIDEO|BAG", help="Folder of pictures, a video, or a ROS bag.")
    ],
    out: OutOption,
    camera: Annotated[
        Path | None,
        typer.Option(
            "--camera", metavar="FILE", help="Calibration, a ROS camera_info YAML file; a bag may have its own."
        ),
    ] = None,
    telemetry: Annotated[
        Path | None,
        typer.Option(
            "--telemetry", metavar="FILE", help="telemetry.csv, or a log: .BIN, .ulg, .SRT, bag; without it EXIF."
        ),
    ] = None,
    image_topic: ImageTopicOption = None,
    frame_stamps: FrameStampsOption = None,
    log_offset: LogOffsetOption = 0.0,
    surface: SurfaceOption = None,
    map_sigma: MapSigmaOption = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", metavar="FILE", help="truth.csv, or a log; without it the one beside the telemetry."
        ),
    ] = None,
    settings_path: SettingsOption = None,
    method: Annotated[
        str | None,
        typer.Option("--method", metavar="ncc|sift|auto", help="ncc, unless the settings say otherwise."),
    ] = None,
    start: StartOption = None,
    device: OtherDeviceOption = None,
    budget_ms: BudgetOption = None,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile", metavar="engine|paper", help="paper is the paper's own recipe; engine unless told."
        ),
    ] = None,
    rerun: RerunOption = None,
    rerun_connect: RerunConnectOption = None,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Follow a flight; track.csv and figures.

    Writes track.csv (one row a frame), summary.json and figures into the output folder. Without --start the
    flight begins at the first position in the telemetry, and where that has none, anywhere on the map.
    """
    from engine.runs.tracking import FlightFiles, camera_or_bag, parse_clock, run_track, settings_from
    from engine.runs.watching import Watching

    use_threads(threads)
    clock = parse_clock(frame_stamps, log_offset)
    calibration = camera_or_bag(camera, frames)
    inputs = FlightFiles(map_path, surface, calibration, frames, telemetry, truth, clock, image_topic, map_sigma)
    settings = settings_from(
        settings_path, method=method, profile=profile, device=device, start=start, budget_ms=budget_ms
    )
    result = run_track(inputs, out, settings, force=force, watching=Watching(rerun, rerun_connect))
    console.report(result, as_json, title=f"{settings.method} ({settings.profile} profile) on {frames}", out=out)


def compare(
    map_path: MapOption,
    camera: CameraOption,
    frames: Annotated[
        Path, typer.Option("--frames", metavar="DIR|VIDEO|BAG", help="Folder of pictures, a video, or a ROS bag.")
    ],
    out: OutOption,
    telemetry: Annotated[
        Path | None, typer.Option("--telemetry", metavar="FILE", help="telemetry.csv, or a log; without it EXIF.")
    ] = None,
    image_topic: ImageTopicOption = None,
    frame_stamps: FrameStampsOption = None,
    log_offset: LogOffsetOption = 0.0,
    surface: SurfaceOption = None,
    map_sigma: MapSigmaOption = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="FILE", help="truth.csv; else the one beside the telemetry.")
    ] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option("--run", metavar="METHOD[/PROFILE]|FILE", help="Once a run; without it the paper's Table I."),
    ] = None,
    start: StartOption = None,
    device: OtherDeviceOption = None,
    budget_ms: BudgetOption = None,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Several methods or settings over one flight.

    Follows the flight once a run, each into a folder of its own as track does, and tells them apart in one table
    and one chart.
    """
    from engine.runs.comparison import parse_runs, print_comparison, run_compare
    from engine.runs.tracking import FlightFiles, parse_clock

    use_threads(threads)
    wanted = parse_runs(runs or [], start=start, device=device, budget_ms=budget_ms)
    clock = parse_clock(frame_stamps, log_offset)
    inputs = FlightFiles(map_path, surface, camera, frames, telemetry, truth, clock, image_topic, map_sigma)
    results = run_compare(inputs, out, wanted, force=force)
    if as_json:
        console.print_json(results)
    else:
        print_comparison(results, str(frames))
        console.say(f"written to {out}")


def init(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The file.")] = Path("scenematch.toml"),
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
) -> None:
    """Settings file with every option.

    Each with its unit, its default and what it means; track takes the file with --settings.
    """
    from engine.cli.init import run_init

    run_init(out, force=force)


def locate(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="One picture.")],
    map_path: MapOption,
    camera: CameraOption,
    surface: SurfaceOption = None,
    map_sigma: MapSigmaOption = None,
    height_agl: Annotated[
        float | None, typer.Option("--height-agl", metavar="M", help="Metres above the ground.")
    ] = None,
    heading: Annotated[
        float | None, typer.Option("--heading", metavar="DEG", help="Degrees clockwise from true north.")
    ] = None,
    roll: Annotated[float | None, typer.Option("--roll", metavar="DEG", help="Degrees, right side down.")] = None,
    pitch: Annotated[float | None, typer.Option("--pitch", metavar="DEG", help="Degrees, nose up.")] = None,
    near: Annotated[
        str | None,
        typer.Option("--near", metavar="LAT,LON[,SIGMA_M]", help="Search here; without it the whole map."),
    ] = None,
    method: MethodOption = "auto",
    device: DeviceOption = "auto",
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Find one picture on the map.

    Prints a fix and exits with 0, or prints why there is none and exits with 1.
    """
    from engine.runs.single_frame import Known, run_locate

    use_threads(threads)
    known = Known(height_agl, heading, roll, pitch, near)
    found = run_locate(
        image, map_path, camera, surface, map_sigma, known, method=method, device=device, as_json=as_json
    )
    raise typer.Exit(0 if found else 1)


def simulate(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Flight folder, made by this run.")],
    seed: Annotated[
        int, typer.Option("--seed", min=0, metavar="N", help="Another number, another town and flight.")
    ] = 1,
    frames: Annotated[
        int | None, typer.Option("--frames", min=1, metavar="N", help="Fly only the first N frames.")
    ] = None,
    condition: Annotated[
        str | None,
        typer.Option("--condition", metavar="NAME", help="Light, season and air of the frames; noon unless told."),
    ] = None,
    relief: Annotated[float, typer.Option("--relief-m", metavar="H", help="Height of a town's hills.")] = 0.0,
    map_path: Annotated[
        Path | None, typer.Option("--map", metavar="FILE", help="Your own map as the world, in place of a town.")
    ] = None,
    surface: SurfaceOption = None,
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="Fly by the engine's fixes, with GPS off.")
    ] = False,
    minutes: Annotated[
        float | None, typer.Option("--minutes", metavar="M", help="With --closed-loop: how long; 5 unless told.")
    ] = None,
    method: Annotated[
        str | None,
        typer.Option("--method", metavar="auto|ncc|sift", help="With --closed-loop; auto unless told."),
    ] = None,
    fault: Annotated[
        str | None,
        typer.Option("--fault", metavar="none|killed|shifted|frozen", help="With --closed-loop: what goes wrong."),
    ] = None,
    rerun: RerunOption = None,
    rerun_connect: RerunConnectOption = None,
    device: Annotated[
        str | None,
        typer.Option("--device", metavar="auto|cpu|cuda", help="With --closed-loop: where tensors live."),
    ] = None,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """A simulated flight with its truth.

    Writes a flight folder that track reads. With --closed-loop the vehicle steers by the engine's fixes, and the
    folder holds its track, estimate, figures and summary too.
    """
    from engine.cli.arguments import refuse_given
    from engine.runs.simulation import LoopSettings, WorldSettings, run_closed_loop, run_simulate
    from engine.runs.watching import Watching

    use_threads(threads)
    scene = WorldSettings(seed=seed, condition=condition, relief_m=relief, map=map_path, surface=surface)
    given = {
        "--minutes": minutes, "--method": method, "--fault": fault, "--rerun": rerun,
        "--rerun-connect": rerun_connect, "--device": device,
    }  # fmt: skip
    if not closed_loop:
        refuse_given(given, "--closed-loop")
    if closed_loop and frames is not None:
        raise OptionError("--frames: expected without --closed-loop, which has --minutes")
    if closed_loop:
        minutes = 5.0 if minutes is None else minutes
        loop = LoopSettings(
            minutes=minutes, method=method or "auto", fault=fault or "none", device=device or "auto"
        )
        facts = run_closed_loop(out, scene, loop, force=force, watching=Watching(rerun, rerun_connect))
    else:
        facts = run_simulate(out, scene, frames=frames, force=force)
    console.facts(facts, as_json, title=f"simulated flight {seed}")


def evaluate(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of track.")],
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="FILE", help="truth.csv; without it the one that track used.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score a finished track against truth.

    Prints the errors and rewrites the folder's summary.json and figures.
    """
    from engine.runs.tracking import run_evaluate

    console.report(run_evaluate(directory, truth), as_json, title=f"track in {directory}", out=directory)


def export(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of track.")],
    kind: Annotated[str, typer.Option("--format", metavar="gpx|geojson|kml|tum|nmea", help="What is written.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Without it track.FORMAT in the folder.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="FILE", help="Write this at the fixes' moments instead, to compare with."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """A finished track as GPX, GeoJSON, KML, TUM, NMEA.

    Refused frames leave gaps. Times of day are written where the frames' stamps are UTC.
    """
    from engine.runs.track_export import run_export

    console.facts(
        run_export(directory, kind, out, truth=truth, force=force), as_json, title=f"track in {directory}"
    )


def bag(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Flight folder.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE|DIR", help="The bag; a file X.bag for ros1.")],
    kind: Annotated[
        str | None,
        typer.Option(
            "--format", metavar="ros1|ros2-sqlite3|ros2-mcap", help="Without it ros1 for X.bag, else ros2-mcap."
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a bag that exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """A flight folder as a bag of ROS 1 or ROS 2.

    With pictures, calibration, telemetry and truth under the names that a camera driver and MAVROS use.
    """
    from engine.runs.bag_conversion import run_bag

    console.facts(run_bag(directory, out, kind, force=force), as_json, title=f"flight in {directory}")
