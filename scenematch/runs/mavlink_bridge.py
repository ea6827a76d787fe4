"""Run the MAVLink bridge: pictures in, fixes to the autopilot out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from engine.camera import Camera
from engine.errors import BackendError, CalibrationError, OptionError, TelemetryError, require
from engine.matching.matcher import SceneMatcher
from engine.navigation.live import Answer, LiveOptions
from engine.navigation.motion import position_of
from engine.navigation.navigator import Navigator
from engine.orthomap import OrthoMap
from engine.runtime.garbage import no_collection
from engine.runtime.realtime import Realtime, check_realtime, set_realtime
from engine.values import Fix, Prior
from scenematch.bridges.links import Connection, parse_connection
from scenematch.bridges.parameters import MAX_DELAY_MS, MavlinkOptions
from scenematch.bridges.pictures import CapturedImage
from scenematch.bridges.vehicle import NedOrigin
from scenematch.runs.arguments import check_between, check_unused, parse_position
from scenematch.runs.bridge_files import BridgeFiles
from scenematch.runs.last_fix import LastFix, last_fix_file
from scenematch.runs.live_viewing import NO_LIVE_VIEW, LiveViewTarget, open_bridge_view
from scenematch.runs.map_input import check_position
from scenematch.runs.output import SILENT, Progress
from scenematch.runs.service import running_service, status_reporter
from scenematch.runs.settings import TrackSettings
from scenematch.runs.supervisor import become_worker, check_supervision, end_on_sigterm

if TYPE_CHECKING:
    from scenematch.bridges.mavlink import MavlinkBridge
    from scenematch.bridges.mavlink_status import MavlinkStatus

_AUTOPILOT_TIMEOUT_S = 10.0
_MAX_ALT_M = 10_000.0  # of an origin: above any ground, and within the range of MAVLink's millimetres


@dataclass(frozen=True, slots=True, kw_only=True)
class MavlinkSettings(MavlinkOptions):
    """How to reach the autopilot, and what to send it.

    Attributes:
        connect: see :func:`scenematch.bridges.links.parse_connection`.
        listen_anywhere: allow udpin on addresses that other machines can reach.
        system_id: system id of the vehicle; others are ignored.
        component_id: component id of the bridge; it treats an ODOMETRY of type VISION with this id as its own.
        key: key file for MAVLink signing; with it, unsigned packets are ignored.
        firmware: firmware of the autopilot, "ardupilot" or "px4".
        message: message that carries the fixes; "" is the firmware's default.
        max_sigma_m: largest sigma of a fix that is sent.
        set_origin: set an origin on an autopilot that has none: the start, else the map's centre.
        origin_alt_m: height of that origin above sea level; None uses the ground there.
        use_velocity: use the autopilot's velocity between fixes.
        check_gnss: check the first fixes against the autopilot's GNSS receiver, if it has a fix.
        gps_id: number of the receiver that GPS_INPUT emulates; 0 is the autopilot's first.

    Raises:
        OptionError: see :class:`scenematch.bridges.parameters.MavlinkOptions`; or the height of the origin is
            impossible or given without ``set_origin``.
    """

    connect: str
    listen_anywhere: bool = False
    key: str | None = None
    set_origin: bool = True
    origin_alt_m: float | None = None

    def __post_init__(self) -> None:
        MavlinkOptions.__post_init__(self)  # super() would be the class before its slots
        if not self.set_origin:
            check_unused({"origin_alt_m": self.origin_alt_m}, "set_origin")
        check_between("origin_alt_m", self.origin_alt_m, -_MAX_ALT_M, _MAX_ALT_M)

    def connection(self) -> Connection:
        """The endpoint of the autopilot."""
        return parse_connection(self.connect, listen_anywhere=self.listen_anywhere)

    def origin(self, site: OrthoMap, start: Prior | None) -> NedOrigin | None:
        """The start of the flight, or the map's centre; None if no origin should be set.

        Its height is the given one, else the ground there; at the map's centre the map's usual ground.
        """
        if not self.set_origin:
            return None
        lat_deg, lon_deg, ground_m = site.frame.lat_deg, site.frame.lon_deg, site.ground_m
        if start is not None:
            place_m = position_of(start, site).en_m
            lat_deg, lon_deg = (float(v) for v in site.frame.geodetic_from_enu(*place_m))
            ground_m = site.ground_at(site.pixel_from_enu(place_m))
        return NedOrigin(lat_deg, lon_deg, ground_m if self.origin_alt_m is None else self.origin_alt_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeSettings(TrackSettings):
    """Settings of a bridge: those of matching and navigation, and its own.

    Attributes:
        deadline_ms: largest age of an answer; None is 250 for MAVLink, which ArduPilot takes at most, and 121 for
            ROS.
        seconds: stop after this time; None stops when the pictures end.
        realtime: match with real-time priority and locked memory (Linux).
        nice: with realtime, a nice value, -20 to -1, instead of SCHED_FIFO.
        cores: with realtime, cores for matching; none uses all cores of the process.

    Raises:
        OptionError, DeviceError: see :class:`scenematch.runs.settings.TrackSettings`; or this system has no
            real-time scheduling.
        BackendError: real time is not permitted.
    """

    deadline_ms: float | None = None
    seconds: float | None = None
    realtime: bool = False
    nice: int | None = None
    cores: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        TrackSettings.__post_init__(self)  # super() would be the class before its slots
        self.live_options()
        check_realtime(self.scheduling())
        if self.profile != "engine":
            raise OptionError(f"profile: expected engine in a bridge, got {self.profile!r}")

    def scheduling(self) -> Realtime | None:
        """Scheduling of the matching threads; None is the default.

        Raises:
            OptionError: a number is invalid, or has no effect without ``realtime``.
        """
        if not self.realtime:
            check_unused({"nice": self.nice, "cores": self.cores or None}, "realtime")
            return None
        return Realtime(nice=self.nice, cores=self.cores)

    def schedule_this_thread(self) -> None:
        """Give this thread the scheduling of the matching threads: it, too, may hold Python's lock."""
        scheduling = self.scheduling()
        if scheduling is not None:
            set_realtime(replace(scheduling, cores=()))  # a camera's command would inherit cores

    def live_options(self, deadline_ms: float = 121.0) -> LiveOptions:
        """The deadlines of the frames, or the default ones."""
        deadline_ms = deadline_ms if self.deadline_ms is None else self.deadline_ms
        return LiveOptions(deadline_ms=deadline_ms, realtime=self.scheduling())


def run_mavlink_bridge(
    files: BridgeFiles,
    link: MavlinkSettings,
    settings: BridgeSettings | None = None,
    *,
    supervise: bool = False,
    live_view: LiveViewTarget = NO_LIVE_VIEW,
    progress: Progress = SILENT,
) -> MavlinkStatus:
    """Run the bridge until the pictures end or the time is up.

    Args:
        files: map, camera and pictures.
        link: the autopilot.
        settings: how to match frames; None uses the defaults.
        supervise: keep this process, with everything loaded, to replace a worker that is killed.
        live_view: where to send the live view.
        progress: receives progress and messages.

    Returns:
        What was done.

    Raises:
        MissingExtraError: pymavlink, or for a serial line pyserial, is not installed.
        BackendError: the link cannot be opened.
        OptionError, MapError, CalibrationError, TelemetryError: an argument or a file is invalid.
    """
    require("pymavlink", "mavlink")
    live_view.check()
    settings = settings or BridgeSettings()
    link.connection()
    start, speed_mps = parse_position("start", settings.start), settings.navigator.max_speed_mps
    last_fix = _last_fix(files, link)
    in_flight = last_fix.prior(speed_mps) is not None
    if in_flight:
        settings.schedule_this_thread()  # the vehicle waits for its fixes
    matcher = _loaded(files, settings, start, progress, brief=in_flight)
    end_on_sigterm()  # before the fork, so that the worker has it from its first instruction
    if supervise:
        check_supervision(matcher.device)
        become_worker(progress)
    resumed = _resumed(last_fix.prior(speed_mps), matcher.site, progress)
    begin = resumed or start
    with open_bridge_view(matcher, live_view, settings.navigator) as (make_navigator, watcher):
        # Before the link: a bench autopilot takes off as soon as the bridge listens.
        pictures = files.pictures(lambda: _wait_for_autopilot(bridge, progress, beat), settings.scheduling())
        with open_bridge(
            link, make_navigator, start=begin, resumed=resumed is not None, site=matcher.site,
            origin=link.origin(matcher.site, begin), live=settings.live_options(MAX_DELAY_MS),
            gimbal_mount=matcher.camera.mount if files.gimbal else None, watch=_watch(last_fix, watcher),
        ) as bridge:  # fmt: skip
            settings.schedule_this_thread()
            # Ctrl-C is the usual way to stop a camera's bridge and must keep the counts.
            with running_service() as beat, closing(pictures), suppress(KeyboardInterrupt):
                _run(bridge, pictures, matcher.camera, settings.seconds, progress, beat)
            return bridge.status


def _last_fix(files: BridgeFiles, link: MavlinkSettings) -> LastFix:
    """With a camera the bridge may start in the air; a replayed flight begins at its start."""
    if files.camera_source is None:
        return LastFix()
    return LastFix(last_fix_file(link.connect, link.system_id, Path(files.map.map).absolute()))


def _watch(last_fix: LastFix, watcher: Callable[[Answer], None] | None) -> Callable[[Answer, bool], None]:
    """Keep every fix that was sent, and show every answer."""

    def watch(answer: Answer, sent: bool) -> None:
        if sent and isinstance(answer.result, Fix):
            last_fix.keep(answer.result)
        if watcher is not None:
            watcher(answer)

    return watch


def open_bridge(
    link: MavlinkSettings, make_navigator: Callable[[Prior | None], Navigator], **flight: Any
) -> MavlinkBridge:
    """Open the link to the autopilot; ``flight`` are further arguments of the bridge.

    Raises:
        BackendError: it cannot be opened.
    """
    from scenematch.bridges.mavlink import MavlinkBridge
    from scenematch.bridges.packets import read_key

    key = None if link.key is None else read_key(Path(link.key))
    try:
        return MavlinkBridge(link.connection(), make_navigator, link, key=key, **flight)
    except OSError as error:
        raise BackendError(f"connect: {link.connect} cannot be opened: {error.strerror or error}") from None


def _loaded(
    files: BridgeFiles, settings: BridgeSettings, start: Prior | None, progress: Progress, *, brief: bool
) -> SceneMatcher:
    """The warm matcher of the map and the camera; ``brief`` if the vehicle may be waiting in the air."""
    with no_collection():  # what is loaded stays: looking for garbage in it takes a seventh of the time
        site = files.map.open(progress)
        camera = files.load_camera(progress)
        check_position("start", start, site, OptionError)
        matcher = settings.matcher(site, camera)
        with progress.task("compiling") as report_compiled:
            matcher.warmup(report_compiled, brief=brief)
    return matcher


def _resumed(last: Prior | None, site: OrthoMap, progress: Progress) -> Prior | None:
    """The last fix of the previous bridge or worker, unless there is none or the map file has changed."""
    if last is None:
        return None
    try:
        check_position("last fix", last, site, OptionError)
    except OptionError:
        return None
    progress.message(f"continues from the last fix, whose uncertainty has grown by {last.sigma_m:.0f} m")
    return last


def _run(
    bridge: MavlinkBridge,
    pictures: Iterator[CapturedImage | None],
    camera: Camera,
    seconds: float | None,
    progress: Progress,
    beat: Callable[[], None],
) -> None:
    """Pass every picture to the bridge; report its status now and then."""
    begin, count = time.monotonic(), 0
    report = status_reporter(lambda: bridge.status.line(), progress)
    for picture in pictures:
        if picture is not None:
            count += 1
            _submit(bridge, picture, camera, count)
        beat()
        report()
        if seconds is not None and time.monotonic() - begin >= seconds:
            return
    if count == 0:
        raise TelemetryError("frames: expected at least one picture, got none")
    _wait_for_answers(lambda: bridge.status.answered, count)


def _submit(bridge: MavlinkBridge, picture: CapturedImage, camera: Camera, number: int) -> None:
    image, captured_ns = picture
    try:
        camera.check_size(image.shape)
    except CalibrationError as error:
        raise CalibrationError(f"picture {number}: {error}") from None
    bridge.submit(image, captured_ns)


def _wait_for_autopilot(bridge: MavlinkBridge, progress: Progress, beat: Callable[[], None]) -> None:
    """A replay starts with the autopilot's flight, because its earlier position is unknown."""
    if not bridge.connected:
        progress.message(f"the pictures wait for the autopilot, {_AUTOPILOT_TIMEOUT_S:g} s at most")
    until = time.monotonic() + _AUTOPILOT_TIMEOUT_S
    while not bridge.connected and time.monotonic() < until:
        beat()
        time.sleep(0.002)


def _wait_for_answers(answered: Callable[[], int], count: int) -> None:
    """The last frame's answer; frames replaced by newer ones have none."""
    before, until = -1, time.monotonic() + 2.0
    while answered() not in (before, count) and time.monotonic() < until:
        before = answered()
        time.sleep(0.3)
