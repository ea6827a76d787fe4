"""How a flight is followed: the settings of a run, as a settings file holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from engine.errors import OptionError
from engine.matching import METHODS
from engine.options import PROFILES, LearnedOptions, MatcherOptions, NavigatorOptions, NccOptions, SiftOptions
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
from scenematch.runs.folders import StrPath


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackSettings:
    """How a flight is followed: all that a settings file holds.

    Attributes:
        method: "ncc", "sift", "auto" or "learned".
        profile: "engine", or "paper" for the paper's own recipe, the baseline.
        device: where tensors live: "auto", "cpu" or "cuda".
        start: where the flight begins, "LAT,LON" or "LAT,LON,SIGMA_M" in degrees and metres; none takes the first
            position of the telemetry, and where that has none the whole map is searched.
        budget_ms: time that one frame may take, later answers are refused; none does not hurry.
        risk: probability of a wrong fix that is allowed.
        telemetry_columns: what a telemetry.csv calls its columns, by our name: timestamp_us = "time",
            height_agl_m = "alt". A table, [telemetry_columns]; columns that are not in it have our names.
        ncc: settings of the NCC method.
        sift: settings of the SIFT method, and of what learned matches become.
        learned: settings of the learned method, its weights among them.
        navigator: how a position is carried from frame to frame; the paper's profile has none of it.

    Raises:
        OptionError: a name or a number is none of those that are expected.
        DeviceError: the device is missing.
    """

    method: str = "auto"
    profile: str = "engine"
    device: str = "auto"
    start: str | None = None
    budget_ms: float | None = None
    risk: float = 1e-4
    telemetry_columns: dict[str, str] = field(default_factory=dict)
    ncc: NccOptions = field(default_factory=NccOptions)
    sift: SiftOptions = field(default_factory=SiftOptions)
    learned: LearnedOptions = field(default_factory=LearnedOptions)
    navigator: NavigatorOptions = field(default_factory=NavigatorOptions)

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        check_choice("profile", self.profile, PROFILES)
        if self.profile == "paper" and self.method not in ("ncc", "sift"):
            raise OptionError(f"method: expected ncc or sift with `profile` paper, got {self.method!r}")
        if self.profile == "paper" and self.navigator.odometry:
            raise OptionError("odometry: expected with `profile` engine, got profile 'paper'")
        self._check_columns()
        parse_position("start", self.start)
        parse_budget("budget_ms", self.budget_ms)
        check_device(self.device)

    def _check_columns(self) -> None:
        for name, theirs in self.telemetry_columns.items():
            check_choice("telemetry_columns", name, COLUMNS)
            if not theirs.strip():
                raise OptionError(f"telemetry_columns.{name}: expected the name of a column, got a blank one")

    def matcher_options(self) -> MatcherOptions:
        """What of it is the matcher's."""
        return MatcherOptions(
            profile=self.profile, risk=self.risk, ncc=self.ncc, sift=self.sift, learned=self.learned
        )


@dataclass(frozen=True, slots=True)
class InputSettings:
    """What is rarely said of a flight's or a bridge's files.

    Attributes:
        every: one frame in so many is used, from the first on.
        frame_stamps: with a log, a CSV with timestamp_ns and frame.
        log_offset_s: with a log, added to the frames' own stamps.
        image_topic: of the pictures, if the frames are a bag with several.
        odometry_topic: another odometry that the velocity is taken from, if the telemetry is a bag.
        camera_pitch_deg: of the camera, -90 looks straight down.
        scale_calibration: scale the calibration to pictures of another size and the same shape.
        map_sigma_m: georeferencing accuracy of the map per axis; none is what the map states.
        map_bounds: "W,S,E,N", edges of a picture without georeference, in degrees or in map_crs.
        map_crs: of a map that names none, EPSG:N.
        rate_hz: of a bridge: pace of played pictures without stamps; none is 10.
        exposure_to_grab_ms: of a bridge: how long the pictures of its camera take to get here.
        gimbal: of a bridge: the camera hangs on a gimbal that the autopilot reports.
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
        """The values of the fields that these dataclasses have too, by name."""
        names = {each.name for kind in kinds for each in fields(kind)}
        return {each.name: getattr(self, each.name) for each in fields(self) if each.name in names}


TABLES = {
    "input": ("scenematch.runs.settings", "InputSettings", ()),
    "bridge": (
        "scenematch.runs.mavlink_bridge", "BridgeSettings", ("method", "device", "start", "matcher", "navigator")
    ),
    "mavlink": ("scenematch.runs.mavlink_bridge", "MavlinkSettings", ("connect",)),
    "parameters": ("scenematch.runs.mavlink_parameters", "ParameterSettings", ()),
    "ros": ("scenematch.runs.ros_bridge", "RosSettings", ("map", "camera", "version", "arguments")),
    "audit": ("scenematch.check.plan", "AuditOptions", ("ncc",)),
    "fetch": ("scenematch.runs.map_fetch", "FetchSettings", ("around", "source", "dry_run", "force")),
}  # fmt: skip
"""Tables of a settings file beside those of :class:`TrackSettings`: module and class, and what is no setting.

A module is imported with its table only: a map is fetched without torch.
"""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of files and of NAME=VALUE, the later ones counting more.

    Attributes:
        sources: values with the file that they are from; None is no file.
    """

    sources: tuple[tuple[Path | None, Mapping[str, Any]], ...] = ()

    @classmethod
    def read(cls, texts: Sequence[StrPath]) -> Settings:
        """Read them.

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
        """Of torch and OpenCV.

        Raises:
            OptionError: it is no number above 0.
        """
        count = self._values().get("threads", 1)
        if type(count) is not int or count < 1:
            raise OptionError(f"threads: expected a whole number above 0, got {count!r}")
        return count

    def track(self, **given: Any) -> TrackSettings:
        """How frames are matched.

        Args:
            given: settings that count more; None is none.

        Raises:
            OptionError: a name is unknown, or a value is none that can be.
        """
        values = {name: value for name, value in self._values().items() if name not in (*TABLES, "threads")}
        found: TrackSettings = self._built(TrackSettings, values, "", given)
        weights = tuple(str(Path(path).resolve()) for path in found.learned.weights)  # as a record keeps them
        return replace(found, learned=replace(found.learned, weights=weights))

    def table(self, name: str, **given: Any) -> Any:
        """A table of :data:`TABLES`.

        Args:
            name: of the table.
            given: what is no setting, or counts more; None is none.

        Raises:
            OptionError: a name is unknown, or a value is none that can be.
        """
        module, kind, hidden = TABLES[name]
        values = self._values().get(name, {})
        if not isinstance(values, dict):
            raise OptionError(f"{name}: expected a table, got {values!r}")
        for key in hidden:
            if key in values:
                raise OptionError(f"{name}.{key}: not a setting")
        return self._built(getattr(import_module(module), kind), values, name, given)

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
    for name, (module, kind, hidden) in TABLES.items():
        cls = getattr(import_module(module), kind)
        needed = {each.name: "" for each in fields(cls) if each.default is each.default_factory is MISSING}
        texts.append(settings_text(cls(**needed), name, hidden))
    return "\n".join(texts)


def load_settings(*texts: StrPath | None, **overrides: Any) -> TrackSettings:
    """The settings of files, or the defaults, with what overrides them.

    Args:
        texts: TOML files as ``scenematch doctor --settings`` prints one, or NAME=VALUE, the later counting more;
            None is the defaults.
        overrides: settings by name that count more; None is none.

    Raises:
        OptionError, OSError: see :meth:`Settings.read` and :meth:`Settings.track`.
    """
    return Settings.read([text for text in texts if text is not None]).track(**overrides)
