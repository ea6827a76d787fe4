"""Options that several commands share, the objects they build, and how to print them for the next command."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from scenematch.cli import console
from scenematch.cli.argument_names import name_settings

if TYPE_CHECKING:
    from scenematch.runs.cameras import CameraInput
    from scenematch.runs.inputs import FlightFiles
    from scenematch.runs.live_viewing import LiveViewTarget
    from scenematch.runs.map_input import MapInput
    from scenematch.runs.settings import Settings

INPUT, MAP, OUTPUT, EXPERT = "Input", "Map", "Output", "Expert"
"""Panels of the help."""

MapOption = Annotated[
    Path,
    typer.Option("--map", metavar="FILE", help="GeoTIFF, or a picture with a world file.", rich_help_panel=MAP),
]
SurfaceOption = Annotated[
    Path | None,
    typer.Option("--surface", metavar="FILE", help="Surface model, a GeoTIFF of heights.", rich_help_panel=MAP),
]
FramesOption = Annotated[
    Path,
    typer.Option(
        "--frames",
        metavar="DIR|VIDEO|BAG",
        help="Folder of pictures, a video, or a ROS bag.",
        rich_help_panel=INPUT,
    ),
]
CameraOption = Annotated[
    Path | None,
    typer.Option(
        "--camera",
        metavar="FILE",
        help="Calibration file (default: from the bag, the topic or EXIF).",
        rich_help_panel=INPUT,
    ),
]
HfovOption = Annotated[
    float | None,
    typer.Option(
        "--hfov-deg",
        metavar="DEG",
        help="Horizontal field of view, instead of --camera.",
        rich_help_panel=INPUT,
    ),
]
MountOption = Annotated[
    str | None,
    typer.Option(
        "--mount",
        metavar="NAME",
        help="nadir (the picture's top towards the nose), nadir-right, nadir-tail, nadir-left, or forward-45.",
        rich_help_panel=INPUT,
    ),
]
TelemetryOption = Annotated[
    Path | None,
    typer.Option(
        "--telemetry",
        metavar="FILE",
        help="telemetry.csv, or a log: .BIN, .ulg, .SRT, bag (default: the video's .SRT, or EXIF).",
        rich_help_panel=INPUT,
    ),
]
TruthOption = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="FILE",
        help="truth.csv, a log or photographs (default: truth.csv beside the telemetry).",
        rich_help_panel=INPUT,
    ),
]
CorrectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--correct",
        metavar="NAME=VALUE",
        help="Correct the telemetry as check suggests: heading_offset_deg=3, roll_deg=-pitch_deg; repeatable.",
        rich_help_panel=INPUT,
    ),
]
StartOption = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="LAT,LON[,SIGMA_M]",
        help="Where the flight begins (default: the telemetry's first position, or anywhere on the map).",
        rich_help_panel=INPUT,
    ),
]
MethodOption = Annotated[
    str | None,
    typer.Option(
        "--method", metavar="auto|ncc|sift|learned", help="auto: ncc and sift, each checking the other (default)."
    ),
]
DeviceOption = Annotated[
    str | None,
    typer.Option(
        "--device",
        metavar="auto|cpu|cuda",
        help="Device to compute on (default: auto).",
        rich_help_panel=EXPERT,
    ),
]
SettingsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--settings",
        metavar="FILE|NAME=VALUE",
        help="Settings as `doctor --settings` lists them; repeatable.",
        rich_help_panel=EXPERT,
    ),
]
OutOption = Annotated[
    Path,
    typer.Option("--out", metavar="DIR", help="Output folder to create.", rich_help_panel=OUTPUT),
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing results.", rich_help_panel=OUTPUT)]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Results as JSON on standard output.", rich_help_panel=OUTPUT)
]
RerunOption = Annotated[
    list[str] | None,
    typer.Option(
        "--rerun",
        metavar="FILE.rrd|HOST:PORT",
        help="Record the live view to a file, or show it in a running rerun viewer; repeat for both.",
        rich_help_panel=OUTPUT,
    ),
]


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """The map."""

    map: MapOption
    surface: SurfaceOption = None

    def map_input(self, settings: Settings) -> MapInput:
        """The map combined with its settings."""
        from scenematch.runs.map_input import MapInput

        rest = table(settings, "input").of(MapInput)
        return MapInput(self.map, surface=self.surface, **rest)


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """The camera."""

    camera: CameraOption = None
    hfov_deg: HfovOption = None
    mount: MountOption = None

    def camera_input(self, settings: Settings) -> CameraInput:
        """The camera combined with its settings."""
        from scenematch.runs.cameras import CameraInput

        rest = table(settings, "input").of(CameraInput)
        return CameraInput(self.camera, hfov_deg=self.hfov_deg, mount=self.mount, **rest)


@dataclass(frozen=True, kw_only=True)
class FlightOptions(CameraOptions, MapOptions):
    """The files of a flight."""

    frames: FramesOption
    telemetry: TelemetryOption = None
    truth: TruthOption = None

    def files(self, settings: Settings, correct: Sequence[str] | None = None) -> FlightFiles:
        """The files combined with their settings."""
        from scenematch.files.corrections import Corrections
        from scenematch.runs.inputs import FlightFiles

        return FlightFiles(
            map=self.map_input(settings),
            camera=self.camera_input(settings),
            frames=self.frames,
            telemetry=self.telemetry,
            truth=self.truth,
            corrections=Corrections.from_texts(correct or ()),
            **table(settings, "input").of(FlightFiles),
        )


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace a command's parameters of the types above by their fields, one option each."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, type[Any]] = {
        name: kind for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)
    }
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        kind, keyword = groups.get(name), inspect.Parameter.KEYWORD_ONLY
        if kind is None:
            parameters.append(parameter.replace(kind=keyword, annotation=hints[name]))
            continue
        types = get_type_hints(kind, include_extras=True)
        for each in fields(kind):
            default = inspect.Parameter.empty if each.default is MISSING else each.default
            parameters.append(inspect.Parameter(each.name, keyword, default=default, annotation=types[each.name]))

    @wraps(command)
    def call(**given: Any) -> None:
        made = {
            name: kind(**{each.name: given.pop(each.name) for each in fields(kind)})
            for name, kind in groups.items()
        }
        command(**given, **made)

    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {each.name: each.annotation for each in parameters}
    return call


def read_settings(texts: Sequence[str] | None) -> Settings:
    """Read the given settings, and apply their number of threads to torch and OpenCV."""
    from scenematch.runs.settings import Settings

    name_settings("learned", ["weights"])
    settings = Settings.read(texts or ())
    use_threads(settings.threads)
    return settings


def use_threads(count: int = 1) -> None:
    """Set the number of threads of torch and OpenCV."""
    from engine.runtime.threads import set_threads

    set_threads(count)


def table(settings: Settings, name: str, **given: Any) -> Any:
    """A table of the settings; an error in one of them names it as ``--settings`` does."""
    from importlib import import_module

    from scenematch.runs.settings import TABLES

    module, kind, hidden = TABLES[name]
    names = [each.name for each in fields(getattr(import_module(module), kind))]
    name_settings(name, [each for each in names if each not in hidden])
    return settings.table(name, **given)


def live_view(rerun: Sequence[str] | None) -> LiveViewTarget:
    """Where the live view goes: into a file, to a viewer, or both.

    Raises:
        OptionError: more than one file or viewer was given.
    """
    from engine.errors import OptionError
    from scenematch.runs.live_viewing import LiveViewTarget

    given: dict[str, str] = {}
    for text in rerun or ():
        kind = "viewer" if ":" in text and not text.endswith(".rrd") else "recording"
        if kind in given:
            raise OptionError(f"{kind}: expected one file and one viewer at most, got {given[kind]} and {text}")
        given[kind] = text
    return LiveViewTarget(**given)


def flight_options(files: FlightFiles, *, settings: Sequence[str] | None = None, start: str | None = None) -> str:
    """The files of a flight with their settings, typed as options of `check` and `track`."""
    from scenematch.runs.settings import InputSettings

    values = files.flat()
    named = {each.name: values[each.name] for each in fields(FlightOptions)}
    if settings is None:
        nothing = InputSettings()
        rest = {name: values[name] for name in nothing.of(type(files), type(files.map), type(files.camera))}
        changed = {name: value for name, value in rest.items() if value != getattr(nothing, name)}
        settings = [f"input.{name}={str(v).lower() if v is True else v}" for name, v in changed.items()]
    words = [f"--correct {console.quoted(text)}" for text in files.corrections.texts()]
    words += [f"--settings {console.quoted(text)}" for text in settings]
    return " ".join([console.options(**named, start=start), *words])


def after_track(
    files: FlightFiles, out: Path, fixes: int, *, settings: Sequence[str] | None = None, start: str | None = None
) -> str:
    """The next command after a track: its export, or if it has no fix, a check."""
    if fixes:
        return f"export {console.quoted(out)} --format geojson"
    return f"check {flight_options(files, settings=settings, start=start)}"
