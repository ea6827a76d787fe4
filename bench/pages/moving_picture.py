"""The moving picture of the README: a flight in the evening, followed over a map of noon.

    python -m bench.pages.moving_picture FLIGHT [--step N] [--out docs/img/flight.webp]

FLIGHT is a flight folder. Left the frame; right the map with the searched window, the fixes so far
and the last fix with its ellipse, enlarged tenfold so that it can be seen.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from bench import DOCS
from engine import Camera, Fix, Frame, Navigator, NoFix, OrthoMap, Prior, SceneMatcher, Window
from engine.errors import MapError
from scenematch.files.flight import open_flight
from scenematch.files.truth import read_truth

SIDE_PX, LINE_PX = 360, 40  # of each half, and of the line below
SPAN_M = 380.0  # of the ground in the map's half
MAP_SIGMA_M = 0.07  # of this map, whose georeference is known from the world that it was drawn from
ENLARGED = 10.0  # the ellipse
TRAIL, FOUND, WINDOW, TEXT, BACK = "#ffd21f", "#22d35e", "#38a8ff", "#f4f6f8", "#14181d"


def main() -> None:
    """Follow the flight and write one picture of all its frames."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flight", type=Path, help="a flight folder")
    parser.add_argument("--step", type=int, default=20, help="one frame in so many")
    parser.add_argument("--out", type=Path, default=DOCS / "img" / "flight.webp")
    options = parser.parse_args()
    pictures = draw_flight(options.flight, options.step)
    pictures[0].save(
        options.out, save_all=True, append_images=pictures[1:], duration=250, loop=0, quality=50, method=6
    )


def draw_flight(folder: Path, step: int) -> list[Image.Image]:
    """A picture of each frame."""
    site = OrthoMap.open(folder / "map.tif", surface=folder / "dsm.tif", georeference_sigma_m=MAP_SIGMA_M)
    matcher = SceneMatcher(site, Camera.load(folder / "camera.yaml"), method="ncc")
    begin = read_truth(folder / "truth.csv")[0]
    navigator = Navigator(matcher, Prior(lat_deg=begin.lat_deg, lon_deg=begin.lon_deg, sigma_m=15.0))
    shape = site.level_shape(0)
    ground = site.rgb(Window(0, 0, shape[1], shape[0]), shape)
    if ground is None:
        raise MapError(f"{folder / 'map.tif'}: expected a map in colour, got grey levels")
    picture, trail, pictures = Image.fromarray(ground), list[tuple[float, float]](), []
    for item in list(open_flight(folder / "frames", folder / "telemetry.csv"))[::step]:
        result = navigator.update(item.frame)
        pictures.append(draw_frame(picture, site.gsd_m_per_px, item.frame, result, trail))
    return pictures


def draw_frame(
    ground: Image.Image, gsd_m: float, frame: Frame, result: Fix | NoFix, trail: list[tuple[float, float]]
) -> Image.Image:
    """Frame and map side by side, with what was found."""
    page = Image.new("RGB", (2 * SIDE_PX, SIDE_PX + LINE_PX), BACK)
    page.paste(Image.fromarray(np.asarray(frame.image)).resize((SIDE_PX, SIDE_PX)), (0, 0))
    side = SPAN_M / gsd_m
    left, top = (ground.width - side) / 2, (ground.height - side) / 2
    shown = ground.resize((SIDE_PX, SIDE_PX), box=(left, top, left + side, top + side))
    draw, zoom = ImageDraw.Draw(shown), SIDE_PX / side

    def at(x: float, y: float) -> tuple[float, float]:
        return (x - left) * zoom, (y - top) * zoom

    if isinstance(result, Fix):
        trail.append(result.map_xy_px)
        window = result.window
        corner = at(window.x0 + window.width_px, window.y0 + window.height_px)
        draw.rectangle([*at(window.x0, window.y0), *corner], outline=WINDOW, width=2)
    if len(trail) > 1:
        draw.line([at(*place) for place in trail], fill=TRAIL, width=3)
    if isinstance(result, Fix):
        draw.line([*ellipse(result, at, zoom / gsd_m)], fill=FOUND, width=3)
    page.paste(shown, (SIDE_PX, 0))
    text = ImageDraw.Draw(page)
    text.text((10, SIDE_PX + 9), caption(result), TEXT, font=ImageFont.load_default(size=18))
    text.line([(SIDE_PX, 0), (SIDE_PX, SIDE_PX)], fill=BACK, width=3)
    return page


def ellipse(
    fix: Fix, at: Callable[[float, float], tuple[float, float]], px_per_m: float
) -> list[tuple[float, float]]:
    """The outline of three sigmas about the fix, enlarged."""
    values, axes = np.linalg.eigh(fix.covariance_m2[:2, :2])
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    east, north = 3.0 * ENLARGED * px_per_m * (axes * np.sqrt(values)) @ circle
    x, y = at(*fix.map_xy_px)
    return [(x + float(e), y - float(n)) for e, n in zip(east, north, strict=True)]


def caption(result: Fix | NoFix) -> str:
    """The answer in one line."""
    if isinstance(result, NoFix):
        return f"no fix: {result.reason.value}"
    place = f"{result.lat_deg:.6f}  {result.lon_deg:.6f}"
    how = f"\u00b1 {result.sigma_m:.2f} m   {result.timings.total_ms:.0f} ms"
    return f"{place}   {how}    ellipse: 3 sigma x {ENLARGED:.0f}"


if __name__ == "__main__":
    main()
