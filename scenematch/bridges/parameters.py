"""What is sent to ArduPilot and PX4, and the parameter files that configure them to use it.

The files are filled from the templates ``ardupilot.params`` and ``px4.params`` beside this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from engine.errors import OptionError
from engine.values import check, check_choice

MAX_DELAY_MS = 250.0
"""Upper bound of ArduPilot's VISO_DELAY_MS."""

MESSAGES = {
    "ardupilot": ("vision_position_estimate", "odometry", "gps_input"),
    "px4": ("odometry", "global_position_sensor"),
}
"""Messages that each firmware accepts; the first is the default."""

_MAX_GPS_ID = 3


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
        upto = "a number above 0 and at most 100 (ArduPilot clamps there)"
        check(self, "max_sigma_m", upto, lambda sigma_m: 0.0 < sigma_m <= 100.0)
        check(self, "system_id", "1 to 255", lambda number: 1 <= number <= 255)
        check(self, "component_id", "2 to 255 (1 is the autopilot)", lambda number: 2 <= number <= 255)
        check_choice(self, "firmware", tuple(MESSAGES))
        if self.message and self.message not in MESSAGES[self.firmware]:
            known = ", ".join(MESSAGES[self.firmware])
            raise OptionError(f"message: expected one of {known} for {self.firmware}, got {self.message!r}")
        check(self, "gps_id", f"0 to {_MAX_GPS_ID}", lambda number: 0 <= number <= _MAX_GPS_ID)
        if self.gps_id and self.kind != "gps_input":
            raise OptionError(f"gps_id: expected with gps_input only, got {self.kind}")

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
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    templates = Environment(
        loader=FileSystemLoader(Path(__file__).parent), trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True, undefined=StrictUndefined,
    )  # fmt: skip
    template = templates.get_template(f"{sent.firmware}.params")
    return template.render(sent=sent, with_receiver=takeoff == "gnss", delay_ms=delay_ms)
