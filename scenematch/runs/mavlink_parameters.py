"""Write the parameter file for an autopilot that uses the bridge's fixes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from engine.errors import require
from scenematch.bridges.parameters import MavlinkOptions, parameter_file
from scenematch.runs.output import StrPath, check_file


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterSettings:
    """Settings of a parameter file besides the bridge's own.

    Attributes:
        takeoff: "none" without GNSS, or "gnss" to take off with GNSS and switch ArduPilot over in flight.
        delay_ms: from capture to arrival: the least age that the bridge prints.
    """

    takeoff: str = "none"
    delay_ms: int = 100


def write_parameter_file(
    out: StrPath, link: MavlinkOptions, settings: ParameterSettings | None = None, *, force: bool = False
) -> None:
    """Write the parameters with which an autopilot uses the bridge's fixes.

    Args:
        out: the file.
        link: what is sent to the autopilot.
        settings: of the file; None uses the defaults.
        force: whether the file may already exist.

    Raises:
        OptionError: a setting is invalid, or the file exists and ``force`` was not given.
        BackendError: pymavlink is not installed.
    """
    require("pymavlink", "mavlink")
    out, settings = Path(out), settings or ParameterSettings()
    text = parameter_file(link, settings.takeoff, settings.delay_ms)
    check_file(out, force)
    out.write_text(text, encoding="utf-8")
