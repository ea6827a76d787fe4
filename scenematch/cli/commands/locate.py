"""The command `locate`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scenematch.cli import console, options
from scenematch.cli.options import option, with_options

if TYPE_CHECKING:
    from engine.values import Fix, NoFix


@with_options
def locate(
    image: Annotated[Path, typer.Argument(metavar="IMAGE")],
    site: options.MapOptions,
    lens: options.CameraOptions,
    *,
    height_agl_m: Annotated[float | None, option("--height-agl", "M")] = None,
    heading_deg: Annotated[float | None, option("--heading", "DEG")] = None,
    roll_deg: Annotated[float | None, option("--roll", "DEG")] = None,
    pitch_deg: Annotated[float | None, option("--pitch", "DEG")] = None,
    matching: options.MatchingOptions,
    settings: options.SettingsOption = None,
) -> None:
    """Find one picture on the map.

    Prints the fix and exits with 0, or prints why there is none and exits with 1.

    Options:
        image: One picture.
        height_agl_m: Metres above the ground.
        heading_deg: Degrees clockwise from true north.
        roll_deg: Degrees, right side down.
        pitch_deg: Degrees, nose up.
        start: Where to search (default: the whole map).
        camera: Calibration file (default: from EXIF).
    """
    from engine.values import Fix
    from scenematch.files.track import looks_text
    from scenematch.runs.single_image import locate_image

    given = options.read_settings(settings)
    result = locate_image(
        image,
        site.map_input(given),
        lens.camera_input(given),
        height_agl_m=height_agl_m,
        heading_deg=heading_deg,
        roll_deg=roll_deg,
        pitch_deg=pitch_deg,
        settings=matching.track_settings(given),
        progress=console.PROGRESS,
    )
    facts = _fix_facts(result) if isinstance(result, Fix) else _no_fix_facts(result)
    facts |= {"looks": looks_text(result), "latency_ms": result.timings.total_ms}
    console.facts(facts, title=str(image))
    found, place = isinstance(result, Fix), console.quoted(site.map)
    console.next_step(f"track --map {place} --frames FRAMES --out out" if found else f"map info {place}")
    raise typer.Exit(0 if found else 1)


def _fix_facts(fix: Fix) -> dict[str, Any]:
    places = ("lat_deg", "lon_deg", "east_m", "north_m", "up_m", "sigma_m")
    names = (*places, "score", "method", "map_xy_px")
    facts = {"status": "fix"} | {name: getattr(fix, name) for name in names}
    if console.AS_JSON.get():
        facts["covariance_m2"] = fix.covariance_m2.tolist()
        facts["attitude"] = None if fix.attitude is None else asdict(fix.attitude)
        facts["attitude_sigma_deg"] = fix.attitude_sigma_deg
    return facts


def _no_fix_facts(refusal: NoFix) -> dict[str, Any]:
    facts = {"status": "no_fix", "reason": refusal.reason.value, "detail": refusal.detail}
    return facts | {"score": refusal.score, "method": refusal.method}
