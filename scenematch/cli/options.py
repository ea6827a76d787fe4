"""Options that several commands share, what they name, and how they are typed again for the next command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scenematch.cli import console

if TYPE_CHECKING:
    from scenematch.files.corrections import Corrections
    from scenematch.runs.inputs import FlightFiles

MapOption = Annotated[Path, typer.Option("--map", metavar="FILE", help="GeoTIFF, or a picture with a world file.")]
FramesOption = Annotated[
    Path, typer.Option("--frames", metavar="DIR|VIDEO|BAG", help="Folder of pictures, a video, or a ROS bag.")
]
SurfaceOption = Annotated[
    Path | None, typer.Option("--surface", metavar="FILE", help="Surface model, a GeoTIFF of heights.")
]
MapSigmaOption = Annotated[
    float | None,
    typer.Option("--map-sigma-m", metavar="M", help="Georeferencing accuracy, per axis; else as the map says."),
]
MapBoundsOption = Annotated[
    str | None,
    typer.Option("--map-bounds", metavar="W,S,E,N", help="Edges of a bare picture, in degrees or in --map-crs."),
]
MapCrsOption = Annotated[
    str | None, typer.Option("--map-crs", metavar="EPSG:N", help="CRS of a map that names none.")
]
OptionalCameraOption = Annotated[
    Path | None,
    typer.Option("--camera", metavar="FILE", help="Calibration file; without it a bag's own, or EXIF."),
]
HfovOption = Annotated[
    float | None, typer.Option("--hfov-deg", metavar="DEG", help="Horizontal field of view, without --camera.")
]
MountOption = Annotated[
    str | None,
    typer.Option(
        "--mount",
        metavar="NAME",
        help="nadir, nadir-right, nadir-tail, nadir-left (where the top of the picture points), forward-45.",
    ),
]
CameraPitchOption = Annotated[
    float | None,
    typer.Option("--camera-pitch-deg", metavar="DEG", help="Of the camera: -90 looks straight down."),
]
ScaleCalibrationOption = Annotated[
    bool,
    typer.Option("--scale-calibration", help="Scale --camera to pictures of another size and the same shape."),
]
MethodOption = Annotated[
    str, typer.Option("--method", metavar="ncc|sift|auto|learned", help="auto is ncc, and sift where ncc refuses.")
]
WeightsOption = Annotated[
    list[Path] | None,
    typer.Option("--weights", metavar="FILE", help="Of method learned: once for each file that it takes."),
]
DeviceOption = Annotated[str, typer.Option("--device", metavar="auto|cpu|cuda", help="Where tensors live.")]
BudgetOption = Annotated[
    float | None,
    typer.Option("--budget-ms", metavar="MS", help="Time that one frame may take; later answers are refused."),
]
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Output folder, created by this run.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace the results in a folder that exists.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Results as JSON on standard output.")]
ThreadsOption = Annotated[
    int, typer.Option("--threads", min=1, metavar="N", help="Threads of torch and OpenCV.", show_default=True)
]

AnglesOption = Annotated[
    str, typer.Option("--angles", metavar="degrees|radians", help="Unit of the telemetry's angles.")
]
ColumnOption = Annotated[
    list[str] | None,
    typer.Option(
        "--column", metavar="NAME=[-][F*]NAME[+C]", help="A column made of another: roll_deg=-pitch_deg; repeated."
    ),
]
HeadingOffsetOption = Annotated[
    float, typer.Option("--heading-offset-deg", metavar="DEG", help="Added to the heading: the declination.")
]
HeightOffsetOption = Annotated[
    float, typer.Option("--height-offset-m", metavar="M", help="Added to the height above ground.")
]
TelemetryOffsetOption = Annotated[
    float,
    typer.Option("--telemetry-offset-s", metavar="S", help="Added to the telemetry's times, not the pictures'."),
]

SettingsOption = Annotated[
    Path | None,
    typer.Option("--settings", metavar="FILE", help="Settings from init; options given here count more."),
]
FirmwareOption = Annotated[
    str, typer.Option("--firmware", metavar="ardupilot|px4", help="What the autopilot runs.")
]
SystemIdOption = Annotated[
    int, typer.Option("--system-id", min=1, max=255, metavar="N", help="Of the vehicle; others are not heard.")
]
KeyOption = Annotated[
    Path | None, typer.Option("--key", metavar="FILE", help="Secret of MAVLink's signing; unsigned is ignored.")
]
ListenAnywhereOption = Annotated[
    bool, typer.Option("--listen-anywhere", help="Allow udpin on addresses that other machines reach.")
]
MessageOption = Annotated[
    str,
    typer.Option(
        "--message",
        metavar="NAME",
        help="What is sent; without it vision_position_estimate or global_position_sensor.",
    ),
]
MaxSigmaOption = Annotated[
    float, typer.Option("--max-sigma-m", metavar="M", help="A fix that is less certain is not sent.")
]
StartOption = Annotated[
    str | None,
    typer.Option("--start", metavar="LAT,LON[,SIGMA_M]", help="Where the flight begins, in degrees."),
]
DeadlineOption = Annotated[
    float, typer.Option("--deadline-ms", metavar="MS", help="Age by which a frame is answered.")
]
BridgeDeadlineOption = Annotated[
    float | None,
    typer.Option("--deadline-ms", metavar="MS", help="Age by which a frame is answered; 250, as autopilots take."),
]
SecondsOption = Annotated[
    float | None, typer.Option("--seconds", min=0.0, metavar="S", help="End after this time.")
]
OdometryOption = Annotated[
    bool, typer.Option("--odometry", help="Follow the pictures where the telemetry has no velocity.")
]
OptionalDeviceOption = Annotated[
    str | None, typer.Option("--device", metavar="auto|cpu|cuda", help="Where tensors live; auto unless given.")
]
ImageTopicOption = Annotated[
    str | None, typer.Option("--image-topic", metavar="NAME", help="Of a bag with pictures on several.")
]
EveryOption = Annotated[int, typer.Option("--every", metavar="N", help="Use one frame in N, from the first on.")]
OdometryTopicOption = Annotated[
    str | None,
    typer.Option("--odometry-topic", metavar="NAME", help="Of a bag: another odometry, that has the velocity."),
]
FrameStampsOption = Annotated[
    Path | None,
    typer.Option("--frame-stamps", metavar="FILE", help="With a log: a CSV with timestamp_ns and frame."),
]
LogOffsetOption = Annotated[
    float, typer.Option("--log-offset-s", metavar="S", help="With a log: added to the frames' own stamps.")
]
RerunOption = Annotated[
    Path | None, typer.Option("--rerun", metavar="FILE.rrd", help="Record the live view, for rerun's viewer.")
]
RerunConnectOption = Annotated[
    str | None,
    typer.Option("--rerun-connect", metavar="HOST:PORT", help="Show it live in a viewer of rerun that listens."),
]

RealtimeOption = Annotated[
    bool, typer.Option("--realtime", help="Match with a real-time priority and locked memory (Linux).")
]
NiceOption = Annotated[
    int | None,
    typer.Option("--nice", metavar="N", help="With --realtime: a nice value, -20 to -1, in place of SCHED_FIFO."),
]
CoresOption = Annotated[
    str | None, typer.Option("--cores", metavar="N,N", help="With --realtime: the cores that match.")
]


def use_threads(count: int) -> None:
    """Threads of torch and OpenCV."""
    from engine.runtime.threads import set_threads

    set_threads(count)


def corrections(
    angles: str, columns: list[str] | None, heading_offset_deg: float, height_offset_m: float, offset_s: float
) -> Corrections:
    """What is done to the telemetry, by the options above."""
    from scenematch.files.corrections import Corrections
    from scenematch.runs.renaming import renamed_in_errors

    with renamed_in_errors(columns="column", offset_s="telemetry_offset_s"):
        return Corrections(
            angles=angles, columns=tuple(columns or ()), heading_offset_deg=heading_offset_deg,
            height_offset_m=height_offset_m, offset_s=offset_s,
        )  # fmt: skip


def flight_options(files: FlightFiles, *, settings: Path | None = None, start: str | None = None) -> str:
    """The files of a flight with all that was given of them, as options of `check` and `track` are typed."""
    from scenematch.files.corrections import Corrections

    values: dict[str, object] = files.flat()
    given, nothing = files.corrections, Corrections()
    is_scaled = values.pop("scale_calibration")
    values |= {"corrections": None, "settings": settings, "start": start}
    values |= {"every": files.every if files.every > 1 else None, "log_offset_s": files.log_offset_s or None}
    for name in ("angles", "heading_offset_deg", "height_offset_m"):
        values[name] = getattr(given, name) if getattr(given, name) != getattr(nothing, name) else None
    values["telemetry_offset_s"] = given.offset_s or None
    columns = [f"--column {console.quoted(rule)}" for rule in given.columns]
    return " ".join([console.options(**values), *columns, *(["--scale-calibration"] if is_scaled else [])])


def after_track(
    files: FlightFiles, out: Path, fixes: int, *, settings: Path | None = None, start: str | None = None
) -> str:
    """What comes after a track: its export, or where it has no fix, what shows why."""
    if fixes:
        return f"export {console.quoted(out)} --format geojson"
    return f"check {flight_options(files, settings=settings, start=start)}"
