"""The live view: what each frame came to, as it flies, to rerun: its viewer on screen or a recording on disk.

rerun is optional, and whoever watches nothing does not import this file. The view looks at frames again with a
matcher of its own, so nothing that it does touches the flight's.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from engine.errors import BackendError
from engine.formats.notes import note_of
from engine.formats.resampling import EPOCH_NS
from engine.formats.track import track_row
from engine.live import Answer
from engine.matcher import SceneMatcher
from engine.methods.explanation import Explanation
from engine.navigator import Navigator, NavigatorState
from engine.report.explain import (
    SIDE_PX,
    draw_matches,
    draw_surface,
    draw_window,
    explain_again,
    stretched,
    within_window,
)
from engine.report.live_shapes import (
    FIX_RGB,
    blueprint,
    closed,
    corners,
    ellipsoid,
    filled,
    jpeg,
    map_mesh,
    outline,
    scaled,
)
from engine.values import Fix, Frame, NoFix, Window

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PICTURES = ("rectified", "window", "window/found", "window/fix", "surface", "surface/peak", "matches")
"""Entities that a frame may lack; what an older frame left there is cleared then."""
PLACES = ("world/ellipse", "world/window", "world/seen")
"""The same, in metres east, north and up of the map's origin."""
ALWAYS = ("frame", "state", "plots/latency_ms", "log")
"""Entities of every frame."""
FIXED = ("world/fixes", "plots/sigma_m")
"""Entities of every frame that has a fix."""

STATE_RGB = {
    NavigatorState.SEARCHING: (150, 150, 150),
    NavigatorState.TRACKING: (0, 158, 115),
    NavigatorState.COASTING: (230, 159, 0),
    NavigatorState.LOST: (213, 94, 0),
}
"""Colours of the navigator's states."""

_FRAME_PX = 960  # longer side of a frame's picture
_PATIENCE_S = 2.0
_SEEN_RGB, _DOUBT_RGB = (240, 228, 66), (213, 94, 0)
_log = logging.getLogger("scenematch")


class LiveView:
    """A stream of what becomes of frames; made by :func:`open_live_view`.

    Args:
        stream: of rerun.
        matcher: of the flight; the view makes one like it.
    """

    def __init__(self, stream: rr.RecordingStream, matcher: SceneMatcher) -> None:
        self._stream = stream
        options = matcher.options
        self._matcher = SceneMatcher(matcher.site, matcher.camera, matcher.method, matcher.device, options)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log("world/map", map_mesh(matcher.site), static=True)
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
        """Show what became of one frame.

        Args:
            index: of the frame, ascending.
            name: of the frame.
            frame: as it was matched.
            result: its fix, or why there is none.
            state: of the navigator after it; None where it is dead.
            latency_ms: how long the answer took.
        """
        stream = self._stream
        self._set_time(index, frame.timestamp_ns)
        word = "dead" if state is None else state.value
        seen = self._seen(name, frame, result, word, latency_ms)
        for entity in (*PICTURES, *PLACES):
            stream.log(entity, seen.get(entity) or rr.Clear(recursive=False))
        image = _pixels(frame)
        stream.log("frame", jpeg(scaled(image, min(_FRAME_PX, max(image.shape[:2])))))
        stream.log("state", rr.StateChange(state=word))
        stream.log("plots/latency_ms", rr.Scalars(latency_ms))
        if result.score is not None:
            stream.log("plots/score", rr.Scalars(result.score))
        if isinstance(result, Fix):
            place = self._place(result, frame)
            stream.log("world/fixes", rr.Points3D([place], colors=FIX_RGB, radii=rr.Radius.ui_points(3.0)))
            stream.log("plots/sigma_m", rr.Scalars(result.sigma_m))
        stream.log("log", rr.TextLog(_line(name, result), level="INFO" if isinstance(result, Fix) else "WARN"))

    def close(self) -> None:
        """Write or send what is on its way, and end the stream."""
        try:
            self._stream.flush(timeout_sec=_PATIENCE_S)
        except RuntimeError as error:  # the viewer is gone, or the disk is full: the flight is over all the same
            _log.warning("the live view is incomplete: %s", error)
        self._stream.disconnect()

    def _set_time(self, index: int, stamp_ns: int | None) -> None:
        """Stamps since 2000 are dates, earlier ones a clock that began with the vehicle."""
        self._stream.reset_time()
        self._stream.set_time("frame", sequence=index)
        if stamp_ns is None:
            return
        if stamp_ns >= EPOCH_NS:
            self._stream.set_time("capture", timestamp=np.datetime64(stamp_ns, "ns"))
        else:
            self._stream.set_time("capture", duration=np.timedelta64(stamp_ns, "ns"))

    def _seen(self, name: str, frame: Frame, result: Fix | NoFix, state: str, latency_ms: float) -> dict[str, Any]:
        """What can be drawn of a frame's match, by entity."""
        site = self._matcher.site
        seen: dict[str, Any] = {}
        if isinstance(result, Fix):
            seen["world/ellipse"] = ellipsoid(self._place(result, frame), result.covariance_m2)
        row = track_row(name, result, latency_ms=latency_ms, deadline_met=None)
        explained = explain_again(self._matcher, frame, row, note_of(name, result, state))
        if explained is None:
            return seen
        window, found = explained
        seen["world/window"] = outline(site, corners(window), (255, 255, 255))
        if found.rectified is not None:
            seen["rectified"] = jpeg(filled(scaled(stretched(found.rectified), SIDE_PX)))
        seen |= self._in_window(window, found, result)
        if found.surface is not None:
            surface, peak = draw_surface(found.surface)
            seen["surface"] = jpeg(filled(surface))
            seen["surface/peak"] = rr.Points2D([peak], colors=(255, 255, 255), radii=rr.Radius.ui_points(2.0))
        if found.matches is not None:
            both = draw_matches(found, found.matches, site, window)
            seen["matches"] = jpeg(filled(both, width_px=2 * SIDE_PX + 8))
        return seen

    def _in_window(self, window: Window, found: Explanation, result: Fix | NoFix) -> dict[str, Any]:
        """The window with the place that was found and the fix in it, and that place on the ground."""
        site = self._matcher.site
        picture, per_px = draw_window(site, window)
        seen: dict[str, Any] = {"window": jpeg(filled(picture))}
        if found.outline_px is not None:
            colour = _SEEN_RGB if isinstance(result, Fix) else _DOUBT_RGB
            strip = closed(within_window(found.outline_px, window, per_px))
            seen["window/found"] = rr.LineStrips2D([strip], colors=colour, radii=rr.Radius.ui_points(1.0))
            seen["world/seen"] = outline(site, found.outline_px, colour)
        if isinstance(result, Fix):
            place = within_window(np.array(result.map_xy_px), window, per_px)
            seen["window/fix"] = rr.Points2D([place], colors=FIX_RGB, radii=rr.Radius.ui_points(5.0))
        return seen

    def _place(self, fix: Fix, frame: Frame) -> Array:
        """(3,) in metres east, north, up; by the frame's height where the match measured none."""
        up_m = fix.up_m
        if up_m is None:
            up_m = self._matcher.site.ground_at(np.array(fix.map_xy_px)) + (frame.height_agl_m or 0.0)
        return np.array([fix.east_m, fix.north_m, up_m])


class Watcher:
    """Shows a bridge's answers from a thread of its own: the newest wins, and flying waits for none of them.

    Args:
        view: what they are shown by.
    """

    def __init__(self, view: LiveView) -> None:
        self._view, self._count = view, 0
        self._navigator: Navigator | None = None
        self._waiting: queue.Queue[tuple[int, Answer, NavigatorState | None] | None] = queue.Queue(maxsize=1)
        self._thread = threading.Thread(target=self._work, name="scenematch-view", daemon=True)
        self._thread.start()

    def follow(self, navigator: Navigator) -> Navigator:
        """Take the state from this navigator from now on; returns it."""
        self._navigator = navigator
        return navigator

    def __call__(self, answer: Answer) -> None:
        """Hand in the newest answer; one that still waits is not shown."""
        state = None if self._navigator is None else self._navigator.state
        with contextlib.suppress(queue.Empty):
            self._waiting.get_nowait()
        self._waiting.put_nowait((self._count, answer, state))  # nobody else hands in
        self._count += 1

    def close(self) -> None:
        """Show what was handed in last, and end the view; no longer than some seconds are waited for that."""
        with contextlib.suppress(queue.Full):
            self._waiting.put(None, timeout=_PATIENCE_S)
        self._thread.join(timeout=_PATIENCE_S)
        self._view.close()

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            index, answer, state = item
            try:
                self._view.show(index, str(index), answer.frame, answer.result, state, answer.age_ms)
            except Exception:  # the flight goes on without
                _log.exception("the live view failed at frame %d", index)


def open_live_view(matcher: SceneMatcher, recording: Path | None, address: str | None) -> LiveView:
    """A view to a recording, to a viewer, or to both.

    Args:
        matcher: of the flight.
        recording: a file ``.rrd``; one that is there is replaced.
        address: HOST:PORT on which a viewer of rerun listens.

    Raises:
        BackendError: the file cannot be written.
    """
    sinks = [] if address is None else [rr.GrpcSink(f"rerun+http://{address}/proxy")]
    stream = rr.RecordingStream("scenematch")
    try:
        files = [] if recording is None else [rr.FileSink(str(recording))]
        stream.set_sinks(*sinks, *files, default_blueprint=blueprint(matcher.site))
    except RuntimeError as error:
        raise BackendError(f"recording: {recording} cannot be written: {error}") from None
    return LiveView(stream, matcher)


def _pixels(frame: Frame) -> Image:
    image = frame.image
    return np.asarray(image if isinstance(image, np.ndarray) else image.cpu().numpy(), np.uint8)


def _line(name: str, result: Fix | NoFix) -> str:
    """What became of a frame in one line."""
    if isinstance(result, Fix):
        return f"{name}: fix, sigma {result.sigma_m:.2f} m, {result.method} {result.score:.2f}, {result.stage}"
    return f"{name}: refused, {result.reason.value}" + (f": {result.detail}" if result.detail else "")
