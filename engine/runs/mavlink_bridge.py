"""``bridge mavlink`` and its parameter files: a camera and an autopilot in, fixes to the autopilot out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from engine.adapters.links import parse_connection
from engine.adapters.parameters import parameter_file
from engine.adapters.pictures import CapturedImage, capture, replay
from engine.adapters.vehicle import NedOrigin
from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import (
    check_choice,
    check_device,
    named_as_typed,
    open_map,
    parse_position,
    refuse_given,
)
from engine.errors import BackendError, CalibrationError, OptionError, TelemetryError
from engine.live import LiveOptions
from engine.matcher import METHODS, SceneMatcher
from engine.orthomap import OrthoMap
from engine.runs.checks import check_place
from engine.runs.watching import Watching, watched_beside

if TYPE_CHECKING:
    from engine.adapters.mavlink import MavlinkBridge, MavlinkStatus
    from engine.adapters.mavlink_out import MavlinkOptions

_SAY_EVERY_S = 5.0
_HEAR_S = 10.0
_MAX_ALT_M = 10_000.0  # of an origin: beyond the ground of the Earth, and MAVLink's millimetres hold it
_MAX_GRAB_MS = 10_000.0


@dataclass(frozen=True, slots=True)
class BridgeFiles:
    """The map, the camera, and where pictures come from: files or a camera, one of the two."""

    map: Path
    surface: Path | None
    camera: Path
    frames: Path | None
    telemetry: Path | None
    source: str | None
    rate_hz: float | None = None  # of pictures without stamps; None for 10
    exposure_to_grab_ms: float | None = None  # of a camera; None for none
    map_sigma_m: float | None = None  # how well the map lies, where it does not say

    def __post_init__(self) -> None:
        if (self.frames is None) == (self.source is None):
            raise OptionError("--frames: expected either --frames or --camera-source")
        if self.frames is None:
            refuse_given({"--telemetry": self.telemetry, "--rate-hz": self.rate_hz}, "--frames")
        else:
            refuse_given({"--exposure-to-grab-ms": self.exposure_to_grab_ms}, "--camera-source")
        if self.rate_hz is not None and not 1e-3 <= self.rate_hz < math.inf:
            raise OptionError(f"--rate-hz: expected a number of 0.001 or more, got {self.rate_hz:g}")
        if self.exposure_to_grab_ms is not None and not 0.0 <= self.exposure_to_grab_ms <= _MAX_GRAB_MS:
            raise OptionError(
                f"--exposure-to-grab-ms: expected 0 to {_MAX_GRAB_MS:g}, got {self.exposure_to_grab_ms:g}"
            )

    def pictures(self, wait: Callable[[], None] | None = None) -> Iterator[CapturedImage]:
        """Pictures as they are captured; those of a flight that is played begin when ``wait`` returns."""
        if self.frames is not None:
            return replay(self.frames, self.telemetry, rate_hz=self.rate_hz or 10.0, wait=wait)
        assert self.source is not None  # one of the two is given
        return capture(self.source, exposure_to_grab_ms=self.exposure_to_grab_ms or 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """How the autopilot is reached and what it is told, as the command line has it.

    Raises:
        OptionError: the height of the origin is not one of the Earth's, or there is to be no origin.
    """

    connect: str
    listen_anywhere: bool
    system_id: int
    key: Path | None
    firmware: str
    message: str
    max_sigma_m: float
    set_origin: bool
    origin_alt_m: float | None
    use_velocity: bool

    def __post_init__(self) -> None:
        if not self.set_origin:
            refuse_given({"--origin-alt-m": self.origin_alt_m}, "--set-origin")
        if self.origin_alt_m is not None and not abs(self.origin_alt_m) <= _MAX_ALT_M:
            raise OptionError(
                f"--origin-alt-m: expected {-_MAX_ALT_M:g} to {_MAX_ALT_M:g}, got {self.origin_alt_m:g}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchSettings:
    """How frames are matched, as the command line has it.

    Raises:
        OptionError: a word or a number is none of those that are expected.
        DeviceError: the device is missing.
    """

    method: str
    device: str
    start: str | None
    deadline_ms: float
    seconds: float | None

    def __post_init__(self) -> None:
        check_choice("--method", self.method, METHODS)
        check_device("--device", self.device)
        parse_position("--start", self.start)
        self.live_options()

    def live_options(self) -> LiveOptions:
        """The deadlines of the frames."""
        with named_as_typed(deadline_ms="--deadline-ms"):
            return LiveOptions(deadline_ms=self.deadline_ms)


def run_bridge(
    inputs: BridgeFiles, wire: LinkSettings, matching: MatchSettings, *, as_json: bool, watching: Watching
) -> None:
    """Bridge until the pictures end, the time is over or somebody interrupts, and print what was done."""
    _need_pymavlink()
    watching.check()
    from engine.adapters.mavlink import MavlinkBridge
    from engine.adapters.packets import read_key

    connection = parse_connection(wire.connect, listen_anywhere=wire.listen_anywhere)
    options = _outgoing(wire.firmware, wire.message, wire.max_sigma_m)
    start = parse_position("--start", matching.start)
    key = None if wire.key is None else read_key(wire.key)
    site = open_map(inputs.map, inputs.surface, inputs.map_sigma_m)
    camera = Camera.load(inputs.camera)
    check_place("--start", start, site, OptionError)
    matcher = SceneMatcher(site, camera, matching.method, matching.device)
    matcher.warmup()

    with watched_beside(matcher, watching) as (make_navigator, watcher):
        try:
            bridge = MavlinkBridge(
                connection, make_navigator, options, start, matching.live_options(),
                origin=_origin(site, wire), use_velocity=wire.use_velocity, system_id=wire.system_id, key=key,
                watch=watcher,
            )  # fmt: skip
        except OSError as error:
            raise BackendError(f"--connect: {wire.connect} cannot be opened: {error.strerror or error}") from None
        with bridge:
            pictures = inputs.pictures(lambda: _wait_for_autopilot(bridge))
            _follow(bridge, pictures, camera, matching.seconds)
            status = bridge.status
    console.facts(asdict(status), as_json, title=f"{options.kind} to {wire.connect}")


def write_parameters(
    firmware: str, message: str, out: Path, *, delay_ms: int, max_sigma_m: float, force: bool
) -> None:
    """Write the parameter file of a firmware."""
    _need_pymavlink()
    options = _outgoing(firmware, message, max_sigma_m)
    text = parameter_file(firmware, options.kind, delay_ms=delay_ms, max_sigma_m=max_sigma_m)
    if out.exists() and not force:
        raise OptionError(f"--out: {out} exists; choose another file, or add --force to replace it")
    out.write_text(text, encoding="utf-8")
    console.say(f"written to {out}")


def _need_pymavlink() -> None:
    try:
        import pymavlink  # noqa: F401
    except ImportError:
        raise BackendError(
            "bridge: expected pymavlink to be installed, the extra [mavlink]: pip install pymavlink"
        ) from None


def _outgoing(firmware: str, message: str, max_sigma_m: float) -> MavlinkOptions:
    from engine.adapters.mavlink_out import MavlinkOptions

    with named_as_typed(firmware="--firmware", message="--message", max_sigma_m="--max-sigma-m"):
        return MavlinkOptions(firmware=firmware, message=message, max_sigma_m=max_sigma_m)


def _origin(site: OrthoMap, wire: LinkSettings) -> NedOrigin | None:
    """The map's, at the height of its ground where none is told."""
    if not wire.set_origin:
        return None
    alt_m = site.ground_m if wire.origin_alt_m is None else wire.origin_alt_m
    return NedOrigin(site.frame.lat_deg, site.frame.lon_deg, alt_m)


def _follow(
    bridge: MavlinkBridge, pictures: Iterator[CapturedImage], camera: Camera, seconds: float | None
) -> None:
    """Every picture to the bridge; now and then a line of what it does."""
    begin = said = time.monotonic()
    count = 0
    for image, captured_ns in pictures:
        count += 1
        try:
            camera.check_size(image.shape)
        except CalibrationError as error:
            raise CalibrationError(f"picture {count}: {error}") from None
        bridge.submit(image, captured_ns)
        now = time.monotonic()
        if now - said >= _SAY_EVERY_S:
            said = now
            console.say(_line(bridge.status))
        if seconds is not None and now - begin >= seconds:
            return
    if count == 0:
        raise TelemetryError("--frames: expected at least one picture, got none")
    _wait_for_answers(lambda: bridge.status.answered, count)


def _wait_for_autopilot(bridge: MavlinkBridge) -> None:
    """A flight that is played begins with the autopilot's: where it was earlier, nobody would have told."""
    if not bridge.connected:
        console.say(f"the pictures wait for the autopilot, {_HEAR_S:g} s at most")
    until = time.monotonic() + _HEAR_S
    while not bridge.connected and time.monotonic() < until:
        time.sleep(0.002)


def _wait_for_answers(answered: Callable[[], int], count: int) -> None:
    """The last frame's answer; those that newer frames replaced have none."""
    before, until = -1, time.monotonic() + 2.0
    while answered() not in (before, count) and time.monotonic() < until:
        before = answered()
        time.sleep(0.3)


def _line(status: MavlinkStatus) -> str:
    from engine.adapters.mavlink import MIN_RATE_HZ

    reasons = ", ".join(f"{why} {n}" for why, n in {**status.withheld, **status.refused}.items()) or "nothing"
    heard = "autopilot heard" if status.connected else "no autopilot"
    slow = f" (below {MIN_RATE_HZ:g} Hz an estimator may let go)" if status.rate_hz < MIN_RATE_HZ else ""
    return f"{heard}; sent {status.sent}, {status.rate_hz:.1f} Hz{slow}; not sent: {reasons}"
