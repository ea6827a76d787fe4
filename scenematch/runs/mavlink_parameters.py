"""Write the parameter file of an autopilot that flies by the bridge's fixes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from engine.errors import require
from scenematch.bridges.delay_memory import measured_delay_ms
from scenematch.bridges.parameters import ParameterOptions, parameter_file
from scenematch.runs.folders import StrPath, check_file
from scenematch.runs.mavlink_bridge import outgoing_options

_DEFAULT_DELAY_MS = 100


@dataclass(frozen=True, slots=True)
class WrittenParameters:
    """What a parameter file was written for.

    Attributes:
        delay_ms: from capture to arrival.
        delay_source: "given", "measured by the last bridge", or "assumed; not measured yet".
    """

    delay_ms: int
    delay_source: str


def write_parameter_file(
    firmware: str,
    message: str,
    out: StrPath,
    *,
    takeoff: str = "none",
    gps_id: int = 0,
    delay_ms: int | None = None,
    max_sigma_m: float = 10.0,
    force: bool = False,
) -> WrittenParameters:
    """Write the parameters that let an autopilot fly by the bridge's fixes.

    Args:
        firmware: "ardupilot" or "px4".
        message: that is sent; "" is the firmware's usual one.
        out: the file.
        takeoff: "none" without GNSS, or "gnss", from which ArduPilot is switched over in flight.
        gps_id: receiver that GPS_INPUT poses as.
        delay_ms: from capture to arrival; None is what the last bridge with a camera measured, else 100.
        max_sigma_m: of the fixes that are sent.
        force: whether the file may be there already.

    Returns:
        The delay that was written, and where it came from.
    """
    require("pymavlink", "mavlink")
    out, outgoing = Path(out), outgoing_options(firmware, message, max_sigma_m, gps_id)
    written = _delay(delay_ms)
    options = ParameterOptions(
        firmware=firmware, message=outgoing.kind, takeoff=takeoff, gps_id=gps_id, delay_ms=written.delay_ms,
        max_sigma_m=max_sigma_m,
    )  # fmt: skip
    text = parameter_file(options)
    check_file(out, force)
    out.write_text(text, encoding="utf-8")
    return written


def _delay(given_ms: int | None) -> WrittenParameters:
    if given_ms is not None:
        return WrittenParameters(given_ms, "given")
    measured_ms = measured_delay_ms()
    if measured_ms:
        return WrittenParameters(measured_ms, "measured by the last bridge")
    return WrittenParameters(_DEFAULT_DELAY_MS, "assumed; not measured yet")
