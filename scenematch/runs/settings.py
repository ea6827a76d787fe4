"""Settings of a run, read from and written to settings files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from engine.errors import OptionError
from engine.matching import METHODS
from engine.options import MatcherOptions, NavigatorOptions
from scenematch.files.settings import (
    merged,
    nearest,
    options_from_mapping,
    parse_setting,
    read_values,
    settings_text,
)
from scenematch.files.telemetry import COLUMNS
from scenematch.runs.arguments import check_choice, check_device, parse_budget, parse_position
from scenematch.runs.output import StrPath

if TYPE_CHECKING:
    from engine.camera import Camera
    from engine.matching.matcher import SceneMatcher
    from engine.matching.method import Method
    from engine.orthomap import OrthoMap


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackSettings(MatcherOptions):
    """Settings for tracking a flight: those of the matcher, and of the run.

    Attributes:
        method: "ncc", "sift", "auto" or "learned".
        profile: "engine", or "paper" for the baseline, the paper's own recipe.
        device: "auto", "cpu" or "cuda".
        start: where the flight begins, "LAT,LON" or "LAT,LON,SIGMA_M" in degrees and metres; none uses the
            telemetry's positions, or searches the whole map if it has none.
        budget_ms: longest time per frame, later answers are refused; none sets no limit.
        risk: largest acceptable probability of a wrong fix.
        errors: assumed errors of the telemetry, the map and the ground, if these state none.
        telemetry_columns: names that telemetry.csv uses for our columns: timestamp_us = "time",
            height_agl_m = "alt". A table, [telemetry_columns]; other columns keep our names.
        ncc: settings of the NCC method.
        sift: settings of the SIFT method, also used to turn learned matches into fixes.
        learned: settings of the learned method, including its weights.
        navigator: how the position is propagated between frames; not used in the paper profile.

    Raises:
        OptionError: a name or a number is invalid.
        DeviceError: the device is missing.
    """

    method: str = "auto"
    profile: str = "engine"
    device: str = "auto"
    start: str | None = None
    budget_ms: float | None = None
    telemetry_columns: dict[str, str] = field(default_factory=dict)
    navigator: NavigatorOptions = field(default_factory=NavigatorOptions)

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        check_choice("profile", self.profile, ("engine", "paper"))
        MatcherOptions.__post_init__(self)  # super() would be the class before its slots
        if self.profile == "paper" and self.method not in ("ncc", "sift"):
            raise OptionError(f"method: expected ncc or sift with `profile` paper, got {self.method!r}")
        if self.profile == "paper" and self.navigator.odometry:
            raise OptionError("odometry: expected with `profile` engine, got profile 'paper'")
        self._check_columns()
        parse_position("start", self.start)
        parse_budget("budget_ms", self.budget_ms)
        check_device(self.device)

    def matcher(self, site: OrthoMap, camera: Camera) -> SceneMatcher:
        """The matcher of a map and a camera."""
        from engine.matching.matcher import SceneMatcher  # settings alone need no torch

        method: str | type[Method] = self.method
        if self.profile == "paper":
            from scenematch.runs.paper_recipe import RECIPES

            method = RECIPES[self.method]
        return SceneMatcher(site, camera, method, self.device, self)

    @property
    def acceptance(self) -> NavigatorOptions:
        """How the navigator accepts matches: the paper's recipe accepts all."""
        if self.profile == "paper":
            from scenematch.runs.paper_recipe import ACCEPT_ALL

            return ACCEPT_ALL
        return self.navigator

    def _check_columns(self) -> None:
        for name, theirs in self.telemetry_columns.items():
            check_choice("telemetry_columns", name, COLUMNS)
            if not theirs.strip():
                raise OptionError(f"telemetry_columns.{name}: expected the name of a column, got an empty one")


@dataclass(frozen=True, slots=True)
class InputSettings:
    """Rarely needed settings for the input files of flights and bridges.

    Attributes:
        every: use every Nth frame, starting with the first.
        frame_stamps: CSV with timestamp_ns and frame, if the telemetry is a log.
        log_offset_s: added to the frames' own timestamps, if the telemetry is a log.
        image_topic: topic of the pictures, if the frames are a bag with several.
        odometry_topic: topic of another odometry that provides the velocity, if the telemetry is a bag.
        camera_pitch_deg: pitch of the camera, -90 looks straight down.
        scale_calibration: scale the calibration to pictures of another size but the same aspect ratio.
        map_sigma_m: georeferencing accuracy of the map per axis; none uses what the map states.
        map_bounds: "W,S,E,N", bounds of a picture without georeference, in degrees or in map_crs.
        map_crs: CRS of a map that names none, as EPSG:N.
        rate_hz: bridge: rate at which to replay pictures without timestamps; none is 10.
        exposure_to_grab_ms: bridge: camera latency, from exposure to arrival here.
        gimbal: bridge: the camera is on a gimbal whose attitude the autopilot reports.
    """

    every: int = 1
    frame_stamps: str | None = None
    log_offset_s: float = 0.0
    image_topic: str | None = None
    odometry_topic: str | None = None
    camera_pitch_deg: float | None = None
    scale_calibration: bool = False
    map_sigma_m: float | None = None
    map_bounds: str | None = None
    map_crs: str | None = None
    rate_hz: float | None = None
    exposure_to_grab_ms: float | None = None
    gimbal: bool = False

    def of(self, *kinds: type[Any]) -> dict[str, Any]:
        """The values of the fields that these dataclasses share, by name."""
        names = {each.name for kind in kinds for each in fields(kind)}
        return {each.name: getattr(self, each.name) for each in fields(self) if each.name in names}


_OF_FRAMES = tuple(each.name for each in fields(TrackSettings))
TABLES = {
    "input": ("scenematch.runs.settings", "InputSettings", ()),
    "bridge": ("scenematch.runs.mavlink_bridge", "BridgeSettings", _OF_FRAMES),
    "mavlink": ("scenematch.runs.mavlink_bridge", "MavlinkSettings", ("connect",)),
    "parameters": ("scenematch.runs.mavlink_parameters", "ParameterSettings", ()),
    "ros": ("scenematch.runs.ros_bridge", "RosSettings", ("map", "camera", "version", "arguments")),
    "audit": ("scenematch.check.plan", "AuditOptions", ()),
    "fetch": ("scenematch.fetch.grid", "FetchSettings", ("around", "source", "dry_run", "force")),
}  # fmt: skip
"""Tables of a settings file besides those of :class:`TrackSettings`: module, class, and fields that are not
settings.

A module is imported only when its table is used: fetching a map needs no torch.
"""


def table_class(name: str) -> Any:
    """The class of a table of :data:`TABLES`."""
    module, kind, _ = TABLES[name]
    return getattr(import_module(module), kind)


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings from files and NAME=VALUE; later ones take precedence.

    Attributes:
        sources: values with the file that they come from; None if from NAME=VALUE.
    """

    sources: tuple[tuple[Path | None, Mapping[str, Any]], ...] = ()

    @classmethod
    def read(cls, texts: Sequence[StrPath]) -> Settings:
        """Read files and NAME=VALUE.

        Raises:
            OptionError: a file is not TOML, or a name is unknown.
            OSError: a file cannot be read.
        """
        sources: list[tuple[Path | None, Mapping[str, Any]]] = []
        known = [*(each.name for each in fields(TrackSettings)), *TABLES, "threads"]
        for text in texts:
            values = None if Path(text).is_file() else parse_setting(str(text))
            path = Path(text) if values is None else None
            sources.append((path, read_values(Path(text)) if values is None else values))
            for name in sources[-1][1]:
                if name not in known:
                    where = "" if path is None else f"{path}: "
                    raise OptionError(f"{where}{name}: not a setting; {nearest(name, known)}")
        return cls(tuple(sources))

    @property
    def threads(self) -> int:
        """Number of threads for torch and OpenCV.

        Raises:
            OptionError: it is not a whole number above 0.
        """
        count = self._values().get("threads", 1)
        if type(count) is not int or count < 1:
            raise OptionError(f"threads: expected a whole number above 0, got {count!r}")
        return count

    def track(self, **given: Any) -> TrackSettings:
        """How frames are matched.

        Args:
            given: settings that take precedence; None is ignored.

        Raises:
            OptionError: a name is unknown, or a value is invalid.
        """
        values = {name: value for name, value in self._values().items() if name not in (*TABLES, "threads")}
        found: TrackSettings = self._built(TrackSettings, values, "", given)
        weights = tuple(str(Path(path).resolve()) for path in found.learned.weights)  # as records keep them
        return replace(found, learned=replace(found.learned, weights=weights))

    def table(self, name: str, **given: Any) -> Any:
        """A table of :data:`TABLES`.

        Args:
            name: name of the table.
            given: fields that are not settings or take precedence; None is ignored.

        Raises:
            OptionError: a name is unknown, or a value is invalid.
        """
        values = self._values().get(name, {})
        if not isinstance(values, dict):
            raise OptionError(f"{name}: expected a table, got {values!r}")
        for key in TABLES[name][2]:
            if key in values:
                raise OptionError(f"{name}.{key}: not a setting")
        return self._built(table_class(name), values, name, given)

    def _built(self, cls: Any, values: Mapping[str, Any], within: str, given: Mapping[str, Any]) -> Any:
        given = {name: value for name, value in given.items() if value is not None}
        try:
            return options_from_mapping(cls, values, within, given)
        except OptionError as error:
            *path, last = str(error).partition(":")[0].split(".")
            for file, table in reversed(self.sources):
                for part in path:
                    table = table.get(part, {}) if isinstance(table, Mapping) else {}
                if file is not None and last in table:
                    raise OptionError(f"{file}: {error}") from None
                if last in table:
                    break
            raise

    def _values(self) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for _, values in self.sources:
            out = merged(out, values)
        return out


def documented_settings() -> str:
    """A settings file with every setting, its meaning and its default, all commented out."""
    texts = ["# Threads of torch and OpenCV.\n#threads = 1\n", settings_text(TrackSettings())]
    for name, (_, _, hidden) in TABLES.items():
        cls = table_class(name)
        needed = {each.name: "" for each in fields(cls) if each.default is each.default_factory is MISSING}
        texts.append(settings_text(cls(**needed), name, hidden))
    return "\n".join(texts)


def load_settings(*texts: StrPath | None, **overrides: Any) -> TrackSettings:
    """Load settings from files, or the defaults, and apply overrides.

    Args:
        texts: TOML files as printed by ``scenematch doctor --settings``, or NAME=VALUE; later ones take
            precedence.
        overrides: settings by name that take precedence; None is ignored.

    Raises:
        OptionError, OSError: see :meth:`Settings.read` and :meth:`Settings.track`.
    """
    return Settings.read([text for text in texts if text is not None]).track(**overrides)
