"""How a flight is followed: the settings of a run, as a settings file holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from engine.errors import OptionError
from engine.matching import METHODS
from engine.options import PROFILES, LearnedOptions, MatcherOptions, NavigatorOptions, NccOptions, SiftOptions
from scenematch.files.settings import read_settings
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

    method: str = "ncc"
    profile: str = "engine"
    device: str = "auto"
    start: str | None = None
    budget_ms: float | None = None
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
        return MatcherOptions(profile=self.profile, ncc=self.ncc, sift=self.sift, learned=self.learned)


def load_settings(
    path: StrPath | None, *, weights: Sequence[StrPath] = (), odometry: bool = False, **overrides: Any
) -> TrackSettings:
    """The settings of a file, or the defaults, with what overrides them.

    Args:
        path: a TOML file as ``scenematch init`` writes it; None is the defaults.
        weights: files of the learned method, in place of those of the settings file.
        odometry: whether pictures are followed where there is no velocity, whatever the file says.
        overrides: settings by name that count more than the file; None is none.

    Raises:
        OptionError, OSError: see :func:`scenematch.files.settings.read_settings`.
    """
    settings = TrackSettings() if path is None else read_settings(Path(path), TrackSettings)
    settings = replace(settings, **{name: value for name, value in overrides.items() if value is not None})
    if odometry:
        settings = replace(settings, navigator=replace(settings.navigator, odometry=True))
    if not weights:
        return settings
    return replace(settings, learned=with_weights(settings.method, weights, settings.learned))


def with_weights(method: str, weights: Sequence[StrPath], options: LearnedOptions | None = None) -> LearnedOptions:
    """The settings of the learned method with these files, by their whole paths.

    Raises:
        OptionError: there are files, and the method is another.
    """
    options = options or LearnedOptions()
    if weights and method != "learned":
        raise OptionError(f"weights: expected them with method learned, got method {method!r}")
    return replace(options, weights=tuple(str(Path(path).resolve()) for path in weights))
