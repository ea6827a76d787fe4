"""Explain single matches: match selected frames of a track again in their windows and draw them."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import EngineError
from engine.geo import Array
from engine.matching.for_reports import Explanation, PointMatches, ScoreSurface
from engine.matching.matcher import SceneMatcher
from engine.orthomap import OrthoMap
from engine.values import Frame, Window
from engine.window import level_crop, level_for
from scenematch.files.flight import Flight, FlightFrame
from scenematch.files.track import TrackRow
from scenematch.report.finished_track import FinishedTrack
from scenematch.report.metrics import TrackErrors

Image = NDArray[np.uint8]

MAX_FRAMES = 60
"""Maximum number of frames shown per flight."""
SIDE_PX = 360
"""Longer side of an image of the slider."""
_MAX_REMARKABLE = 40  # of these, fixes beyond three sigmas and refusals, so that ordinary frames remain
_MAX_BYTES = 32_000  # per image, so that a report of 60 frames stays below 15 MB
_QUALITIES = (82, 70, 55, 40, 25)
_AGREE, _OTHER = (0, 158, 115), (200, 200, 200)


@dataclass(frozen=True, slots=True)
class SliderImage:
    """An image of the slider.

    Attributes:
        src: data URI of the image.
        width_px: width of the image.
        height_px: height of the image.
        caption: text below it.
        alt: alternative text.
        overlay: SVG elements in pixels of the image.
    """

    src: str
    width_px: int
    height_px: int
    caption: str
    alt: str
    overlay: str = ""


@dataclass(frozen=True, slots=True)
class SliderFrame:
    """One frame of the slider: its index in the track, and its images from left to right."""

    index: int
    images: list[SliderImage]


def choose_frames(rows: Sequence[TrackRow], errors: TrackErrors) -> list[int]:
    """Select the frames to show: fixes beyond three sigmas first, then refusals, then evenly spaced others.

    Args:
        rows: the track.
        errors: of the track.

    Returns:
        Indices of rows, ascending.
    """
    if len(rows) <= MAX_FRAMES:
        return list(range(len(rows)))
    refused, beyond = np.array([not row.fixed for row in rows]), errors.beyond
    chosen: list[int] = []
    for kind, limit in (
        (beyond, _MAX_REMARKABLE),
        (refused, _MAX_REMARKABLE),
        (~refused & ~beyond, MAX_FRAMES),
        (refused | beyond, MAX_FRAMES),
    ):
        left = np.setdiff1d(np.flatnonzero(kind), chosen)
        chosen += evenly_spaced(left, limit - len(chosen))
    return sorted(chosen)


def evenly_spaced(indices: NDArray[np.intp], count: int) -> list[int]:
    """At most ``count`` of the indices, evenly spaced, with the first and the last."""
    if len(indices) > count:
        indices = indices[np.round(np.linspace(0, len(indices) - 1, count)).astype(int)]
    return [int(i) for i in indices]


def explain_frames(track: FinishedTrack, flight: Flight, matcher: SceneMatcher) -> list[SliderFrame]:
    """Match some frames of a track again, each in the window of its run, and draw the results.

    Args:
        track: its rows have their notes.
        flight: the flight that was tracked.
        matcher: the matcher of the run, or an equal one.

    Raises:
        TelemetryError: a frame can no longer be read.
    """
    errors = track.errors
    out = []
    for index in choose_frames(track.rows, errors):
        item, row = flight.read(index), track.rows[index]
        explained = match_again(matcher, item.frame, row)
        places_m = (errors.truth_en_m[index], errors.fix_en_m[index])
        out.append(SliderFrame(index, _images(item, explained, row.fixed, matcher.site, places_m)))
    return out


def jpeg_bytes(image: Image, quality: int) -> bytes:
    """An image (H, W) grey or (H, W, 3) RGB as JPEG."""
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    data: bytes = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    return data


def resized(image: Image, side_px: int) -> Image:
    """Resize an image so that its longer side is ``side_px``."""
    scale = side_px / max(image.shape[:2])
    return _scaled(image, scale, cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST)


def _scaled(image: Image, scale: float, interpolation: int) -> Image:
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)


def jpeg_data_uri(image: Image, max_bytes: int = _MAX_BYTES) -> str:
    """Encode an image as a data URI, with the highest JPEG quality that fits ``max_bytes``.

    Args:
        image: (H, W) grey or (H, W, 3) RGB, uint8.
        max_bytes: upper bound of the JPEG, unless the lowest quality exceeds it.
    """
    for quality in _QUALITIES:
        data = jpeg_bytes(image, quality)
        if len(data) <= max_bytes:
            break
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")


def match_again(matcher: SceneMatcher, frame: Frame, row: TrackRow) -> tuple[Window, Explanation] | None:
    """Match a frame again in the window of its run.

    Args:
        matcher: the matcher of the run, or an equal one.
        frame: the frame as it was matched.
        row: its row of the track, with its notes.

    Returns:
        The window and the explanation, or None if the window is unknown or the frame cannot be matched.
    """
    window = run_window(row)
    if window is None:
        return None
    matched = _as_matched(frame, row, matcher.site)
    method = row.method if row.method in ("ncc", "sift", "learned") else None
    try:
        return window, matcher.explain(matched, window, method)
    except EngineError:  # an image of another size, already reported by the run
        return None


def _images(
    item: FlightFrame,
    explained: tuple[Window, Explanation] | None,
    fixed: bool,
    site: OrthoMap,
    places_m: tuple[Array, Array],
) -> list[SliderImage]:
    """The frame, its rectified form, the window, and the score surface or the matches, if they exist."""
    image = item.frame.image
    assert isinstance(image, np.ndarray)  # read from a file
    out = [_slider_image(image, "the frame as it was taken", f"Frame {item.name} as the camera took it.")]
    if explained is None:
        return out
    window, found = explained
    if found.rectified is not None:
        caption, alt = "rectified onto the map, contrast stretched", "The frame in the map's pixels and axes."
        out.append(_slider_image(stretch_contrast(found.rectified), caption, alt))
    out.append(_window_image(window, found, fixed, site, places_m))
    if found.surface is not None:
        out.append(_surface_image(found.surface))
    if found.matches is not None:
        out.append(_matches_image(found, found.matches, site, window))
    return out


def _window_image(
    window: Window, found: Explanation, fixed: bool, site: OrthoMap, places_m: tuple[Array, Array]
) -> SliderImage:
    """The window with the matched outline, the truth and the fix."""
    crop, per_px = draw_window(site, window)
    marks = [] if found.surface is None else [_searched_area(found.surface, window, per_px)]
    if found.outline_px is not None:
        corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in window_pixels(found.outline_px, window, per_px))
        marks.append(f'<polygon class="{"found" if fixed else "doubted"}" points="{corners}"/>')
    caption = f"the window, {window.width_px} by {window.height_px} map pixels"
    for name, position_m in zip(("ring: truth", "cross: fix"), places_m, strict=True):
        if np.isfinite(position_m).all():
            marks.append(_mark(window_pixels(site.pixel_from_enu(position_m), window, per_px), name))
            caption += f"; {name}"
    alt = "The window of the map that was searched, with the matched outline."
    return replace(_slider_image(crop, caption, alt), overlay="".join(marks))


def run_window(row: TrackRow) -> Window | None:
    """The window that the run searched for a frame; None if unknown."""
    corner, size = (row.window_x0_px, row.window_y0_px), (row.window_width_px, row.window_height_px)
    if corner[0] is None or corner[1] is None or size[0] is None or size[1] is None:
        return None
    return Window(corner[0], corner[1], size[0], size[1])


def _as_matched(frame: Frame, row: TrackRow, site: OrthoMap) -> Frame:
    """The frame with the height and heading of its match if the telemetry had none."""
    height_m, heading_deg = frame.height_agl_m, frame.heading_deg
    if height_m is None and row.up_m is not None and row.lat_deg is not None and row.lon_deg is not None:
        above_m = row.up_m - site.ground_at(site.pixel_from_geodetic(row.lat_deg, row.lon_deg))
        height_m = above_m if above_m > 0.0 else None
    return replace(
        frame, height_agl_m=height_m, heading_deg=row.heading_deg if heading_deg is None else heading_deg
    )


def level_within(site: OrthoMap, longest_px: int, most_px: int) -> int:
    """The finest pyramid level on which a side of the map has at most so many pixels, or the coarsest there is."""
    level = 0
    while longest_px >> level > most_px and level + 1 < site.levels:
        level += 1
    return level


def draw_window(site: OrthoMap, window: Window) -> tuple[Image, float]:
    """Draw a window of the map.

    Returns:
        (H, W) grey image, and its pixels per pixel of the map.
    """
    per_px = SIDE_PX / max(window.width_px, window.height_px)
    level = level_for(1.0, 1.0 / per_px, site.levels, coarser=0.0)  # the coarsest that is as fine as the drawing
    gray = site.gray(level_crop(site, window, level), level)
    size = (max(1, round(window.width_px * per_px)), max(1, round(window.height_px * per_px)))
    interpolation = cv2.INTER_AREA if per_px * 2.0**level < 1.0 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(gray, size, interpolation=interpolation), np.uint8), per_px


def window_pixels(map_px: Array, window: Window, per_px: float) -> Array:
    """Map pixels (..., 2) in pixels of the window's image, whose top-left corner is (0, 0)."""
    return np.asarray((map_px - [window.x0, window.y0] + 0.5) * per_px, np.float64)


def _mark(xy_px: Array, name: str) -> str:
    """A ring or a cross, with a dark outline for contrast."""
    x, y = xy_px
    if name.startswith("ring"):
        shape = f'cx="{x:.1f}" cy="{y:.1f}" r="9"/>'
        return f'<circle class="rim" {shape}<circle class="truth" {shape}'
    arms = f'd="M{x - 6:.1f} {y:.1f}h12M{x:.1f} {y - 6:.1f}v12"/>'
    return f'<path class="rim" {arms}<path class="fix" {arms}'


def _slider_image(image: Image, caption: str, alt: str) -> SliderImage:
    """Encode an image, reduced to the size that is shown."""
    image = resized(image, min(SIDE_PX, max(image.shape[:2])))
    return SliderImage(jpeg_data_uri(image), image.shape[1], image.shape[0], caption, alt)


def draw_surface(surface: ScoreSurface) -> tuple[Image, Array]:
    """Draw a score surface in colour; negative correlation is as dark as zero.

    Returns:
        (H, W, 3) RGB image of the correlation by the position of the template's centre, and (2,) its peak in that.
    """
    low, high = min_shown_score(surface), surface.score
    levels = np.clip((surface.scores - low) / max(high - low, 1e-6) * 255.0, 0.0, 255.0).astype(np.uint8)
    scale = SIDE_PX / max(levels.shape)
    if scale < 1.0:  # the maximum within each pixel: a mean would remove a narrow peak
        reach = math.ceil(1.0 / scale)
        levels = np.asarray(cv2.dilate(levels, np.ones((reach, reach), np.uint8)), np.uint8)
    coloured = cv2.applyColorMap(_scaled(levels, scale, cv2.INTER_LINEAR), cv2.COLORMAP_VIRIDIS)
    coloured = cv2.cvtColor(coloured, cv2.COLOR_BGR2RGB)
    return np.asarray(coloured, np.uint8), (np.array(surface.peak_px) + 0.5) * scale


def min_shown_score(surface: ScoreSurface) -> float:
    """The correlation drawn darkest."""
    return min(max(0.0, float(surface.scores.min())), surface.score)


def _surface_image(surface: ScoreSurface) -> SliderImage:
    image, (x, y) = draw_surface(surface)
    low, high = min_shown_score(surface), surface.score
    caption = f"correlation in the dotted area, {low:.2f} (dark) to {high:.2f} (bright)"
    picture = _slider_image(image, caption, f"The surface; its peak is {high:.2f}.")
    return replace(picture, overlay=f'<circle class="peak" cx="{x:.1f}" cy="{y:.1f}" r="10"/>')


def _searched_area(surface: ScoreSurface, window: Window, per_px: float) -> str:
    """The area of the window that was searched for the template's centre."""
    x, y = window_pixels(surface.corner_px - surface.step_px / 2.0, window, per_px)
    height, width = (n * surface.step_px * per_px for n in surface.scores.shape)
    return f'<rect class="searched" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"/>'


def stretch_contrast(gray: Image) -> Image:
    """Stretch the contrast of a grey image (H, W) to the full range; the noise of a flat one stays dark."""
    low, high = np.percentile(gray, [0.5, 99.5])
    return np.asarray(np.clip((gray - low) * (255.0 / max(high - low, 24.0)), 0.0, 255.0), np.uint8)


def draw_matches(found: Explanation, matches: PointMatches, site: OrthoMap, window: Window) -> Image:
    """Draw frame and window side by side, with a line for each match.

    Returns:
        (H, W, 3) RGB image.
    """
    right, per_px = draw_window(site, window)
    scale = min(SIDE_PX / max(found.gray.shape), right.shape[0] / found.gray.shape[0])
    left = cv2.resize(stretch_contrast(found.gray), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    canvas = np.full((max(left.shape[0], right.shape[0]), left.shape[1] + 8 + right.shape[1]), 238, np.uint8)
    canvas[: left.shape[0], : left.shape[1]] = left
    canvas[: right.shape[0], left.shape[1] + 8 :] = right
    rgb = np.repeat(canvas[:, :, None], 3, axis=2)
    start = (matches.frame_px + 0.5) * scale
    end = window_pixels(matches.map_px, window, per_px) + np.array([left.shape[1] + 8, 0])
    for agreeing, colour in ((False, _OTHER), (True, _AGREE)):
        for a, b in zip(start[matches.agree == agreeing], end[matches.agree == agreeing], strict=True):
            cv2.line(rgb, _fixed_point(a), _fixed_point(b), colour, 1, cv2.LINE_AA, shift=4)
    return rgb


def _matches_image(found: Explanation, matches: PointMatches, site: OrthoMap, window: Window) -> SliderImage:
    rgb = draw_matches(found, matches, site, window)
    count, agree = len(matches.agree), int(matches.agree.sum())
    caption = f"{count} matches" + (f", {agree} agree with the pose (green)" if agree else "")
    uri = jpeg_data_uri(rgb, 2 * _MAX_BYTES)
    return SliderImage(uri, rgb.shape[1], rgb.shape[0], caption, f"Frame and window with lines for {caption}.")


def _fixed_point(point: Array) -> tuple[int, int]:
    """OpenCV's fixed-point coordinates with four fractional bits."""
    x, y = np.round((point - 0.5) * 16)
    return int(x), int(y)
