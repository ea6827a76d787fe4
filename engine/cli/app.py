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
ProfileOption = Annotated[
    str, typer.Option("--profile", metavar="engine|paper", help="paper is the paper's own recipe, the baseline.")
]
BudgetOption = Annotated[
    float | None,
    typer.Option("--budget-ms", metavar="MS", help="Time that one frame may take; later answers are refused."),
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace the results in a folder that exists.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Results as JSON on standard output.")]
ThreadsOption = Annotated[
    int, typer.Option("--threads", min=1, metavar="N", help="Threads of torch and OpenCV.", show_default=True)
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
        typer.Option("--telemetry", metavar="FILE", help="telemetry.csv; without it the photographs' EXIF."),
    ] = None,
    surface: SurfaceOption = None,
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="FILE", help="truth.csv; without it the one beside the telemetry."),
    ] = None,
    method: MethodOption = "ncc",
    start: Annotated[
        str | None,
        typer.Option("--start", metavar="LAT,LON[,SIGMA_M]", help="Where the flight begins, in degrees."),
    ] = None,
    device: DeviceOption = "auto",
    budget_ms: BudgetOption = None,
    profile: ProfileOption = "engine",
    threads: ThreadsOption = 1,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Follow a flight; track.csv and figures.

    Writes track.csv (one row a frame), summary.json and figures into the output folder. Without --start the
    flight begins at the first position in the telemetry, and where that has none, anywhere on the map.
    """
    from engine.cli.track import Inputs, Settings, run_track

    _threads(threads)
    inputs = Inputs(map_path, surface, camera, frames, telemetry, truth)
    settings = Settings(method=method, profile=profile, device=device, start=start, budget_ms=budget_ms)
    result = run_track(inputs, out, settings, force=force)
    console.report(result, as_json, title=f"{method} ({profile} profile) on {frames}", out=out)


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


@map_app.command("info")
def map_info(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")],
    surface: SurfaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Size, ground sample distance, CRS, bounds."""
    from engine.orthomap import OrthoMap

    console.facts(OrthoMap.open(map_path, surface=surface).info(), as_json, title=str(map_path))


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
