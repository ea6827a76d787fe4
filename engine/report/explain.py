"""What single matches looked like: frames chosen from a track, matched again in their windows, and drawn."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from engine.errors import EngineError
from engine.formats.flight import Flight, FlightFrame
from engine.formats.notes import Note
from engine.formats.track import TrackRow
from engine.matcher import SceneMatcher
from engine.methods.explanation import Explanation, PointMatches, ScoreSurface
from engine.orthomap import OrthoMap
from engine.report.metrics import WRONG_M, Errors
from engine.values import Frame, Window
from engine.window import level_crop

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MAX_FRAMES = 60
"""Frames that are shown of a longer flight."""
SIDE_PX = 360
"""Longer side of a picture."""
_MAX_REMARKABLE = 40  # of these wrong ones and refusals, so that ordinary ones stay beside them
_MAX_BYTES = 32_000  # of one, so that a report of 60 frames stays below 15 MB
_QUALITIES = (82, 70, 55, 40, 25)
_AGREE, _OTHER = (0, 158, 115), (200, 200, 200)


@dataclass(frozen=True, slots=True)
class Panel:
    """A picture of the slider.

    Attributes:
        src: a data URI.
        width_px: of the picture.
        height_px: of the picture.
        caption: under it.
        alt: what it shows.
        overlay: SVG in the picture's pixels.
    """

    src: str
    width_px: int
    height_px: int
    caption: str
    alt: str
    overlay: str = ""


@dataclass(frozen=True, slots=True)
class SliderFrame:
    """One frame of the slider: its index in the track, and its pictures from left to right."""

    index: int
    pictures: list[Panel]


def choose_frames(rows: Sequence[TrackRow], errors: Errors, most: int = MAX_FRAMES) -> list[int]:
    """Which frames are shown: wrong ones before refusals before evenly spaced others, in the order of time."""
    if len(rows) <= most:
        return list(range(len(rows)))
    remarkable = most * _MAX_REMARKABLE // MAX_FRAMES
    refused, wrong = np.array([not row.fixed for row in rows]), errors.distance_m > WRONG_M
    chosen: list[int] = []
    for kind, limit in (
        (wrong, remarkable),
        (refused, remarkable),
        (~refused & ~wrong, most),
        (refused | wrong, most),
    ):
        left = np.setdiff1d(np.flatnonzero(kind), chosen)
        chosen += _spread(left, limit - len(chosen))
    return sorted(chosen)


def _spread(indices: NDArray[np.intp], most: int) -> list[int]:
    """At most so many of them, evenly spaced, the first and the last among them."""
    if len(indices) <= most:
        return [int(i) for i in indices]
    return [int(i) for i in indices[np.round(np.linspace(0, len(indices) - 1, most)).astype(int)]] if most else []


def explain_frames(
    flight: Flight,
    matcher: SceneMatcher,
    rows: Sequence[TrackRow],
    notes: Sequence[Note],
    chosen: Sequence[int],
    errors: Errors,
) -> list[SliderFrame]:
    """Match chosen frames again, each in the window of its run, and draw what comes out.

    Args:
        flight: that was tracked.
        matcher: of the run, or one like it.
        rows: the track.
        notes: of the run, one a row.
        chosen: indices, ascending.
        errors: of the track, for the places of fixes and truth.

    Raises:
        TelemetryError: a frame cannot be read any more.
    """
    drawer = _Drawer(matcher, errors)
    return [SliderFrame(i, drawer.pictures(i, flight.read(i), rows[i], notes[i])) for i in chosen]


def encode(image: Image, most_bytes: int = _MAX_BYTES) -> str:
    """A picture (H, W) or (H, W, 3) RGB as a data URI, as good a JPEG as fits."""
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    for quality in _QUALITIES:
        data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= most_bytes:
            break
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")


def explain_again(
    matcher: SceneMatcher, frame: Frame, row: TrackRow, note: Note
) -> tuple[Window, Explanation] | None:
    """The window that a frame was matched in and what was seen there; None where neither can be had.

    Args:
        matcher: of the run, or one like it.
        frame: as it was matched.
        row: what became of it.
        note: the rest of that.
    """
    window = _window(row, note)
    if window is None:
        return None
    told = _as_matched(frame, row, note, matcher.site)
    method = row.method if row.method in ("ncc", "sift") else None
    try:
        return window, matcher.explain(told, window, method)
    except EngineError:  # a picture of another size: the run said so already
        return None


@dataclass(frozen=True, slots=True)
class _Drawer:
    matcher: SceneMatcher
    errors: Errors

    def pictures(self, index: int, item: FlightFrame, row: TrackRow, note: Note) -> list[Panel]:
        """The frame, its rectified form, the window, and the surface or the matches, as far as they exist."""
        image = item.frame.image
        assert isinstance(image, np.ndarray)  # read from a file
        frame = _picture(image, "the frame as it was taken", f"Frame {item.name} as the camera took it.")
        explained = explain_again(self.matcher, item.frame, row, note)
        if explained is None:
            return [frame]
        window, found = explained
        out = [frame]
        if found.rectified is not None:
            text, alt = "rectified onto the map, contrast stretched", "The frame in the map's pixels and axes."
            out.append(_picture(stretched(found.rectified), text, alt))
        out.append(self._map(index, window, found, row))
        if found.surface is not None:
            out.append(_surface(found.surface))
        if found.matches is not None:
            out.append(_matches(found, found.matches, self.matcher.site, window))
        return out

    def _map(self, index: int, window: Window, found: Explanation, row: TrackRow) -> Panel:
        """The window, with the place that was found, the fix and the truth."""
        crop, per_px = draw_window(self.matcher.site, window)
        marks = [] if found.surface is None else [_tried(found.surface, window, per_px)]
        if found.outline_px is not None:
            corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in within_window(found.outline_px, window, per_px))
            marks.append(f'<polygon class="{"found" if row.fixed else "doubted"}" points="{corners}"/>')
        caption = f"the window, {window.width_px} by {window.height_px} map pixels"
        for name, place in (
            ("ring: truth", self.errors.truth_en_m[index]),
            ("cross: fix", self.errors.fix_en_m[index]),
        ):
            if np.isfinite(place).all():
                marks.append(_mark(within_window(self.matcher.site.pixel_from_enu(place), window, per_px), name))
                caption += f"; {name}"
        alt = "The window of the map that was searched, with the place that was found."
        return replace(_picture(crop, caption, alt), overlay="".join(marks))


def _window(row: TrackRow, note: Note) -> Window | None:
    corner, size = (note.window_x0_px, note.window_y0_px), (row.window_width_px, row.window_height_px)
    if corner[0] is None or corner[1] is None or size[0] is None or size[1] is None:
        return None
    return Window(corner[0], corner[1], size[0], size[1])


def _as_matched(frame: Frame, row: TrackRow, note: Note, site: OrthoMap) -> Frame:
    """The frame with the height and heading that the match gave it where the telemetry had none."""
    height_m, heading_deg = frame.height_agl_m, frame.heading_deg
    if height_m is None and row.up_m is not None and row.lat_deg is not None and row.lon_deg is not None:
        above_m = row.up_m - site.ground_at(site.pixel_from_geodetic(row.lat_deg, row.lon_deg))
        height_m = above_m if above_m > 0.0 else None
    return replace(
        frame, height_agl_m=height_m, heading_deg=note.heading_deg if heading_deg is None else heading_deg
    )


def draw_window(site: OrthoMap, window: Window) -> tuple[Image, float]:
    """The window as drawn, and pixels of the picture per pixel of the map."""
    per_px = SIDE_PX / max(window.width_px, window.height_px)
    level = 0
    while per_px * 2.0 ** (level + 1) <= 1.0 and level + 1 < site.levels:
        level += 1
    gray = site.gray(level_crop(site, window, level), level)
    size = (max(1, round(window.width_px * per_px)), max(1, round(window.height_px * per_px)))
    how = cv2.INTER_AREA if per_px * 2.0**level < 1.0 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(gray, size, interpolation=how), np.uint8), per_px


def within_window(map_px: Array, window: Window, per_px: float) -> Array:
    """Places of the map in a picture of the window, whose top-left corner is (0, 0)."""
    return np.asarray((map_px - [window.x0, window.y0] + 0.5) * per_px, np.float64)


def _mark(place: Array, name: str) -> str:
    """A ring or a cross, with a dark rim so that it shows on any ground."""
    x, y = place
    if name.startswith("ring"):
        shape = f'cx="{x:.1f}" cy="{y:.1f}" r="9"/>'
        return f'<circle class="rim" {shape}<circle class="truth" {shape}'
    arms = f'd="M{x - 6:.1f} {y:.1f}h12M{x:.1f} {y - 6:.1f}v12"/>'
    return f'<path class="rim" {arms}<path class="fix" {arms}'


def _picture(image: Image, caption: str, alt: str) -> Panel:
    """Reduced to what is shown."""
    scale = min(1.0, SIDE_PX / max(image.shape[:2]))
    if scale < 1.0:
        size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Panel(encode(image), image.shape[1], image.shape[0], caption, alt)


def draw_surface(surface: ScoreSurface) -> tuple[Image, Array]:
    """The correlation at each place of the patch's middle in colour (H, W, 3), and where (2,) its peak is in that.

    What correlates negatively is as dark as nothing.
    """
    high, rows, columns = surface.score, *surface.scores.shape
    low = lowest_shown(surface)
    levels = np.clip((surface.scores - low) / max(high - low, 1e-6) * 255.0, 0.0, 255.0).astype(np.uint8)
    scale = SIDE_PX / max(rows, columns)
    size = (max(1, round(columns * scale)), max(1, round(rows * scale)))
    if scale < 1.0:  # the highest of each pixel's places: a mean would wash a narrow peak away
        reach = math.ceil(1.0 / scale)
        levels = np.asarray(cv2.dilate(levels, np.ones((reach, reach), np.uint8)), np.uint8)
    levels = np.asarray(cv2.resize(levels, size, interpolation=cv2.INTER_LINEAR), np.uint8)
    coloured = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    return np.asarray(coloured, np.uint8), (np.array(surface.peak_px) + 0.5) * scale


def lowest_shown(surface: ScoreSurface) -> float:
    """The correlation that is drawn as dark as can be."""
    return min(max(0.0, float(surface.scores.min())), surface.score)


def _surface(surface: ScoreSurface) -> Panel:
    image, (x, y) = draw_surface(surface)
    low, high = lowest_shown(surface), surface.score
    caption = f"correlation in the dotted area, {low:.2f} (dark) to {high:.2f} (bright)"
    picture = _picture(image, caption, f"The surface; its peak is {high:.2f}.")
    return replace(picture, overlay=f'<circle class="peak" cx="{x:.1f}" cy="{y:.1f}" r="10"/>')


def _tried(surface: ScoreSurface, window: Window, per_px: float) -> str:
    """The area of the window in which the patch's middle was tried."""
    x, y = within_window(surface.corner_px - surface.step_px / 2.0, window, per_px)
    height, width = (n * surface.step_px * per_px for n in surface.scores.shape)
    return f'<rect class="tried" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"/>'


def stretched(gray: Image) -> Image:
    """From black to white, so that dusk shows; noise of a flat picture stays dark."""
    low, high = np.percentile(gray, [0.5, 99.5])
    return np.asarray(np.clip((gray - low) * (255.0 / max(high - low, 24.0)), 0.0, 255.0), np.uint8)


def draw_matches(found: Explanation, matches: PointMatches, site: OrthoMap, window: Window) -> Image:
    """Frame and window (H, W, 3) side by side, a line for each match."""
    right, per_px = draw_window(site, window)
    scale = min(SIDE_PX / max(found.gray.shape), right.shape[0] / found.gray.shape[0])
    left = cv2.resize(stretched(found.gray), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    canvas = np.full((max(left.shape[0], right.shape[0]), left.shape[1] + 8 + right.shape[1]), 238, np.uint8)
    canvas[: left.shape[0], : left.shape[1]] = left
    canvas[: right.shape[0], left.shape[1] + 8 :] = right
    rgb = np.repeat(canvas[:, :, None], 3, axis=2)
    begin = (matches.frame_px + 0.5) * scale
    end = within_window(matches.map_px, window, per_px) + np.array([left.shape[1] + 8, 0])
    for agreeing, colour in ((False, _OTHER), (True, _AGREE)):
        for a, b in zip(begin[matches.agree == agreeing], end[matches.agree == agreeing], strict=True):
            cv2.line(rgb, _fixed(a), _fixed(b), colour, 1, cv2.LINE_AA, shift=4)
    return rgb


def _matches(found: Explanation, matches: PointMatches, site: OrthoMap, window: Window) -> Panel:
    rgb = draw_matches(found, matches, site, window)
    count, agree = len(matches.agree), int(matches.agree.sum())
    caption = f"{count} matches" + (f", {agree} agree with the pose (green)" if agree else "")
    uri = encode(rgb, 2 * _MAX_BYTES)
    return Panel(uri, rgb.shape[1], rgb.shape[0], caption, f"Frame and window with lines for {caption}.")


def _fixed(point: Array) -> tuple[int, int]:
    """OpenCV's fixed-point coordinates with four bits."""
    x, y = np.round((point - 0.5) * 16)
    return int(x), int(y)
