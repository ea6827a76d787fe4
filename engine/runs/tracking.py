"""``track`` and ``evaluate``: a flight in, track.csv, summary.json, figures and the report page out."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from engine.budget import Budget
from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import (
    check_choice,
    check_device,
    check_folder,
    named_as_typed,
    open_map,
    parse_budget,
    parse_position,
    prepare_folder,
)
from engine.errors import EngineError, OptionError, TelemetryError
from engine.formats.flight import Flight, FlightFrame, open_flight
from engine.formats.logs.readers import LogClock, is_log, open_truth
from engine.formats.notes import frame_note, read_notes, write_notes
from engine.formats.ros.bags import is_bag, read_bag_camera
from engine.formats.settings import changed, nested, options_from_mapping, read_settings
from engine.formats.telemetry import ground_amsl_m
from engine.formats.track import TrackRow, TrackWriter, read_track, track_row
from engine.matcher import METHODS, PROFILES, MatcherOptions, SceneMatcher
from engine.methods.hypothesis import NccOptions
from engine.methods.sift import SiftOptions
from engine.navigator import ACCEPT_ALL, Navigator, NavigatorOptions
from engine.orthomap import OrthoMap
from engine.report.attitude import AttitudeCheck, AttitudeRow, attitude_row, check_attitude
from engine.report.explain import choose_frames, explain_frames
from engine.report.figures import draw_figures
from engine.report.metrics import Ground, summarise
from engine.report.page import FinishedTrack, write_page
from engine.runs.checks import check_needs, check_pictures, check_place, check_start
from engine.runs.record import Record, read_record
from engine.runs.watching import Watching, watched
from engine.values import Fix, NoFix, Prior, Truth

if TYPE_CHECKING:  # rerun is optional
    from engine.report.live_view import LiveView

FIGURES = ("path.png", "position.png", "height.png", "error.png")
NOTES, PAGE = "notes.csv", "report.html"
OWNED = ("track.csv", "summary.json", NOTES, PAGE, *FIGURES)
"""The files of an output folder."""


@dataclass(frozen=True, slots=True)
class FlightFiles:
    """The files of one flight."""

    map: Path
    surface: Path | None
    camera: Path
    frames: Path
    telemetry: Path | None
    truth: Path | None
    clock: LogClock | None = None  # when the frames were taken, where the telemetry is a log
    image_topic: str | None = None  # of the pictures, where the frames are a bag
    map_sigma_m: float | None = None  # how well the map lies, where it does not say

    def __post_init__(self) -> None:
        if self.clock is not None and (self.telemetry is None or not is_log(self.telemetry)):
            raise OptionError(f"--frame-stamps, --log-offset-s: expected a log as telemetry, got {self.telemetry}")
        if self.image_topic is not None and not is_bag(self.frames):
            raise OptionError(f"--image-topic: expected a bag as frames, got {self.frames}")

    def load_camera(self) -> Camera:
        """The calibration, of a file or of a bag."""
        return read_bag_camera(self.camera, self.image_topic) if is_bag(self.camera) else Camera.load(self.camera)

    def open_flight(self) -> Flight:
        """The frames with what is known of each."""
        return open_flight(
            self.frames, self.telemetry, clock=self.clock or LogClock(), image_topic=self.image_topic
        )

    def find_truth(self) -> Path | None:
        """The truth that was named, else ``truth.csv`` beside the telemetry where there is one."""
        if self.truth is not None or self.telemetry is None:
            return self.truth
        beside = self.telemetry.with_name("truth.csv")
        return beside if beside.is_file() else None


def folder_inputs(directory: Path) -> FlightFiles:
    """The files of a flight folder that has all of them, by their usual names."""
    return FlightFiles(
        map=directory / "map.tif",
        surface=directory / "dsm.tif",
        camera=directory / "camera.yaml",
        frames=directory / "frames",
        telemetry=directory / "telemetry.csv",
        truth=directory / "truth.csv",
    )


def parse_clock(stamps: Path | None, offset_s: float) -> LogClock | None:
    """When the frames were taken, where that was told.

    Raises:
        OptionError: the offset is not finite.
    """
    with named_as_typed(offset_s="--log-offset-s"):
        return LogClock(stamps, offset_s) if stamps is not None or offset_s else None


def camera_or_bag(camera: Path | None, frames: Path) -> Path:
    """The file that was named, else the bag that the frames come from.

    Raises:
        OptionError: neither.
    """
    if camera is None and not is_bag(frames):
        raise OptionError("--camera: expected a calibration, which only a bag may have within itself")
    return camera or frames


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How a flight is followed: all that a settings file holds.

    Attributes:
        method: "ncc", "sift" or "auto".
        profile: "engine", or "paper" for the paper's own recipe, the baseline.
        device: where tensors live: "auto", "cpu" or "cuda".
        start: where the flight begins, "LAT,LON" or "LAT,LON,SIGMA_M" in degrees and metres; none takes the first
            position of the telemetry, and where that has none the whole map is searched.
        budget_ms: time that one frame may take, later answers are refused; none does not hurry.
        ncc: settings of the NCC method.
        sift: settings of the SIFT method.
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
    ncc: NccOptions = field(default_factory=NccOptions)
    sift: SiftOptions = field(default_factory=SiftOptions)
    navigator: NavigatorOptions = field(default_factory=NavigatorOptions)

    def __post_init__(self) -> None:
        check_choice("--method", self.method, METHODS)
        check_choice("--profile", self.profile, PROFILES)
        if (self.method, self.profile) == ("auto", "paper"):
            raise OptionError("--method: expected ncc or sift with --profile paper, got 'auto'")
        parse_position("--start", self.start)
        parse_budget("--budget-ms", self.budget_ms)
        check_device("--device", self.device)


def settings_from(path: Path | None, **given: Any) -> Settings:
    """The settings of a file, or the defaults, with what the command line was given (not None) in their place.

    Raises:
        OptionError, OSError: see :func:`engine.formats.settings.read_settings`.
    """
    settings = Settings() if path is None else read_settings(path, Settings)
    return replace(settings, **{name: value for name, value in given.items() if value is not None})


@dataclass(frozen=True)
class Opened:
    """A flight whose every part was read and found to fit the others."""

    site: OrthoMap
    camera: Camera
    flight: Flight
    truth_path: Path | None
    truth: list[Truth] | None


@dataclass(frozen=True, slots=True)
class Replay:
    """With what single frames are matched again for the report; None where it cannot be had, and why."""

    flight: Flight | None = None
    matcher: SceneMatcher | None = None
    why_not: str = "the frames were not kept."


def run_track(
    inputs: FlightFiles,
    out: Path,
    settings: Settings,
    *,
    force: bool = False,
    report: bool = True,
    watching: Watching | None = None,
    opened: Opened | None = None,
) -> dict[str, Any]:
    """Follow a flight and write the output folder; returns the summary.

    Everything that can be wrong with the input is found before the output folder is made. Without ``report`` there
    are no figures and no page; ``evaluate`` makes them at any later time. ``opened`` is what :func:`open_inputs`
    made of the inputs, where that was done before for several runs.
    """
    check_folder(out, force)
    watching = watching or Watching()
    watching.check(force=force)
    start, budget = parse_position("--start", settings.start), parse_budget("--budget-ms", settings.budget_ms)
    opened = opened or open_inputs(inputs, [settings])
    site, flight = opened.site, opened.flight
    matcher = _matcher(site, opened.camera, settings)
    matcher.warmup()
    prepare_folder(out, force, OWNED)
    navigator = Navigator(
        matcher, start, budget, ACCEPT_ALL if settings.profile == "paper" else settings.navigator
    )
    what = f"{settings.method}, {settings.profile} profile"
    with watched(matcher, watching) as view:
        attitude = follow(flight, navigator, out / "track.csv", budget, what, use_priors=start is None, view=view)
    ground = Ground(site.ground_m, ground_amsl_m(flight.rows))
    record = _record(inputs, settings, opened, str(matcher.device), ground, attitude)
    # From the rows as they stand in the file, so that evaluate gives the same figures.
    rows = read_track(out / "track.csv")
    return conclude(out, rows, opened.truth, site, ground, record, Replay(flight, matcher), report=report)


def _matcher(site: OrthoMap, camera: Camera, settings: Settings) -> SceneMatcher:
    options = MatcherOptions(profile=settings.profile, ncc=settings.ncc, sift=settings.sift)
    return SceneMatcher(site, camera, settings.method, settings.device, options)


def open_inputs(inputs: FlightFiles, wanted: Sequence[Settings]) -> Opened:
    """Read what runs of one flight with the settings that are wanted need.

    Raises:
        OptionError, TelemetryError, CalibrationError, MapError: something cannot be read, or does not belong
            together, or is of no use to one of the runs.
    """
    site = open_map(inputs.map, inputs.surface, inputs.map_sigma_m)
    camera = inputs.load_camera()
    flight = inputs.open_flight()
    truth_path = inputs.find_truth()
    stamp_ns = flight.rows[0].timestamp_ns if flight.rows else None
    truth = open_truth(truth_path, stamp_ns) if truth_path is not None else None
    for settings in wanted:
        check_needs(flight, settings.method, settings.profile)
        start = parse_position("--start", settings.start)
        check_place("--start", start, site, OptionError)
        if start is None:
            first = next((row.prior for row in flight.rows if row.prior is not None), None)
            check_place(str(inputs.telemetry or inputs.frames), first, site, TelemetryError)
            check_start(first, site)
    check_pictures(flight, camera)
    if flight.unused:
        console.say(f"frames without a row in the telemetry, left out: {flight.unused}")
    if flight.heights:
        counts = ", ".join(f"{source} {count}" for source, count in flight.heights.items())
        console.say(f"height above ground, by source, of {len(flight)} frames: {counts}")
    return Opened(site, camera, flight, truth_path, truth)


def _record(
    inputs: FlightFiles,
    settings: Settings,
    opened: Opened,
    device: str,
    ground: Ground,
    attitude: AttitudeCheck | None,
) -> Record:
    """What a run was made of, for summary.json."""

    def absolute(path: Path | None) -> str | None:
        return None if path is None else str(path.resolve())

    return Record(
        map=str(inputs.map.resolve()),
        surface=absolute(inputs.surface),
        camera=absolute(inputs.camera),
        frames=absolute(inputs.frames),
        telemetry=absolute(inputs.telemetry),
        truth=absolute(opened.truth_path),
        frame_stamps=None if inputs.clock is None else absolute(inputs.clock.stamps),
        log_offset_s=None if inputs.clock is None else inputs.clock.offset_s,
        image_topic=inputs.image_topic,
        map_sigma_m=inputs.map_sigma_m,
        heights=dict(opened.flight.heights),
        method=settings.method,
        profile=settings.profile,
        device=device,
        start=settings.start,
        budget_ms=settings.budget_ms,
        changed=changed(settings),
        origin={"lat_deg": opened.site.frame.lat_deg, "lon_deg": opened.site.frame.lon_deg},
        ground_m=ground.ground_m,
        ground_amsl_m=ground.ground_amsl_m,
        attitude=None if attitude is None else asdict(attitude),
    )


def follow(
    flight: Flight,
    navigator: Navigator,
    path: Path,
    budget: Budget | None,
    what: str,
    *,
    use_priors: bool,
    view: LiveView | None = None,
) -> AttitudeCheck | None:
    """Every frame through the navigator, each row on disk as soon as it is known.

    Args:
        flight: the frames.
        navigator: fresh.
        path: of track.csv.
        budget: of each frame.
        what: for the progress bar.
        use_priors: whether the flight may begin at the telemetry's position; once it has begun, the fixes
            carry on.
        view: is shown each frame once it is answered.

    Returns:
        AttitudeCheck | None: what the fixes say of the telemetry's attitude.
    """
    attitudes: list[AttitudeRow | None] = []
    notes = []
    with TrackWriter(path) as writer:
        for index, item in enumerate(console.progress(flight, len(flight), what)):
            prior = item.prior if use_priors else None
            begin = time.perf_counter()
            result = _update(navigator, item, prior)
            latency_ms = (time.perf_counter() - begin) * 1e3
            use_priors = use_priors and not navigator.tracking
            met = None if budget is None else latency_ms <= budget.total_ms
            writer.write(track_row(item.name, result, latency_ms=latency_ms, deadline_met=met))
            attitudes.append(attitude_row(item.frame, result))
            notes.append(frame_note(item.name, result, navigator.state.value))
            if view is not None:
                view.show(index, item.name, item.frame, result, navigator.state, latency_ms)
    write_notes(path.with_name(NOTES), notes)
    return check_attitude([row for row in attitudes if row is not None])


def _update(navigator: Navigator, item: FlightFrame, prior: Prior | None) -> Fix | NoFix:
    """The frame's result; an error in the middle of a flight names its frame, and is no wrong usage."""
    try:
        return navigator.update(item.frame, prior)
    except EngineError as error:
        raise TelemetryError(f"frame {item.name}: {error}") from error


def conclude(
    out: Path,
    rows: list[TrackRow],
    truth: list[Truth] | None,
    site: OrthoMap,
    ground: Ground,
    record: Record,
    replay: Replay | None = None,
    *,
    report: bool = True,
) -> dict[str, Any]:
    """Write summary.json and, where there is to be a report, the figures and its page, in place of older ones."""
    summary = summarise(rows, truth, frame=site.frame, ground=ground) | {"settings": record.facts()}
    if summary.get("scored_fixes") == 0 and summary["fixes"]:
        console.say(f"no fix is scored: {record.truth} says nothing of the times of this flight")
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    if not report:
        return summary
    for name in FIGURES:
        (out / name).unlink(missing_ok=True)
    title = f"{record.method} ({record.profile} profile)"
    draw_figures(out, rows, truth, site=site, title=title, frame=site.frame, ground=ground)
    notes = read_notes(out / NOTES) if (out / NOTES).is_file() else None
    _write_page(out / PAGE, FinishedTrack(rows, truth, site, ground, summary, notes), replay or Replay())
    return summary


def _write_page(path: Path, flown: FinishedTrack, replay: Replay) -> None:
    """The report, with some frames matched again where that can be done."""
    if replay.flight is None or replay.matcher is None:
        return write_page(path, flown, why_not=f"No frames are shown: {replay.why_not}")
    if flown.notes is None or [note.frame for note in flown.notes] != [row.frame for row in flown.rows]:
        return write_page(path, flown, why_not=f"No frames are shown: the run left no {NOTES} of its windows.")
    errors = flown.plot_data().errors
    chosen = choose_frames(flown.rows, errors)
    try:
        shown = explain_frames(replay.flight, replay.matcher, flown.rows, flown.notes, chosen, errors)
    except EngineError as error:
        return write_page(path, flown, why_not=f"No frames are shown: {error}")
    return write_page(path, flown, shown)


def run_evaluate(directory: Path, truth_path: Path | None) -> dict[str, Any]:
    """Score a finished track again.

    Raises:
        TelemetryError: the folder holds no finished track, or no truth is known.
    """
    rows = read_track(directory / "track.csv")
    record = read_record(directory / "summary.json")
    if truth_path is None:
        if record.truth is None:
            raise TelemetryError(f"{directory}: the track was made without truth; name one with --truth")
        truth_path = Path(record.truth)
    truth = open_truth(truth_path, rows[0].timestamp_ns if rows else None)
    site = open_map(record.map, record.surface, record.map_sigma_m)
    ground = Ground(record.ground_m, record.ground_amsl_m)
    replay = _reopened(record, rows, site)
    record = replace(record, truth=str(truth_path.resolve()))
    return conclude(directory, rows, truth, site, ground, record, replay)


def _reopened(record: Record, rows: list[TrackRow], site: OrthoMap) -> Replay:
    """The flight and the matcher of a run that is over, as far as its record and its files still give them."""
    try:
        settings = options_from_mapping(
            Settings, nested({"method": record.method, "profile": record.profile} | dict(record.changed))
        )
        inputs = _recorded(record)
        flight = inputs.open_flight()
        stamps = [row.timestamp_ns for row in flight.rows]
        told = [row.timestamp_ns for row in rows if row.timestamp_ns is not None]
        if (stamps, flight.names) != (told, [row.frame for row in rows]):
            return Replay(why_not="the frames or their telemetry are not those of the run any more.")
        return Replay(flight, _matcher(site, inputs.load_camera(), settings))
    except (EngineError, OSError) as error:
        return Replay(why_not=f"{error}.")


def _recorded(record: Record) -> FlightFiles:
    """The files of a run that is over.

    Raises:
        TelemetryError: the record does not name them all.
        OptionError: what it names does not go together.
    """
    if record.camera is None or record.frames is None:
        raise TelemetryError("the record of the run lacks its camera or its frames")
    stamps, offset_s = record.frame_stamps, record.log_offset_s
    told = stamps is not None or offset_s is not None
    return FlightFiles(
        Path(record.map),
        None,
        Path(record.camera),
        Path(record.frames),
        None if record.telemetry is None else Path(record.telemetry),
        truth=None,
        clock=LogClock(None if stamps is None else Path(stamps), offset_s or 0.0) if told else None,
        image_topic=record.image_topic,
    )
