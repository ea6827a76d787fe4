"""The live view: send each frame's result during the flight to the rerun viewer or to a recording.

rerun is optional: this module is imported only if a view is requested. The view matches frames again with its own
matcher, so that it does not affect the flight's.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from engine.errors import BackendError
from engine.geo import Array
from engine.matching.for_reports import Explanation
from engine.matching.matcher import SceneMatcher
from engine.navigation.live import Answer
from engine.navigation.navigator import Navigator, NavigatorState
from engine.orthomap import OrthoMap
from engine.values import Fix, Frame, NoFix, Window
from scenematch.files.resampling import UTC_FROM_NS
from scenematch.files.track import track_row
from scenematch.report.explain import (
    SIDE_PX,
    Image,
    draw_matches,
    draw_surface,
    draw_window,
    jpeg_bytes,
    level_within,
    match_again,
    resized,
    stretch_contrast,
    window_pixels,
)

PICTURES = ("rectified", "window", "window/found", "window/fix", "surface", "surface/peak", "matches")
"""Image entities that a frame may lack; they are then cleared."""
PLACES = ("world/ellipse", "world/window", "world/seen")
"""World entities that a frame may lack, in metres east, north and up from the map's origin."""

STATE_RGB = {
    NavigatorState.SEARCHING: (150, 150, 150),
    NavigatorState.TRACKING: (0, 158, 115),
    NavigatorState.COASTING: (230, 159, 0),
    NavigatorState.LOST: (213, 94, 0),
}
"""Colours of the navigator's states."""

SIGMAS = 3.0
"""Size of the ellipsoid about a fix, in standard deviations."""
FIX_RGB = (0, 158, 115)
"""Colour of fixes."""
_MAX_MAP_PX = 1024  # longer side of the map's texture
_MESH_SIDE = 17  # vertices per side of the map's mesh
_OUTLINE_OFFSET_M = 1.0  # of outlines above the ground
_PADDING_GREY = 238
_FRAME_PX = 960  # longer side of a frame's picture
_TIMEOUT_S = 2.0
_SEEN_RGB, _DOUBT_RGB = (240, 228, 66), (213, 94, 0)
_log = logging.getLogger("scenematch")


class LiveView:
    """A rerun stream of the results of frames; created by :func:`open_live_view`.

    Args:
        stream: recording stream of rerun.
        matcher: matcher of the flight; the view creates an equal one.
    """

    def __init__(self, stream: rr.RecordingStream, matcher: SceneMatcher) -> None:
        self._stream = stream
        self._matcher = matcher.twin()
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log("world/map", _map_mesh(matcher.site), static=True)
        words, colours = [state.value for state in STATE_RGB], list(STATE_RGB.values())
        stream.log("state", rr.StateConfiguration(values=words, colors=colours), static=True)

    def show(
        self,
        index: int,
        name: str,
        frame: Frame,
        result: Fix | NoFix,
        state: NavigatorState | None,
        latency_ms: float,
    ) -> None:
        """Send the result of one frame.

        Args:
            index: index of the frame, ascending.
            name: name of the frame.
            frame: the frame as it was matched.
            result: the fix or the refusal.
            state: state of the navigator after it; None if the navigator is dead.
            latency_ms: latency of the answer.
        """
        stream = self._stream
        self._set_time(index, frame.timestamp_ns)
        word = "dead" if state is None else state.value
        entities = self._match_entities(name, frame, result, latency_ms)
        for entity in (*PICTURES, *PLACES):
            stream.log(entity, entities.get(entity) or rr.Clear(recursive=False))
        image = np.asarray(frame.image, np.uint8)
        stream.log("frame", _jpeg(resized(image, min(_FRAME_PX, max(image.shape[:2])))))
        stream.log("state", rr.StateChange(state=word))
        stream.log("plots/latency_ms", rr.Scalars(latency_ms))
        if result.score is not None:
            stream.log("plots/score", rr.Scalars(result.score))
        if isinstance(result, Fix):
            position_m = self._position_m(result, frame)
            stream.log("world/fixes", rr.Points3D([position_m], colors=FIX_RGB, radii=rr.Radius.ui_points(3.0)))
            stream.log("plots/sigma_m", rr.Scalars(result.sigma_m))
        stream.log("log", rr.TextLog(_line(name, result), level="INFO" if isinstance(result, Fix) else "WARN"))

    def close(self) -> None:
        """Flush and end the stream."""
        try:
            self._stream.flush(timeout_sec=_TIMEOUT_S)
        except RuntimeError as error:  # the viewer is gone, or the disk is full: the flight is over anyway
            _log.warning("the live view is incomplete: %s", error)
        self._stream.disconnect()

    def _set_time(self, index: int, stamp_ns: int | None) -> None:
        """Set frame number and capture time; stamps before UTC times are durations since the vehicle's start."""
        self._stream.reset_time()
        self._stream.set_time("frame", sequence=index)
        if stamp_ns is None:
            return
        if stamp_ns >= UTC_FROM_NS:
            self._stream.set_time("capture", timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._stream.set_time("capture", duration=np.timedelta64(stamp_ns, "ns"))

    def _match_entities(self, name: str, frame: Frame, result: Fix | NoFix, latency_ms: float) -> dict[str, Any]:
        """Archetypes of a frame's match, by entity."""
        site = self._matcher.site
        seen: dict[str, Any] = {}
        if isinstance(result, Fix):
            seen["world/ellipse"] = ellipsoid(self._position_m(result, frame), result.covariance_m2)
        row = track_row(name, result, latency_ms=latency_ms, deadline_met=None)
        explained = match_again(self._matcher, frame, row)
        if explained is None:
            return seen
        window, found = explained
        seen["world/window"] = _outline(site, _corners(window), (255, 255, 255))
        if found.rectified is not None:
            seen["rectified"] = _jpeg(_padded(resized(stretch_contrast(found.rectified), SIDE_PX)))
        seen |= self._window_entities(window, found, result)
        if found.surface is not None:
            surface, peak = draw_surface(found.surface)
            seen["surface"] = _jpeg(_padded(surface))
            seen["surface/peak"] = rr.Points2D([peak], colors=(255, 255, 255), radii=rr.Radius.ui_points(2.0))
        if found.matches is not None:
            both = draw_matches(found, found.matches, site, window)
            seen["matches"] = _jpeg(_padded(both, width_px=2 * SIDE_PX + 8))
        return seen

    def _window_entities(self, window: Window, found: Explanation, result: Fix | NoFix) -> dict[str, Any]:
        """Archetypes of the window with the matched outline and the fix, and of that outline on the ground."""
        site = self._matcher.site
        picture, per_px = draw_window(site, window)
        seen: dict[str, Any] = {"window": _jpeg(_padded(picture))}
        if found.outline_px is not None:
            colour = _SEEN_RGB if isinstance(result, Fix) else _DOUBT_RGB
            strip = _closed_polyline(window_pixels(found.outline_px, window, per_px))
            seen["window/found"] = rr.LineStrips2D([strip], colors=colour, radii=rr.Radius.ui_points(1.0))
            seen["world/seen"] = _outline(site, found.outline_px, colour)
        if isinstance(result, Fix):
            fix_px = window_pixels(np.array(result.map_xy_px), window, per_px)
            seen["window/fix"] = rr.Points2D([fix_px], colors=FIX_RGB, radii=rr.Radius.ui_points(5.0))
        return seen

    def _position_m(self, fix: Fix, frame: Frame) -> Array:
        """(3,) east, north and up of a fix in metres; up from the frame's height if the match has none."""
        up_m = fix.up_m
        if up_m is None:
            up_m = self._matcher.site.ground_at(np.array(fix.map_xy_px)) + (frame.height_agl_m or 0.0)
        return np.array([fix.east_m, fix.north_m, up_m])


class Watcher:
    """Shows a bridge's answers from its own thread: keeps only the newest, so the bridge never waits.

    Args:
        view: the live view.
    """

    def __init__(self, view: LiveView) -> None:
        self._view, self._count = view, 0
        self._navigator: Navigator | None = None
        self._waiting: queue.Queue[tuple[int, Answer, NavigatorState | None] | None] = queue.Queue(maxsize=1)
        self._thread = threading.Thread(target=self._work, name="scenematch-view", daemon=True)
        self._thread.start()

    def follow(self, navigator: Navigator) -> Navigator:
        """Read the state from this navigator from now on; returns it."""
        self._navigator = navigator
        return navigator

    def __call__(self, answer: Answer) -> None:
        """Submit the newest answer; an answer still waiting is dropped."""
        state = None if self._navigator is None else self._navigator.state
        with contextlib.suppress(queue.Empty):
            self._waiting.get_nowait()
        self._waiting.put_nowait((self._count, answer, state))  # called from one thread at a time
        self._count += 1

    def close(self) -> None:
        """Show the last answer and end the view, waiting a few seconds at most."""
        with contextlib.suppress(queue.Full):
            self._waiting.put(None, timeout=_TIMEOUT_S)
        self._thread.join(timeout=_TIMEOUT_S)
        self._view.close()

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            index, answer, state = item
            try:
                self._view.show(index, str(index), answer.frame, answer.result, state, answer.age_ms)
            except Exception:  # the flight continues without the view
                _log.exception("the live view failed at frame %d", index)


def open_live_view(matcher: SceneMatcher, recording: Path | None, address: str | None) -> LiveView:
    """Open a live view to a recording, to a viewer, or to both.

    Args:
        matcher: matcher of the flight.
        recording: a file ``.rrd``, replaced if it exists; None for none.
        address: HOST:PORT of a rerun viewer; None for none.

    Raises:
        BackendError: the file cannot be written.
    """
    sinks = [] if address is None else [rr.GrpcSink(f"rerun+http://{address}/proxy")]
    stream = rr.RecordingStream("scenematch")
    try:
        files = [] if recording is None else [rr.FileSink(str(recording))]
        stream.set_sinks(*sinks, *files, default_blueprint=_blueprint(matcher.site))
    except RuntimeError as error:
        raise BackendError(f"recording: {recording} cannot be written: {error}") from None
    return LiveView(stream, matcher)


def _line(name: str, result: Fix | NoFix) -> str:
    """The result of a frame in one line."""
    if isinstance(result, Fix):
        return f"{name}: fix, sigma {result.sigma_m:.2f} m, {result.method} {result.score:.2f}, {result.stage}"
    return f"{name}: refused, {result.reason.value}" + (f": {result.detail}" if result.detail else "")


# ------------------------------------------------------------------------------------------ shapes of the viewer


def _blueprint(site: OrthoMap) -> Any:
    """Layout of the viewer: the world on the left, the newest frame on the right, time series below."""
    all_times = rr.VisibleTimeRange(
        "frame", start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
    )
    side_m = min(float(max(site.width_px, site.height_px)) * site.gsd_m_per_px, 3000.0)
    eye = rrb.EyeControls3D(
        position=(0.0, -0.8 * side_m, site.ground_m + 0.8 * side_m), look_target=(0.0, 0.0, site.ground_m)
    )
    world = rrb.Spatial3DView(
        origin="world",
        name="World",
        eye_controls=eye,
        line_grid=False,
        overrides={"world/fixes": rrb.VisibleTimeRanges([all_times])},
    )
    names = {"frame": "Frame", "rectified": "Rectified", "window": "Window", "surface": "Correlation"}
    pictures = [rrb.Spatial2DView(origin=origin, name=name) for origin, name in names.items()]
    plots = [
        rrb.TimeSeriesView(origin=f"plots/{name}", name=text)
        for name, text in (("score", "Score"), ("sigma_m", "Sigma (m)"), ("latency_ms", "Latency (ms)"))
    ]
    state = rrb.StateTimelineView(origin="state", name="State")
    matches, words = rrb.Spatial2DView(origin="matches", name="Matches"), rrb.TextLogView(origin="log", name="Log")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(world, rrb.Horizontal(*plots), state, row_shares=[6, 3, 2]),
            rrb.Vertical(rrb.Grid(*pictures, grid_columns=2), rrb.Tabs(words, matches), row_shares=[7, 4]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="frame", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def _map_mesh(site: OrthoMap) -> Any:
    """The map as a textured mesh on its ground, in metres east, north and up."""
    level = level_within(site, max(site.level_shape(0)), _MAX_MAP_PX)
    rows, columns = site.level_shape(level)
    gray = site.gray(Window(0, 0, columns, rows), level)
    u, v = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(0.0, 1.0, _MESH_SIDE)]))
    at_px = site.full_from_level(np.stack([u * columns, v * rows], axis=-1) - 0.5, level)
    heights = site.ground_m if not site.has_surface else [site.ground_at(xy) for xy in at_px]
    vertices = np.column_stack([site.enu_from_pixel(at_px), np.broadcast_to(heights, len(at_px))])
    first = np.arange(_MESH_SIDE * (_MESH_SIDE - 1)).reshape(_MESH_SIDE - 1, _MESH_SIDE)[:, :-1].ravel()
    a, b, c, d = first, first + 1, first + _MESH_SIDE, first + _MESH_SIDE + 1
    triangles = np.concatenate([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)])
    texture = np.repeat(gray[:, :, None], 3, axis=2)
    return rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=triangles,
        vertex_texcoords=np.stack([u, v], axis=-1),
        albedo_texture=texture,
    )


def ellipsoid(center_m: Array, covariance_m2: Array) -> Any:
    """The error ellipsoid of :data:`SIGMAS` about a position (3,), by its covariance (3, 3)."""
    variances, axes = np.linalg.eigh(covariance_m2)
    axes[:, 0] *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
    rotation = cv2.Rodrigues(axes)[0].ravel()
    angle = float(np.linalg.norm(rotation))
    axis = rotation / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
    return rr.Ellipsoids3D(
        half_sizes=[SIGMAS * np.sqrt(np.maximum(variances, 0.0))],
        centers=[center_m],
        rotation_axis_angles=[rr.RotationAxisAngle(axis=axis, radians=angle)],
        colors=FIX_RGB,
    )


def _outline(site: OrthoMap, corners_px: Array, colour: tuple[int, int, int]) -> Any:
    """A closed line above the surface through map pixels (4, 2)."""
    strip = site.surface_points(corners_px) + np.array([0.0, 0.0, _OUTLINE_OFFSET_M])
    return rr.LineStrips3D([_closed_polyline(strip)], colors=colour, radii=rr.Radius.ui_points(1.0))


def _corners(window: Window) -> Array:
    """Corners (4, 2) of a window in map pixels, at the outer edges of its pixels."""
    x0, y0, x1, y1 = window.x0, window.y0, window.x1, window.y1
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) - 0.5


def _closed_polyline(points: Array) -> Array:
    """Points (N, ...) with the first appended, (N + 1, ...)."""
    return np.asarray(np.concatenate([points, points[:1]]), np.float64)


def _jpeg(image: Image) -> Any:
    """An image (H, W) grey or (H, W, 3) RGB as JPEG."""
    return rr.EncodedImage(contents=jpeg_bytes(image, 80), media_type="image/jpeg")


def _padded(image: Image, width_px: int = SIDE_PX) -> Image:
    """Pad an image below and on the right: the viewer requires one size for all images of an entity."""
    down, right = max(0, SIDE_PX - image.shape[0]), max(0, width_px - image.shape[1])
    full = cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_CONSTANT, value=3 * [_PADDING_GREY])
    return np.asarray(full[:SIDE_PX, :width_px], np.uint8)
