"""The typer application: one command a function; what takes more than a few lines lives in a file of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click
import typer
from typer.main import get_command

from engine.cli import console
from engine.errors import EngineError, OptionError

app = typer.Typer(
    name="scenematch",
    help="Position fixes for a drone without GNSS: a downward camera matched against a georeferenced map.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
)
map_app = typer.Typer(help="Facts about a map.", no_args_is_help=True)
app.add_typer(map_app, name="map")

MapOption = Annotated[Path, typer.Option("--map", help="GeoTIFF, or a picture with a world file.")]
SurfaceOption = Annotated[Path | None, typer.Option("--surface", help="Surface model (GeoTIFF).")]
CameraOption = Annotated[Path, typer.Option("--camera", help="ROS camera_info YAML.")]
MethodOption = Annotated[str, typer.Option("--method", help="ncc, sift or auto.")]
DeviceOption = Annotated[str, typer.Option("--device", help="auto, cpu or cuda.")]
ProfileOption = Annotated[str, typer.Option("--profile", help="engine, or paper for the paper's own recipe.")]
BudgetOption = Annotated[float | None, typer.Option("--budget-ms", help="Time that one frame may take.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Write into an output folder that exists.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Results as JSON on standard output.")]
ThreadsOption = Annotated[int | None, typer.Option("--threads", help="Threads for torch and OpenCV.")]


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code."""
    try:
        result = get_command(app).main(args=arguments, prog_name="scenematch", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.exceptions.NoArgsIsHelpError as error:
        console.say(error.format_message())
        return 2
    except click.UsageError as error:
        hint = f" (see scenematch {error.ctx.info_name} --help)" if error.ctx and error.ctx.parent else ""
        console.say(f"scenematch: {error.format_message()}{hint}")
        return 2
    except OptionError as error:
        console.say(f"scenematch: {error}")
        return 2
    except (EngineError, OSError) as error:
        console.say(f"scenematch: {error}")
        return 1
    except (KeyboardInterrupt, click.Abort):
        console.say("scenematch: interrupted")
        return 130


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Report folder.")] = Path("demo-report"),
    frames: Annotated[int | None, typer.Option("--frames", min=2, help="Fly only the first N frames.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Another town and flight.")] = 1,
    device: DeviceOption = "auto",
    threads: ThreadsOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Fly the built-in flight with both methods and print the paper's Table I beside ours."""
    from engine.cli.demo import run_demo

    _threads(threads)
    run_demo(out, frames=frames, seed=seed, device=device, force=force, as_json=as_json)


@app.command()
def track(
    map_path: MapOption,
    camera: CameraOption,
    frames: Annotated[Path, typer.Option("--frames", help="Folder of pictures, or a video.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder; made, never overwritten without --force.")],
    telemetry: Annotated[Path | None, typer.Option("--telemetry", help="telemetry.csv.")] = None,
    surface: SurfaceOption = None,
    truth: Annotated[
        Path | None, typer.Option("--truth", help="truth.csv; else the one beside the telemetry.")
    ] = None,
    method: MethodOption = "ncc",
    start: Annotated[str | None, typer.Option("--start", help="LAT,LON[,SIGMA_M] of the first frame.")] = None,
    device: DeviceOption = "auto",
    budget_ms: BudgetOption = None,
    profile: ProfileOption = "engine",
    threads: ThreadsOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Follow a flight: one row a frame in track.csv, summary.json and figures."""
    from engine.cli.track import Inputs, run_track

    _threads(threads)
    inputs = Inputs(map_path, surface, camera, frames, telemetry, truth)
    result = run_track(
        inputs, out, method=method, start=start, device=device, budget_ms=budget_ms, profile=profile, force=force
    )
    console.report(result, as_json, title=f"{method} on {frames}", out=out)


@app.command()
def locate(
    image: Annotated[Path, typer.Argument(help="One picture.")],
    map_path: MapOption,
    camera: CameraOption,
    surface: SurfaceOption = None,
    height_agl: Annotated[float | None, typer.Option("--height-agl", help="Metres above ground.")] = None,
    heading: Annotated[float | None, typer.Option("--heading", help="Degrees clockwise from true north.")] = None,
    roll: Annotated[float | None, typer.Option("--roll", help="Degrees, right side down.")] = None,
    pitch: Annotated[float | None, typer.Option("--pitch", help="Degrees, nose up.")] = None,
    near: Annotated[str | None, typer.Option("--near", help="LAT,LON[,SIGMA_M]; else the whole map.")] = None,
    method: MethodOption = "auto",
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Find one picture on the map; prints a fix, or why there is none (exit 1)."""
    from engine.cli.locate import run_locate

    found = run_locate(
        image,
        map_path,
        camera,
        surface,
        attitude=(height_agl, heading, roll, pitch),
        near=near,
        method=method,
        device=device,
        as_json=as_json,
    )
    raise typer.Exit(0 if found else 1)


@app.command()
def evaluate(
    directory: Annotated[Path, typer.Argument(help="Output folder of track.")],
    truth: Annotated[Path | None, typer.Option("--truth", help="truth.csv; else the one that track used.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Score a finished track against truth; rewrites its summary.json and figures."""
    from engine.cli.track import run_evaluate

    console.report(run_evaluate(directory, truth), as_json, title=f"track in {directory}", out=directory)


@map_app.command("info")
def map_info(
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="GeoTIFF, or a picture with a world file.")],
    surface: SurfaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """What a map is: size, ground sample distance, CRS, bounds, nodata."""
    from engine.orthomap import OrthoMap

    console.facts(OrthoMap.open(map_path, surface=surface).info(), as_json, title=str(map_path))


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """Versions, devices, FFT backend, and what is missing."""
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
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")
    ] = False,
) -> None:
    """Options before the command."""


def _threads(count: int | None) -> None:
    if count is not None:
        from engine.device import set_threads

        set_threads(count)
