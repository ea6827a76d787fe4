"""Write the parameter file for an autopilot that uses the bridge's fixes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from engine.errors import require
from scenematch.bridges.parameters import MavlinkOptions, parameter_file
from scenematch.runs.last_fix import measured_delay_ms
from scenematch.runs.output import StrPath, check_file

_DEFAULT_DELAY_MS = 100


@dataclass(frozen=True, slots=True)
class WrittenParameters:
    """The delay written into a parameter file, and its source.

    Attributes:
        delay_ms: from capture to arrival.
        delay_source: "given", "measured by the last bridge", or "assumed; not measured yet".
    """

    delay_ms: int
    delay_source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterSettings:
    """Settings of a parameter file besides the bridge's own.

    Attributes:
        takeoff: "none" without GNSS, or "gnss" to take off with GNSS and switch ArduPilot over in flight.
        delay_ms: from capture to arrival; none uses what the last bridge with a camera measured, else 100.
    """

    takeoff: str = "none"
    delay_ms: int | None = None


def write_parameter_file(
    out: StrPath, link: MavlinkOptions, settings: ParameterSettings | None = None, *, force: bool = False
) -> WrittenParameters:
    """Write the parameters with which an autopilot uses the bridge's fixes.

    Args:
        out: the file.
        link: what is sent to the autopilot.
        settings: of the file; None uses the defaults.
        force: whether the file may already exist.

    Returns:
        The delay written, and its source.
    """
    require("pymavlink", "mavlink")
    out, settings = Path(out), settings or ParameterSettings()
    delay_ms, source = settings.delay_ms, "given"
    if delay_ms is None:
        delay_ms, source = measured_delay_ms(), "measured by the last bridge"
        if not delay_ms:
            delay_ms, source = _DEFAULT_DELAY_MS, "assumed; not measured yet"
    text = parameter_file(link, settings.takeoff, delay_ms)
    check_file(out, force)
    out.write_text(text, encoding="utf-8")
    return WrittenParameters(delay_ms, source)
