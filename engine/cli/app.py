"""The typer application: one command a function; what takes more than a few lines lives in a file of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.main import get_command

from engine.cli import console
from engine.errors import EngineError, OptionError

app = typer.Typer(
    name="scenematch",
    help="Position fixes for a drone without GNSS: a downward camera matched against a georeferenced map.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
map_app = typer.Typer(help="Facts about a map.")
app.add_typer(map_app, name="map")
bridge_app = typer.Typer(help="Live, beside an autopilot.")
app.add_typer(bridge_app, name="bridge")

# typer brings its own copy of click, or depends on click: what it raises is found by descent, not by import.
_UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
INTERRUPTED = 130

MapOption = Annotated[Path, typer.Option("--map", metavar="FILE", help="GeoTIFF, or a picture with a world file.")]
SurfaceOption = Annotated[
    Path | None, typer.Option("--surface", metavar="FILE", help="Surface model, a GeoTIFF of heights.")
]
CameraOption = Annotated[
    Path, typer.Option("--camera", metavar="FILE", help="Calibration, a ROS camera_info YAML file.")
]
MethodOption = Annotated[
    str, typer.Option("--method", metavar="ncc|sift|auto", help="auto is ncc, and sift where ncc refuses.")
]
DeviceOption = Annotated[str, typer.Option("--device", metavar="auto|cpu|cuda", help="Where tensors live.")]
BudgetOption = Annotated[
    float | None,
    typer.Option("--budget-ms", metavar="MS", help="Time that one frame may take; later answers are refused."),
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace the results in a folder that exists.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Results as JSON on standard output.")]
ThreadsOption = Annotated[
    int, typer.Option("--threads", min=1, metavar="N", help="Threads of torch and OpenCV.", show_default=True)
]

SettingsOption = Annotated[
    Path | None,
    typer.Option("--settings", metavar="FILE", help="Settings from init; options given here count more."),
]
FirmwareOption = Annotated[
    str, typer.Option("--firmware", metavar="ardupilot|px4", help="What the autopilot runs.")
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


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code."""
    try:
        result = get_command(app).main(args=arguments or ["--help"], prog_name="scenematch", standalone_mode=False)
    except _UsageError as error:
        return _fail(_usage(error), 2)
    except OptionError as error:
        return _fail(str(error), 2)
    except EngineError as error:
        return _fail(str(error), 1)
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error), 1)
    except (KeyboardInterrupt, typer.Abort):
        result = INTERRUPTED
    if result == INTERRUPTED:
        return _fail("interrupted", INTERRUPTED)
    if not arguments:
        return 2
    return result if isinstance(result, int) else 0


def _usage(error: Any) -> str:
    """What was wrong with the command line, and where help is."""
    where = error.ctx.command_path if error.ctx is not None else "scenematch"
    return f"{error.format_message().rstrip('.')} (see {where} --help)"


def _fail(text: str, code: int) -> int:
    console.say(f"scenematch: {text}")
    return code


@app.command()
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
    from engine.cli.demo import run_demo

    _threads(threads)
    run_demo(out, frames=frames, seed=seed, device=device, force=force, as_json=as_json)


@app.command()
def track(
    map_path: MapOption,
    camera: CameraOption,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR|VIDEO", help="Folder of pictures, or a video.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Output folder, made by this run.")],
    telemetry: Annotated[
        Path | None,
        typer.Option(
            "--telemetry", metavar="FILE", help="telemetry.csv, or a log: .BIN, .ulg, .SRT; without it EXIF."
        ),
    ] = None,
    frame_stamps: Annotated[
        Path | None,
        typer.Option("--frame-stamps", metavar="FILE", help="With a log: a CSV with timestamp_ns and frame."),
    ] = None,
    log_offset: Annotated[
        float, typer.Option("--log-offset-s", metavar="S", help="With a log: added to the frames' own stamps.")
    ] = 0.0,
    surface: SurfaceOption = None,
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
    start: Annotated[
        str | None,
        typer.Option("--start", metavar="LAT,LON[,SIGMA_M]", help="Where the flight begins, in degrees."),
    ] = None,
    device: Annotated[
        str | None, typer.Option("--device", metavar="auto|cpu|cuda", help="Where tensors live; auto unless told.")
    ] = None,
    budget_ms: BudgetOption = None,
    profile: Annotated[
        str | None,
        typer.Option(
            "--profile", metavar="engine|paper", help="paper is the paper's own recipe; engine unless told."
        ),
    ] = None,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Follow a flight; track.csv and figures.

    Writes track.csv (one row a frame), summary.json and figures into the output folder. Without --start the
    flight begins at the first position in the telemetry, and where that has none, anywhere on the map.
    """
    from engine.cli.track import Inputs, run_track, settings_from
    from engine.formats.logs import LogClock

    _threads(threads)
    clock = LogClock(frame_stamps, log_offset) if frame_stamps is not None or log_offset else None
    inputs = Inputs(map_path, surface, camera, frames, telemetry, truth, clock)
    settings = settings_from(
        settings_path, method=method, profile=profile, device=device, start=start, budget_ms=budget_ms
    )
    result = run_track(inputs, out, settings, force=force)
    console.report(result, as_json, title=f"{settings.method} ({settings.profile} profile) on {frames}", out=out)


@app.command()
def compare(
    map_path: MapOption,
    camera: CameraOption,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR|VIDEO", help="Folder of pictures, or a video.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Output folder, made by this run.")],
    telemetry: Annotated[
        Path | None, typer.Option("--telemetry", metavar="FILE", help="telemetry.csv, or a log; without it EXIF.")
    ] = None,
    surface: SurfaceOption = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="FILE", help="truth.csv; else the one beside the telemetry.")
    ] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option("--run", metavar="METHOD[/PROFILE]|FILE", help="Once a run; without it the paper's Table I."),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option("--start", metavar="LAT,LON[,SIGMA_M]", help="Where the flight begins, in degrees."),
    ] = None,
    device: Annotated[
        str | None, typer.Option("--device", metavar="auto|cpu|cuda", help="Where tensors live; auto unless told.")
    ] = None,
    budget_ms: BudgetOption = None,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Several methods or settings over one flight.

    Follows the flight once a run, each into a folder of its own as track does, and tells them apart in one table
    and one chart.
    """
    from engine.cli.compare import parse_runs, print_comparison, run_compare
    from engine.cli.track import Inputs

    _threads(threads)
    wanted = parse_runs(runs or [], start=start, device=device, budget_ms=budget_ms)
    results = run_compare(Inputs(map_path, surface, camera, frames, telemetry, truth), out, wanted, force=force)
    if as_json:
        console.print_json(results)
    else:
        print_comparison(results, str(frames))
        console.say(f"written to {out}")


@app.command()
def init(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The file.")] = Path("scenematch.toml"),
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
) -> None:
    """Settings file with every option.

    Each with its unit, its default and what it means; track takes the file with --settings.
    """
    from engine.cli.init import run_init

    run_init(out, force=force)


@app.command()
def locate(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="One picture.")],
    map_path: MapOption,
    camera: CameraOption,
    surface: SurfaceOption = None,
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
    from engine.cli.locate import Known, run_locate

    _threads(threads)
    known = Known(height_agl, heading, roll, pitch, near)
    found = run_locate(image, map_path, camera, surface, known, method=method, device=device, as_json=as_json)
    raise typer.Exit(0 if found else 1)


@app.command()
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
    from engine.cli.track import run_evaluate

    console.report(run_evaluate(directory, truth), as_json, title=f"track in {directory}", out=directory)


@app.command()
def export(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Output folder of track.")],
    kind: Annotated[str, typer.Option("--format", metavar="gpx|geojson|kml|tum|nmea", help="What is written.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Without it track.FORMAT in the folder.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """A finished track as GPX, GeoJSON, KML, TUM, NMEA.

    Refused frames leave gaps. Times of day are written where the frames' stamps are UTC.
    """
    from engine.cli.export import run_export

    console.facts(run_export(directory, kind, out, force=force), as_json, title=f"track in {directory}")


@map_app.command("info")
def map_info(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")],
    surface: SurfaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Size, ground sample distance, CRS, bounds."""
    from engine.orthomap import OrthoMap

    console.facts(OrthoMap.open(map_path, surface=surface).info(), as_json, title=str(map_path))


@map_app.command("audit")
def map_audit(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Output folder, made by this run.")],
    surface: SurfaceOption = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", metavar="FILE", help="Calibration; without it 300 x 300 px with 60 degrees."),
    ] = None,
    height_agl: Annotated[
        float | None, typer.Option("--height-agl", metavar="M", help="Metres above the ground; 150 unless told.")
    ] = None,
    route: Annotated[
        Path | None,
        typer.Option("--route", metavar="FILE", help="GeoJSON LineString, or a QGroundControl .plan."),
    ] = None,
    other: Annotated[
        Path | None,
        typer.Option("--other", metavar="FILE", help="The same ground at another date; finds what is stale."),
    ] = None,
    sigma: Annotated[
        float, typer.Option("--sigma-m", metavar="M", help="How well the position is known before a match.")
    ] = 10.0,
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Where frames can be matched, and where not.

    Writes matchability.tif (probability of a fix by NCC), audit.png and summary.json. With --route the
    availability along it is predicted, and its poor stretches are listed.
    """
    from engine.cli.audit import Inputs, run_audit

    _threads(threads)
    inputs = Inputs(map_path, surface, camera, route, other, height_agl)
    run_audit(inputs, out, sigma_m=sigma, force=force, as_json=as_json)


@bridge_app.command("mavlink")
def bridge_mavlink(
    connect: Annotated[
        str,
        typer.Option(
            "--connect",
            metavar="LINK",
            help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD.",
        ),
    ],
    map_path: MapOption,
    camera: CameraOption,
    surface: SurfaceOption = None,
    frames: Annotated[
        Path | None,
        typer.Option("--frames", metavar="DIR|VIDEO", help="Pictures to play at their own pace."),
    ] = None,
    telemetry: Annotated[
        Path | None, typer.Option("--telemetry", metavar="FILE", help="telemetry.csv, whose stamps set that pace.")
    ] = None,
    rate: Annotated[
        float, typer.Option("--rate-hz", metavar="HZ", help="The pace of pictures without stamps.")
    ] = 10.0,
    source: Annotated[
        str | None, typer.Option("--camera-source", metavar="N|URL", help="A camera or stream, by OpenCV.")
    ] = None,
    grab: Annotated[
        float,
        typer.Option("--exposure-to-grab-ms", metavar="MS", help="How long its pictures take to get here."),
    ] = 0.0,
    firmware: FirmwareOption = "ardupilot",
    message: MessageOption = "",
    max_sigma: MaxSigmaOption = 10.0,
    system_id: Annotated[
        int, typer.Option("--system-id", min=1, max=255, metavar="N", help="Of the vehicle; others are not heard.")
    ] = 1,
    key: Annotated[
        Path | None,
        typer.Option("--key", metavar="FILE", help="Secret of MAVLink's signing; unsigned is ignored."),
    ] = None,
    listen_anywhere: Annotated[
        bool, typer.Option("--listen-anywhere", help="Allow udpin on addresses that other machines reach.")
    ] = False,
    set_origin: Annotated[
        bool, typer.Option("--set-origin/--no-set-origin", help="Give an autopilot without an origin the map's.")
    ] = True,
    origin_alt: Annotated[
        float | None,
        typer.Option("--origin-alt-m", metavar="M", help="Its height above sea level; else the map's ground."),
    ] = None,
    use_velocity: Annotated[
        bool, typer.Option("--velocity/--no-velocity", help="Whether the autopilot's velocity is believed.")
    ] = True,
    method: MethodOption = "auto",
    start: Annotated[
        str | None,
        typer.Option("--start", metavar="LAT,LON[,SIGMA_M]", help="Where the flight begins, in degrees."),
    ] = None,
    device: DeviceOption = "auto",
    deadline: Annotated[
        float, typer.Option("--deadline-ms", metavar="MS", help="Age by which a frame is answered.")
    ] = 121.0,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.0, metavar="S", help="End after this time.")
    ] = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Fixes to an autopilot by MAVLink.

    Reads attitude, height and velocity from the autopilot and sends it the fixes of a camera or of pictures
    played at their own pace, until they end.
    """
    from engine.cli.bridge import Inputs, Matching, Wire, run_bridge

    _threads(threads)
    inputs = Inputs(map_path, surface, camera, frames, telemetry, source, rate, grab)
    wire = Wire(
        connect=connect, listen_anywhere=listen_anywhere, system_id=system_id, key=key, firmware=firmware,
        message=message, max_sigma_m=max_sigma, set_origin=set_origin, origin_alt_m=origin_alt,
        use_velocity=use_velocity,
    )  # fmt: skip
    matching = Matching(method=method, device=device, start=start, deadline_ms=deadline, seconds=seconds)
    run_bridge(inputs, wire, matching, as_json=as_json)


@bridge_app.command("mavlink-params")
def bridge_mavlink_params(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Parameter file, made by this run.")],
    firmware: FirmwareOption = "ardupilot",
    message: MessageOption = "",
    delay: Annotated[
        int, typer.Option("--delay-ms", metavar="MS", help="From capture to arrival; the bridge prints it.")
    ] = 100,
    max_sigma: MaxSigmaOption = 10.0,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
) -> None:
    """Parameters for an autopilot.

    Writes the file that tells ArduPilot or PX4 to fly by the bridge's fixes.
    """
    from engine.cli.bridge import write_parameters

    write_parameters(firmware, message, out, delay_ms=delay, max_sigma_m=max_sigma, force=force)


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """Versions, devices, what is missing."""
    from engine.cli.doctor import examine

    facts, healthy = examine()
    console.facts(facts, as_json, title="scenematch doctor")
    raise typer.Exit(0 if healthy else 1)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(version("scenematch"))
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Options before the command."""


def _threads(count: int) -> None:
    from engine.device import set_threads

    set_threads(count)
