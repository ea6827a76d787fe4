"""``locate``: one picture, found on the map or refused."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import check_choice, check_device, open_map, parse_position
from engine.errors import OptionError
from engine.formats.frames import read_image
from engine.matcher import SceneMatcher
from engine.methods import METHODS
from engine.runs.checks import check_place
from engine.values import Fix, Frame, NoFix


@dataclass(frozen=True, slots=True)
class Known:
    """What the user knows of the picture; None where unknown.

    Attributes:
        height_agl_m: above the ground.
        heading_deg: clockwise from true north.
        roll_deg: right side down.
        pitch_deg: nose up.
        near: LAT,LON[,SIGMA_M], or None for the whole map.

    Raises:
        OptionError: a number is not finite, or the height is not above 0.
    """

    height_agl_m: float | None
    heading_deg: float | None
    roll_deg: float | None
    pitch_deg: float | None
    near: str | None

    def __post_init__(self) -> None:
        for option, value in (
            ("--height-agl", self.height_agl_m),
            ("--heading", self.heading_deg),
            ("--roll", self.roll_deg),
            ("--pitch", self.pitch_deg),
        ):
            if value is not None and not math.isfinite(value):
                raise OptionError(f"{option}: expected a finite number, got {value}")
        if self.height_agl_m is not None and self.height_agl_m <= 0:
            raise OptionError(f"--height-agl: expected metres above 0, got {self.height_agl_m:g}")


def run_locate(
    image: Path,
    map_path: Path,
    camera_path: Path,
    surface: Path | None,
    map_sigma_m: float | None,
    known: Known,
    *,
    method: str,
    device: str,
    as_json: bool,
) -> bool:
    """Match one picture and print what came of it; whether there was a fix."""
    check_choice("--method", method, METHODS)
    check_device("--device", device)
    prior = parse_position("--near", known.near)
    site = open_map(map_path, surface, map_sigma_m)
    camera = Camera.load(camera_path)
    check_place("--near", prior, site, OptionError)
    pixels = read_image(image)
    camera.check_size(pixels.shape)
    frame = Frame(pixels, None, known.height_agl_m, known.heading_deg, known.roll_deg, known.pitch_deg)
    result = SceneMatcher(site, camera, method, device).locate(frame, prior)
    facts = _fix_facts(result, as_json) if isinstance(result, Fix) else _no_fix_facts(result)
    facts["latency_ms"] = result.timings.total_ms
    console.facts(facts, as_json, title=str(image))
    return isinstance(result, Fix)


def _fix_facts(fix: Fix, as_json: bool) -> dict[str, Any]:
    facts = {
        "status": "fix",
        "lat_deg": fix.lat_deg,
        "lon_deg": fix.lon_deg,
        "east_m": fix.east_m,
        "north_m": fix.north_m,
        "up_m": fix.up_m,
        "sigma_m": fix.sigma_m,
        "score": fix.score,
        "method": fix.method,
        "map_xy_px": list(fix.map_xy_px),
    }
    if as_json:
        facts["covariance_m2"] = fix.covariance_m2.tolist()
        facts["attitude"] = None if fix.attitude is None else asdict(fix.attitude)
    return facts


def _no_fix_facts(refusal: NoFix) -> dict[str, Any]:
    return {
        "status": "no_fix",
        "reason": refusal.reason.value,
        "detail": refusal.detail,
        "score": refusal.score,
        "method": refusal.method,
    }
