"""Options that several commands share, and the objects they build.

Options:
    surface: Surface model, a GeoTIFF of heights.
    correct: Correct the telemetry as check suggests: heading_offset_deg=3, roll_deg=-pitch_deg; repeatable.
    start: Where the flight begins; replaces the telemetry's positions (default: those, or anywhere on the map).
    method: auto: ncc, and sift where that leaves doubt (default).
    device: Device to compute on (default: auto).
    settings: Settings as `doctor --settings` lists them; repeatable.
    out: Output folder to create.
    force: Replace existing results.
    as_json: Results as JSON on standard output.
    rerun: Record the live view to a file, or show it in a running rerun viewer; repeat for both.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from scenematch.cli import console
from scenematch.cli.argument_names import name_settings
from scenematch.files.settings import field_descriptions

if TYPE_CHECKING:
    from scenematch.runs.cameras import CameraInput
    from scenematch.runs.inputs import FlightFiles
    from scenematch.runs.live_viewing import LiveViewTarget
    from scenematch.runs.map_input import MapInput
    from scenematch.runs.settings import Settings, TrackSettings

INPUT, MAP, OUTPUT, EXPERT = "Input", "Map", "Output", "Expert"
"""Panels of the help."""
_SHARED = field_descriptions(sys.modules[__name__], "Options")


def option(name: str, metavar: str, panel: str | None = None, **limits: Any) -> Any:
    """An option with a value, in a panel of the help; ``limits`` such as ``min`` are typer's.

    Its help is its description in a docstring, see :func:`with_options`.
    """
    return typer.Option(name, metavar=metavar, rich_help_panel=panel, **limits)


def flag(name: str, panel: str | None = None) -> Any:
    """An option without a value."""
    return typer.Option(name, rich_help_panel=panel)


SurfaceOption = Annotated[Path | None, option("--surface", "FILE", MAP)]
CorrectOption = Annotated[list[str] | None, option("--correct", "NAME=VALUE", INPUT)]
StartOption = Annotated[str | None, option("--start", "LAT,LON[,SIGMA_M]", INPUT)]
MethodOption = Annotated[str | None, option("--method", "auto|ncc|sift|learned")]
DeviceOption = Annotated[str | None, option("--device", "auto|cpu|cuda", EXPERT)]
SettingsOption = Annotated[list[str] | None, option("--settings", "FILE|NAME=VALUE", EXPERT)]
OutOption = Annotated[Path, option("--out", "DIR", OUTPUT)]
ForceOption = Annotated[bool, flag("--force", OUTPUT)]
JsonOption = Annotated[bool, flag("--json", OUTPUT)]
RerunOption = Annotated[list[str] | None, option("--rerun", "FILE.rrd|HOST:PORT", OUTPUT)]


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """The map.

    Attributes:
        map: GeoTIFF, or a picture with a world file.
    """

    map: Annotated[Path, option("--map", "FILE", MAP)]
    surface: SurfaceOption = None

    def map_input(self, settings: Settings) -> MapInput:
        """The map combined with its settings."""
        from scenematch.runs.map_input import MapInput

        return MapInput(self.map, surface=self.surface, **table(settings, "input").of(MapInput))


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """The camera.

    Attributes:
        camera: Calibration file (default: from the bag or EXIF).
        hfov_deg: Horizontal field of view, instead of --camera.
        mount: nadir (the picture's top towards the nose), nadir-right, nadir-tail, nadir-left, or forward-45.
    """

    camera: Annotated[Path | None, option("--camera", "FILE", INPUT)] = None
    hfov_deg: Annotated[float | None, option("--hfov-deg", "DEG", INPUT)] = None
    mount: Annotated[str | None, option("--mount", "NAME", INPUT)] = None

    def camera_input(self, settings: Settings) -> CameraInput:
        """The camera combined with its settings."""
        from scenematch.runs.cameras import CameraInput

        rest = table(settings, "input").of(CameraInput)
        return CameraInput(self.camera, hfov_deg=self.hfov_deg, mount=self.mount, **rest)


@dataclass(frozen=True, kw_only=True)
class FlightOptions(CameraOptions, MapOptions):
    """The files of a flight.

    Attributes:
        frames: Folder of pictures, a video, or a ROS bag.
        telemetry: telemetry.csv, or a log: .BIN, .ulg, .SRT, bag (default: the bag's own, the .SRT beside the
            video, or EXIF).
        truth: truth.csv, a log or photographs (default: truth.csv beside the telemetry).
    """

    frames: Annotated[Path, option("--frames", "DIR|VIDEO|BAG", INPUT)]
    telemetry: Annotated[Path | None, option("--telemetry", "FILE", INPUT)] = None
    truth: Annotated[Path | None, option("--truth", "FILE", INPUT)] = None

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


@dataclass(frozen=True, kw_only=True)
class MatchingOptions:
    """How frames are matched."""

    start: StartOption = None
    method: MethodOption = None
    device: DeviceOption = None

    def track_settings(self, settings: Settings) -> TrackSettings:
        """The options combined with the settings."""
        return settings.track(method=self.method, device=self.device, start=self.start)


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace a command's parameters of the types above by their fields, one option each, and add ``--json``.

    The help of an option is its description in a docstring: under "Options" of the command, whose own help leaves
    them out, else under "Attributes" of the type, or for shared options under "Options" of this module.
    """
    hints = get_type_hints(command, include_extras=True)
    about, _, _ = (inspect.getdoc(command) or "").partition("Options:\n")
    own = field_descriptions(command, "Options")
    groups: dict[str, type[Any]] = {
        name: kind for name, kind in hints.items() if isinstance(kind, type) and is_dataclass(kind)
    }
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        kind, keyword = groups.get(name), inspect.Parameter.KEYWORD_ONLY
        if kind is None:
            described = _described(hints[name], own.get(name) or _SHARED.get(name))
            parameters.append(parameter.replace(kind=keyword, annotation=described))
            continue
        types = get_type_hints(kind, include_extras=True)
        of_kind = {n: text for owner in kind.__mro__[::-1] for n, text in field_descriptions(owner).items()}
        texts = _SHARED | of_kind | own
        for each in fields(kind):
            described = _described(types[each.name], texts.get(each.name))
            default = inspect.Parameter.empty if each.default is MISSING else each.default
            parameters.append(inspect.Parameter(each.name, keyword, default=default, annotation=described))

    described = _described(JsonOption, _SHARED["as_json"])
    parameters.append(inspect.Parameter("as_json", keyword, default=False, annotation=described))

    @wraps(command)
    def call(*, as_json: bool, **given: Any) -> None:
        console.AS_JSON.set(as_json)
        made = {
            name: kind(**{each.name: given.pop(each.name) for each in fields(kind)})
            for name, kind in groups.items()
        }
        command(**given, **made)

    call.__doc__ = about.rstrip()
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    call.__annotations__ = {each.name: each.annotation for each in parameters}
    return call


def _described(hint: Any, text: str | None) -> Any:
    """The type of an option or argument with this help, unless it has one; commands share the type."""
    if not hasattr(hint, "__metadata__"):
        return hint
    infos = [copy(info) for info in hint.__metadata__]
    for info in infos:
        info.help = info.help or text
    return Annotated[hint.__origin__, *infos]


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
    from scenematch.runs.settings import TABLES, table_class

    names = [each.name for each in fields(table_class(name))]
    name_settings(name, [each for each in names if each not in TABLES[name][2]])
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
