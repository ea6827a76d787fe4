"""``locate``: one picture, found on the map or refused."""

from __future__ import annotations

from pathlib import Path

from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import parse_position
from engine.formats.frames import read_image
from engine.matcher import SceneMatcher
from engine.orthomap import OrthoMap
from engine.types import Fix, Frame


def run_locate(
    image: Path,
    map_path: Path,
    camera_path: Path,
    surface: Path | None,
    *,
    attitude: tuple[float | None, float | None, float | None, float | None],
    near: str | None,
    method: str,
    device: str,
    as_json: bool,
) -> bool:
    """Match one picture and print what came of it; whether there was a fix.

    Args:
        image: the picture.
        map_path: the map.
        camera_path: the camera.
        surface: a surface model, or None.
        attitude: height above ground in m, heading, roll and pitch in degrees; None where unknown.
        near: LAT,LON[,SIGMA_M], or None for the whole map.
        method: "ncc", "sift" or "auto".
        device: "cpu", "cuda" or "auto".
        as_json: print JSON.
    """
    height_agl_m, heading_deg, roll_deg, pitch_deg = attitude
    prior = parse_position("--near", near) if near is not None else None
    frame = Frame(read_image(image), None, height_agl_m, heading_deg, roll_deg, pitch_deg)
    matcher = SceneMatcher(OrthoMap.open(map_path, surface=surface), Camera.load(camera_path), method, device)
    result = matcher.locate(frame, prior)
    if isinstance(result, Fix):
        facts = {
            "status": "fix",
            "lat_deg": result.lat_deg,
            "lon_deg": result.lon_deg,
            "east_m": result.east_m,
            "north_m": result.north_m,
            "up_m": result.up_m,
            "sigma_m": result.sigma_m,
            "score": result.score,
            "method": result.method,
            "map_xy_px": list(result.map_xy_px),
        }
    else:
        facts = {
            "status": "no_fix",
            "reason": result.reason.value,
            "detail": result.detail,
            "score": result.score,
            "method": result.method,
        }
    facts["latency_ms"] = result.timings.total_ms
    if not as_json and isinstance(result, Fix):  # enough decimals to see a centimetre
        facts |= {"lat_deg": f"{result.lat_deg:.8f}", "lon_deg": f"{result.lon_deg:.8f}"}
    console.facts(facts, as_json, title=str(image))
    return isinstance(result, Fix)
