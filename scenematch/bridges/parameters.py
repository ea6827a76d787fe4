"""What is sent to ArduPilot and PX4, and the parameter files that configure them to use it."""

from __future__ import annotations

from dataclasses import dataclass

from engine.errors import OptionError
from engine.values import check, check_choice, check_positive

MAX_DELAY_MS = 250.0
"""Upper bound of ArduPilot's VISO_DELAY_MS."""

MESSAGES = {
    "ardupilot": ("vision_position_estimate", "odometry", "gps_input"),
    "px4": ("global_position_sensor", "odometry"),
}
"""Messages that each firmware accepts; the first is the default."""

_MAX_GPS_ID = 3
_INT, _FLOAT = 6, 9  # MAV_PARAM_TYPE, as QGroundControl writes it
Parameter = tuple[str, float, str]
"""Name, value, purpose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MavlinkOptions:
    """The autopilot, which MAVLink message carries the fixes to it, and which fixes are withheld.

    Attributes:
        system_id: system id of the vehicle; others are ignored.
        component_id: component id of the bridge on the vehicle.
        firmware: ardupilot or px4.
        message: one of the firmware's :data:`MESSAGES`; empty for its default.
        max_sigma_m: upper bound of a fix's sigma; ArduPilot would clamp a larger one and trust the fix too much.
        use_velocity: use the autopilot's velocity for dead reckoning between fixes.
        check_gnss: check the first fixes against the autopilot's GNSS receiver, if it has a fix.
        gps_id: number of the receiver that GPS_INPUT emulates; 0 is the autopilot's first, 1 its second.

    Raises:
        OptionError: a name is unknown, or a number is out of range.
    """

    system_id: int = 1
    component_id: int = 197
    firmware: str = "ardupilot"
    message: str = ""
    max_sigma_m: float = 10.0
    use_velocity: bool = True
    check_gnss: bool = True
    gps_id: int = 0

    def __post_init__(self) -> None:
        check_positive(self, "max_sigma_m")
        check(self, "system_id", "1 to 255", lambda number: 1 <= number <= 255)
        check(self, "component_id", "2 to 255 (1 is the autopilot)", lambda number: 2 <= number <= 255)
        check_choice(self, "firmware", tuple(MESSAGES))
        if self.message and self.message not in MESSAGES[self.firmware]:
            known = ", ".join(MESSAGES[self.firmware])
            raise OptionError(f"message: expected one of {known} for {self.firmware}, got {self.message!r}")
        check(self, "gps_id", f"0 to {_MAX_GPS_ID}", lambda number: 0 <= number <= _MAX_GPS_ID)
        if self.gps_id and self.kind != "gps_input":
            raise OptionError(f"gps_id: expected with gps_input only, got {self.kind}")
        if self.max_sigma_m > 100.0:
            raise OptionError(
                f"max_sigma_m: expected at most 100 (ArduPilot clamps there), got {self.max_sigma_m:g}"
            )

    @property
    def kind(self) -> str:
        """Name of the message that is sent, in lower case."""
        return self.message or MESSAGES[self.firmware][0]

    @property
    def needs_origin(self) -> bool:
        """Whether the message carries positions relative to the autopilot's origin."""
        return self.kind in ("vision_position_estimate", "odometry")


def parameter_file(sent: MavlinkOptions, takeoff: str = "none", delay_ms: int = 100) -> str:
    """The text of a parameter file.

    Args:
        sent: what the bridge sends, and to which firmware.
        takeoff: "none" without GNSS, or "gnss": ArduPilot takes off with its receiver and switches over in flight.
        delay_ms: time from capture to arrival at the autopilot.

    Raises:
        OptionError: the delay is out of range, or the message does not allow the take-off.
    """
    if not 0 <= delay_ms <= MAX_DELAY_MS:
        raise OptionError(f"delay_ms: expected 0 to {MAX_DELAY_MS:g}, got {delay_ms}")
    if takeoff not in ("none", "gnss"):
        raise OptionError(f"takeoff: expected none or gnss, got {takeoff!r}")
    if takeoff == "gnss" and sent.firmware != "ardupilot":
        raise OptionError(f"takeoff: expected none for {sent.firmware}, got {takeoff!r}")
    if takeoff == "gnss" and sent.kind == "gps_input" and sent.gps_id == 0:
        raise OptionError("gps_id: expected 1 or more beside a receiver, got 0")
    if sent.firmware == "px4":
        return _px4_file(sent, delay_ms)
    text = [f"# ArduPilot 4.5 and later, {sent.kind} by scenematch bridge mavlink; then reboot."]
    for name, value, why in _ardupilot(sent, takeoff == "gnss", delay_ms):
        text += [f"# {why}", f"{name},{value:g}"]
    return "\n".join(text) + "\n"


def _px4_file(sent: MavlinkOptions, delay_ms: int) -> str:
    """As QGroundControl writes it."""
    position = sent.kind == "global_position_sensor"
    lines = _agp(delay_ms, sent.max_sigma_m) if position else _external_vision(delay_ms)
    text = [f"# PX4 1.15 and later, {sent.kind} by scenematch bridge mavlink. Reboot after loading.", "#"]
    text += [f"# {name}: {why}" for name, _, why in lines]
    text += ["#", "# Vehicle-Id Component-Id Name Value Type"]
    for name, value, _ in lines:
        whole = name.endswith(("_CTRL", "_ID", "_MODE", "_REF", "_MD"))
        text.append(f"1\t1\t{name}\t{value:g}\t{_INT if whole else _FLOAT}")
    return "\n".join(text) + "\n"


def _ardupilot(sent: MavlinkOptions, with_receiver: bool, delay_ms: int) -> list[Parameter]:
    as_receiver = sent.kind == "gps_input"
    lines = [*_EKF3, *(_gps_input(sent.gps_id, delay_ms) if as_receiver else _external_navigation(delay_ms))]
    if as_receiver or with_receiver:
        lines += _source_set(1, position=3, velocity=3)
    else:
        lines += _source_set(1, position=6, velocity=0)
        lines.append(("GPS1_TYPE", 0, "no receiver; GPS_TYPE before 4.6"))
    if with_receiver and as_receiver:
        lines.append(("GPS_AUTO_SWITCH", 4, "the first receiver as long as it has a fix, then the fixes"))
    elif with_receiver:
        lines.append(("RC7_OPTION", 90, "switch of the transmitter: low set 1, the receiver; middle set 2"))
        lines += _source_set(2, position=6, velocity=0)
    return [*lines, *_FAILSAFES]


_EKF3: list[Parameter] = [("AHRS_EKF_TYPE", 3, "EKF3"), ("EK3_ENABLE", 1, "EKF3"), ("EK2_ENABLE", 0, "EKF3 alone")]
_FAILSAFES: list[Parameter] = [
    ("FS_EKF_ACTION", 1, "LAND 8 s after the last fix; without a position it drifts with the wind"),
    ("FS_EKF_THRESH", 0.8, "variances above it for a second count as a failure, too"),
]


def _source_set(number: int, *, position: int, velocity: int) -> list[Parameter]:
    """A source set of EKF3: 3 is a receiver, 6 external navigation, 1 barometer or compass."""
    name = f"EK3_SRC{number}"
    return [
        (f"{name}_POSXY", position, "horizontal position by the receiver" if position == 3 else "by the fixes"),
        (f"{name}_VELXY", velocity, "velocity by the receiver" if velocity else "none: two fixes say no more"),
        (f"{name}_POSZ", 1, "height by the barometer: a map's height has another zero"),
        (f"{name}_VELZ", 0, "no vertical velocity"),
        (f"{name}_YAW", 1, "heading by the compass: the bridge sends the vehicle's own back"),
    ]


def _external_navigation(delay_ms: int) -> list[Parameter]:
    return [
        ("VISO_TYPE", 1, "vision by MAVLink"),
        ("VISO_DELAY_MS", delay_ms, "from capture to arrival: the least age that the bridge prints"),
        ("VISO_POS_M_NSE", 0.2, "floor of the position's sigma"),
    ]


def _gps_input(gps_id: int, delay_ms: int) -> list[Parameter]:
    name, older = f"GPS{gps_id + 1}", str(gps_id + 1) if gps_id else ""
    return [
        (f"{name}_TYPE", 14, f"GPS_INPUT by MAVLink; GPS_TYPE{older} before 4.6"),
        (f"{name}_DELAY_MS", max(delay_ms, 1), f"the least age; 0 would mean 200; GPS_DELAY_MS{older} before 4.6"),
    ]


def _agp(delay_ms: int, max_sigma_m: float) -> list[Parameter]:
    gate = 5.0 if max_sigma_m <= 10.0 else 3.0
    both = "newer firmware calls it so, older EKF2_AGP_CTRL: one of the two is not found"
    return [
        ("EKF2_AGP0_CTRL", 1, f"horizontal position by map matching; {both}"),
        ("EKF2_AGP_CTRL", 1, "the same in older firmware"),
        ("EKF2_AGP0_ID", 1, "the number that the bridge sends"),
        ("EKF2_AGP0_MODE", 0, "when it may reset the position: automatic"),
        ("EKF2_AGP0_NOISE", 0.3, "floor of the sigma; the default of 0.9 m would hide better fixes"),
        ("EKF2_AGP_NOISE", 0.3, "the same in older firmware"),
        ("EKF2_AGP0_GATE", gate, "innovation gate in sigmas"),
        ("EKF2_AGP_GATE", gate, "the same in older firmware"),
        ("EKF2_AGP0_DELAY", delay_ms, "from capture to arrival; PX4 stamps the message by its arrival"),
        ("EKF2_AGP_DELAY", delay_ms, "the same in older firmware"),
        ("EKF2_DELAY_MAX", max(200, delay_ms + 50), "as far back as a capture may lie"),
        ("EKF2_GPS_CTRL", 0, "no GNSS; leave it at 7 to have both"),
        ("EKF2_HGT_REF", 0, "height by the barometer"),
    ]


def _external_vision(delay_ms: int) -> list[Parameter]:
    return [
        ("EKF2_EV_CTRL", 1, "horizontal position by vision, and nothing else of it"),
        ("EKF2_EV_DELAY", 0, "the stamps are of capture, on a clock that TIMESYNC ties to PX4's"),
        ("EKF2_EV_NOISE_MD", 0, "the sigma of each message"),
        ("EKF2_EVP_NOISE", 0.3, "floor of the sigma"),
        ("EKF2_DELAY_MAX", max(200, delay_ms + 50), "as far back as a capture may lie"),
        ("EKF2_GPS_CTRL", 0, "no GNSS"),
        ("EKF2_HGT_REF", 0, "height by the barometer"),
    ]
