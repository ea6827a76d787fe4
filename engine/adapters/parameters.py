"""Parameter files that configure ArduPilot and PX4 to use the bridge's fixes."""

from __future__ import annotations

from engine.errors import OptionError

MAX_DELAY_MS = 250.0
"""Upper bound of ArduPilot's VISO_DELAY_MS."""

_INT, _FLOAT = 6, 9  # MAV_PARAM_TYPE, as QGroundControl writes it
Parameter = tuple[str, float, str]
"""Name, value, purpose."""


def parameter_file(firmware: str, message: str, *, delay_ms: int, max_sigma_m: float) -> str:
    """The text of a parameter file.

    Args:
        firmware: ardupilot or px4.
        message: the message that the bridge sends.
        delay_ms: time from capture to arrival at the autopilot.
        max_sigma_m: upper bound of the sigma of the fixes that are sent.

    Raises:
        OptionError: the delay is out of range.
    """
    if not 0 <= delay_ms <= MAX_DELAY_MS:
        raise OptionError(f"delay_ms: expected 0 to {MAX_DELAY_MS:g}, got {delay_ms}")
    if firmware == "ardupilot":
        lines = _gps_input() if message == "gps_input" else _external_navigation(delay_ms)
        text = [f"# ArduPilot 4.5 and later, {message} by scenematch bridge mavlink. Reboot after loading."]
        for name, value, why in lines:
            text += [f"# {why}", f"{name},{value:g}"]
        return "\n".join(text) + "\n"
    lines = _agp(delay_ms, max_sigma_m) if message == "global_position_sensor" else _external_vision(delay_ms)
    text = [f"# PX4 1.15 and later, {message} by scenematch bridge mavlink. Reboot after loading.", "#"]
    text += [f"# {name}: {why}" for name, _, why in lines]
    text += ["#", "# Vehicle-Id Component-Id Name Value Type"]
    for name, value, _ in lines:
        whole = name.endswith(("_CTRL", "_ID", "_MODE", "_REF", "_MD"))
        text.append(f"1\t1\t{name}\t{value:g}\t{_INT if whole else _FLOAT}")
    return "\n".join(text) + "\n"


def _external_navigation(delay_ms: int) -> list[Parameter]:
    return [
        ("AHRS_EKF_TYPE", 3, "EKF3"),
        ("EK3_ENABLE", 1, "EKF3"),
        ("EK2_ENABLE", 0, "EKF3 alone"),
        ("VISO_TYPE", 1, "vision by MAVLink"),
        ("VISO_DELAY_MS", delay_ms, "from capture to arrival: the least age that the bridge prints; at most 250"),
        ("VISO_POS_M_NSE", 0.2, "floor of the position's sigma"),
        ("EK3_SRC1_POSXY", 6, "horizontal position by external navigation"),
        ("EK3_SRC1_VELXY", 0, "no velocity: that of two fixes says no more than they do"),
        ("EK3_SRC1_POSZ", 1, "height by the barometer: a map's height has another zero"),
        ("EK3_SRC1_VELZ", 0, "no vertical velocity"),
        ("EK3_SRC1_YAW", 1, "heading by the compass: the bridge sends the vehicle's own back"),
    ]


def _gps_input() -> list[Parameter]:
    return [
        ("AHRS_EKF_TYPE", 3, "EKF3"),
        ("EK3_ENABLE", 1, "EKF3"),
        ("GPS1_TYPE", 14, "GPS_INPUT by MAVLink; GPS_TYPE before 4.6"),
        ("GPS1_DELAY_MS", 0, "the stamps are of capture; GPS_DELAY_MS before 4.6"),
        ("EK3_SRC1_POSXY", 3, "horizontal position by the GPS"),
        ("EK3_SRC1_VELXY", 3, "velocity by the GPS: GPS_INPUT carries it"),
        ("EK3_SRC1_POSZ", 1, "height by the barometer"),
        ("EK3_SRC1_VELZ", 0, "no vertical velocity: what is sent is the vehicle's own"),
        ("EK3_SRC1_YAW", 1, "heading by the compass"),
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
        ("EKF2_AGP0_DELAY", 0, "the time since the capture is sent"),
        ("EKF2_AGP_DELAY", 0, "the same in older firmware"),
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
