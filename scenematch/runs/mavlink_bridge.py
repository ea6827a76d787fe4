"""The loop of the MAVLink bridge, and its parameter files: pictures in, fixes to the autopilot out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from engine.camera import Camera
from engine.errors import BackendError, CalibrationError, OptionError, TelemetryError, require
from engine.matching import METHODS
from engine.matching.matcher import SceneMatcher
from engine.navigation.evidence import position_of
from engine.navigation.live import LiveOptions
from engine.options import MatcherOptions, NavigatorOptions
from engine.orthomap import OrthoMap
from engine.runtime.realtime import Realtime, check_realtime, set_realtime
from engine.values import Prior
from scenematch.bridges.delay_memory import remember_delay
from scenematch.bridges.links import parse_connection
from scenematch.bridges.pictures import CapturedImage
from scenematch.bridges.vehicle import NedOrigin
from scenematch.runs.arguments import check_choice, check_device, check_unused, parse_position
from scenematch.runs.bridge_files import BridgeFiles
from scenematch.runs.checks import check_position
from scenematch.runs.last_fix import LastFix, last_fix_file
from scenematch.runs.live_viewing import NO_LIVE_VIEW, LiveViewTarget, open_bridge_view
from scenematch.runs.progress import SILENT, Progress
from scenematch.runs.service import running_service, status_reporter
from scenematch.runs.supervisor import become_worker, check_supervision, end_on_sigterm

if TYPE_CHECKING:
    from scenematch.bridges.mavlink import MavlinkBridge
    from scenematch.bridges.mavlink_out import MavlinkOptions
    from scenematch.bridges.mavlink_status import MavlinkStatus

_AUTOPILOT_TIMEOUT_S = 10.0
_MAX_ALT_M = 10_000.0  # of an origin: beyond the ground of the Earth, and MAVLink's millimetres hold it


@dataclass(frozen=True, slots=True, kw_only=True)
class MavlinkSettings:
    """How the autopilot is reached and what it is sent.

    Attributes:
        connect: as :func:`scenematch.bridges.links.parse_connection` reads it.
        listen_anywhere: allow udpin on addresses that other machines reach.
        system_id: of the vehicle; others are not heard.
        component_id: of the vehicle, that the bridge is; an ODOMETRY of type VISION from it is taken for its own.
        key: secret of MAVLink's signing; with it unsigned packets are ignored.
        firmware: of the autopilot, "ardupilot" or "px4".
        message: what is sent; "" is the firmware's usual one.
        max_sigma_m: a fix that is less certain is not sent.
        set_origin: give an autopilot without an origin the map's.
        origin_alt_m: height of that origin above sea level; None is the map's ground.
        use_velocity: whether the autopilot's velocity is used between fixes.
        check_gnss: whether the first fixes are held against the autopilot's GNSS receiver, where it has a fix.
        gps_id: receiver that GPS_INPUT poses as; 0 is the autopilot's first.

    Raises:
        OptionError: the height of the origin is not one of the Earth's, or there is to be no origin; or the
            component is none, or the autopilot.
    """

    connect: str
    listen_anywhere: bool = False
    system_id: int = 1
    component_id: int = 197
    key: str | None = None
    firmware: str = "ardupilot"
    message: str = ""
    max_sigma_m: float = 10.0
    set_origin: bool = True
    origin_alt_m: float | None = None
    use_velocity: bool = True
    check_gnss: bool = True
    gps_id: int = 0

    def __post_init__(self) -> None:
        if not self.set_origin:
            check_unused({"origin_alt_m": self.origin_alt_m}, "set_origin")
        if self.origin_alt_m is not None and not abs(self.origin_alt_m) <= _MAX_ALT_M:
            raise OptionError(
                f"origin_alt_m: expected {-_MAX_ALT_M:g} to {_MAX_ALT_M:g}, got {self.origin_alt_m:g}"
            )

        if not 2 <= self.component_id <= 255:
            raise OptionError(f"component_id: expected 2 to 255, 1 is the autopilot, got {self.component_id}")

    def outgoing(self) -> MavlinkOptions:
        """What is sent.

        Raises:
            OptionError: the firmware, the message or the accuracy is none that can be.
        """
        from scenematch.bridges.mavlink_out import MavlinkOptions

        return MavlinkOptions(
            firmware=self.firmware, message=self.message, max_sigma_m=self.max_sigma_m, gps_id=self.gps_id
        )

    def origin(self, site: OrthoMap, start: Prior | None) -> NedOrigin | None:
        """The start of the flight or else the map's middle; None where none is to be set.

        Its height is that of the ground there, of the map's ground in general, or as it was given.
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
class BridgeSettings:
    """How a bridge matches frames.

    Attributes:
        method: "auto", "ncc", "sift" or "learned".
        device: where tensors live.
        matcher: settings of the methods.
        navigator: how a position is carried from frame to frame.
        start: where the flight begins, "LAT,LON" or "LAT,LON,SIGMA_M".
        deadline_ms: age by which a frame is answered; None is what the receiver of the fixes takes.
        seconds: ends after this time; None ends with the pictures.
        realtime: match with a real-time priority and locked memory (Linux).
        nice: with realtime, a nice value, -20 to -1, in place of SCHED_FIFO.
        cores: with realtime, the cores that match; none leaves them those of the process.

    Raises:
        OptionError: a word or a number is none of those that are expected, or real time is not this system's.
        DeviceError: the device is missing.
        BackendError: real time is not permitted.
    """

    method: str = "auto"
    device: str = "auto"
    start: str | None = None
    matcher: MatcherOptions = field(default_factory=MatcherOptions)
    navigator: NavigatorOptions = field(default_factory=NavigatorOptions)
    deadline_ms: float | None = None
    seconds: float | None = None
    realtime: bool = False
    nice: int | None = None
    cores: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        check_device(self.device)
        parse_position("start", self.start)
        self.live_options()
        check_realtime(self.scheduling())
        if self.matcher.profile != "engine":
            raise OptionError(f"profile: expected engine in a bridge, got {self.matcher.profile!r}")

    def scheduling(self) -> Realtime | None:
        """How the threads that match are scheduled; None is as usual.

        Raises:
            OptionError: a number is none that can be, or has no effect without ``realtime``.
        """
        if not self.realtime:
            check_unused({"nice": self.nice, "cores": self.cores or None}, "realtime")
            return None
        return Realtime(nice=self.nice, cores=self.cores)

    def live_options(self, deadline_ms: float = 121.0) -> LiveOptions:
        """The deadlines of the frames, with the one that counts where none was set."""
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
    """Bridge until the pictures end or the time is over.

    Args:
        files: map, camera and pictures.
        link: the autopilot.
        settings: how frames are matched; None is the defaults.
        supervise: whether this process stays behind with what is loaded, to replace a worker that is killed.
        live_view: where the live view goes.
        progress: is shown what the bridge does.

    Returns:
        What was done.

    Raises:
        MissingExtraError: pymavlink, or for a serial line pyserial, is not installed.
        BackendError: the link cannot be opened.
        OptionError, MapError, CalibrationError, TelemetryError: an argument or a file is not as expected.
    """
    require("pymavlink", "mavlink")
    live_view.check()
    from scenematch.bridges.mavlink import MavlinkBridge
    from scenematch.bridges.packets import read_key

    settings = settings or BridgeSettings()
    connection = parse_connection(link.connect, listen_anywhere=link.listen_anywhere)
    outgoing = link.outgoing()
    start = parse_position("start", settings.start)
    key = None if link.key is None else read_key(Path(link.key))
    site = files.map.open(progress)
    camera = files.load_camera(progress)
    check_position("start", start, site, OptionError)
    matcher = SceneMatcher(site, camera, settings.method, settings.device, settings.matcher)
    with progress.task("compiling") as report_compiled:
        matcher.warmup(report_compiled)
    # A camera's bridge may start in the air; a flight that is played begins where it began.
    resumes = files.camera_source is not None
    last_fix = LastFix(
        last_fix_file(link.connect, link.system_id, Path(files.map.map).absolute()) if resumes else None
    )
    end_on_sigterm()  # before there is a worker, which has it from its first instruction on
    if supervise:
        check_supervision(matcher.device)
        become_worker(progress)
    start = _resumed(last_fix.prior(settings.live_options().max_speed_mps), start, site, progress)

    # Before the link: an autopilot on the bench takes off when the bridge listens.
    pictures = files.pictures(lambda: _wait_for_autopilot(bridge, progress, beat))
    with open_bridge_view(matcher, live_view, settings.navigator) as (make_navigator, watcher):
        try:
            bridge = MavlinkBridge(
                connection, make_navigator, outgoing, start, settings.live_options(outgoing.max_age_ms),
                origin=link.origin(site, start), use_velocity=link.use_velocity, site=site,
                check_gnss=link.check_gnss, system_id=link.system_id, component_id=link.component_id, key=key,
                watch=watcher, on_sent=last_fix.keep, gimbal_mount=camera.mount if files.gimbal else None,
            )  # fmt: skip
        except OSError as error:
            raise BackendError(f"connect: {link.connect} cannot be opened: {error.strerror or error}") from None
        with bridge:
            scheduling = settings.scheduling()
            if scheduling is not None:  # this thread, too, may hold Python's lock
                set_realtime(replace(scheduling, cores=()))  # of which a camera's command would inherit
            # Ctrl-C is the usual end beside a camera, and no reason to lose the counts.
            with running_service() as beat, closing(pictures), suppress(KeyboardInterrupt):
                _run(bridge, pictures, camera, settings.seconds, progress, beat)
            if files.camera_source is not None:
                remember_delay(bridge.status.least_age_ms)
            return bridge.status


def _resumed(last: Prior | None, start: Prior | None, site: OrthoMap, progress: Progress) -> Prior | None:
    """Where the bridge before this one, or the worker, sent its last fix, unless that is too long ago."""
    if last is None:
        return start
    try:
        check_position("last fix", last, site, OptionError)
    except OptionError:  # the file of the map is another one now
        return start
    progress.message(f"goes on from the last fix, which has grown uncertain by {last.sigma_m:.0f} m")
    return last


def _run(
    bridge: MavlinkBridge,
    pictures: Iterator[CapturedImage | None],
    camera: Camera,
    seconds: float | None,
    progress: Progress,
    beat: Callable[[], None],
) -> None:
    """Every picture to the bridge; now and then a line of what it does."""
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
    """A flight that is played begins with the autopilot's: where it was earlier is not known."""
    if not bridge.connected:
        progress.message(f"the pictures wait for the autopilot, {_AUTOPILOT_TIMEOUT_S:g} s at most")
    until = time.monotonic() + _AUTOPILOT_TIMEOUT_S
    while not bridge.connected and time.monotonic() < until:
        beat()
        time.sleep(0.002)


def _wait_for_answers(answered: Callable[[], int], count: int) -> None:
    """The last frame's answer; those that newer frames replaced have none."""
    before, until = -1, time.monotonic() + 2.0
    while answered() not in (before, count) and time.monotonic() < until:
        before = answered()
        time.sleep(0.3)
