"""The closed loop: fly a simulated vehicle by the engine's fixes, and write its folder, track and figures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from engine.camera import NADIR_PITCH_DEG, Camera
from engine.errors import OptionError
from engine.matching import CLASSICAL
from engine.matching.matcher import SceneMatcher
from engine.navigation.navigator import NavigatorState
from engine.orthomap import OrthoMap
from engine.values import Frame, Truth
from scenematch.files.track import TrackRow, track_row, write_notes, write_track
from scenematch.report.loop_record import summarise_loop, write_loop_csv
from scenematch.runs.arguments import check_between, check_choice
from scenematch.runs.evaluation import evaluate
from scenematch.runs.inputs import FOLDER_LAYOUT
from scenematch.runs.live_viewing import NO_LIVE_VIEW, LiveViewTarget, open_view
from scenematch.runs.output import SILENT, Progress, StrPath, check_folder, prepare_folder, write_json
from scenematch.runs.record import RunRecord
from scenematch.runs.results import LOOP, NOTES, SUMMARY, TRACK
from scenematch.runs.simulation import FOLDER_OWNED, LOOP_OWNED, WorldSettings, picture_name, write_folder
from scenematch.simulator import FlightStyle, Town, picture_at
from scenematch.simulator.faults import FAULT_KINDS, Fault
from scenematch.simulator.flight import reach_m, truth_at
from scenematch.simulator.light import Image
from scenematch.simulator.loop import FRAME_RATE_HZ, ClosedLoop, LoopAnswer
from scenematch.simulator.pilot import plan_rounds
from scenematch.simulator.quadrotor import State
from scenematch.simulator.town import generator
from scenematch.simulator.vehicle import START_NS

if TYPE_CHECKING:  # rerun is optional
    from scenematch.report.live_view import LiveView

FAULT_START_S = 60.0
"""When a fault begins; halfway if the flight is shorter than twice that."""
_MIN_HALF_SIDE_M = 10.0  # half a side of the circuit
_EDGE_M = 6.0  # distance from a level footprint to the map's edge


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedLoopSettings:
    """Settings of the closed loop.

    Attributes:
        minutes: of flight.
        method: "auto", "ncc" or "sift".
        fault: "none", or what happens in flight: engine "killed", map "shifted", or picture "frozen".

    Raises:
        OptionError: a word or a number is invalid.
    """

    minutes: float = 5.0
    method: str = "auto"
    fault: str = "none"

    def __post_init__(self) -> None:
        check_choice("method", self.method, CLASSICAL)
        check_choice("fault", self.fault, FAULT_KINDS)
        check_between("minutes", self.minutes, 0.1, 120.0)

    def planned_fault(self) -> Fault:
        """The fault with its times: ten seconds, but a shifted map stays shifted."""
        start_s = min(FAULT_START_S, 30.0 * self.minutes)
        return Fault(kind=self.fault, start_s=start_s, duration_s=math.inf if self.fault == "shifted" else 10.0)


def fly_closed_loop(
    out: StrPath,
    world: WorldSettings | None = None,
    loop: ClosedLoopSettings | None = None,
    *,
    force: bool = False,
    live_view: LiveViewTarget = NO_LIVE_VIEW,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Fly by the engine's fixes, and write the flight's folder with its track and figures.

    Args:
        out: the folder.
        world: what to fly over; None is the first town.
        loop: settings of the loop; None uses the defaults.
        force: whether the folder may already exist.
        live_view: where to send the live view.
        progress: receives progress and messages.

    Returns:
        The figures, as loop.json has them.

    Raises:
        OptionError, MapError: an argument or the map is invalid.
    """
    out, world, loop = Path(out), world or WorldSettings(), loop or ClosedLoopSettings()
    if world.camera_pitch_deg != NADIR_PITCH_DEG:
        raise OptionError(f"camera_pitch_deg: expected none in a closed loop, got {world.camera_pitch_deg:g}")
    check_folder(out, force)
    live_view.check(force=force)
    progress.message("drawing the world")
    town, camera = world.build(), world.camera()
    site = town.site()
    matcher = SceneMatcher(site, camera, loop.method)
    with progress.task("compiling") as report_compiled:
        matcher.warmup(report_compiled)
    flight = plan_closed_loop(town, camera, matcher, world.seed, loop)
    prepare_folder(out, force, (*FOLDER_OWNED, *LOOP_OWNED))
    with open_view(matcher, live_view) as view:
        seconds = 60.0 * loop.minutes
        count = int(seconds * FRAME_RATE_HZ)
        frames = progress.track(_fly(flight, seconds, view), count, "flying")
        lat, lon = map(float, site.frame.geodetic_from_enu(*flight.flown.start_m[:2]))
        # Written while it flies.
        write_folder(out, town, camera, frames, _truth_rows(flight, town, site), lat, lon)
    record = _record(out, world, loop, site, town, str(matcher.device))
    return _write_results(out, flight, record, progress)


def _write_results(out: Path, flight: ClosedLoop, record: RunRecord, progress: Progress) -> dict[str, Any]:
    """Write track, record, figures of merit and report of a finished flight."""
    flown, latency_ms = flight.flown, 1e3 * flight.latency_s
    rows = (_row(k, answer, latency_ms) for k, answer in enumerate(flown.answers))
    write_notes(out / NOTES, write_track(out / TRACK, rows))
    write_loop_csv(out / LOOP, flown)
    write_json(out / SUMMARY, {"settings": record.facts()})
    summary = evaluate(out, force=True, progress=progress)  # like any finished track
    figures = summarise_loop(flown)
    figures |= {name: summary[name] for name in ("availability", "wrong_over_10m", "false_fixes")}
    write_json(out / "loop.json", figures | {"settings": record.facts()})
    return figures | {"folder": str(out.resolve())}


def _row(index: int, answer: LoopAnswer, latency_ms: float) -> TrackRow:
    state = (answer.state or NavigatorState.LOST).value
    return track_row(picture_name(index), answer.result, latency_ms=latency_ms, deadline_met=None, state=state)


def plan_closed_loop(
    town: Town, camera: Camera, matcher: SceneMatcher, seed: int, loop: ClosedLoopSettings
) -> ClosedLoop:
    """The flight before it begins: circuits of the town, 150 m above its ground."""
    site = matcher.site
    style = FlightStyle()
    least_m = reach_m(camera, style.height_agl_m) + _EDGE_M
    half_m = [0.5 * n * site.gsd_m_per_px - least_m for n in (site.width_px, site.height_px)]
    if min(half_m) < _MIN_HALF_SIDE_M:
        sides = " x ".join(f"{n * site.gsd_m_per_px:.0f}" for n in (site.width_px, site.height_px))
        side_m = 2.0 * (least_m + _MIN_HALF_SIDE_M)
        raise OptionError(f"map: expected {side_m:.0f} m or more a side, got {sides} m")
    style = replace(style, height_agl_m=style.height_agl_m + site.ground_m)
    route = plan_rounds((half_m[0], half_m[1]), 60.0 * loop.minutes, style)
    rng = generator(seed, 0xCA)

    def view(state: State) -> Image:
        return picture_at(town, camera, site.frame, state.position_m, state.attitude, rng)

    return ClosedLoop(route, view, matcher, seed=seed, fault=loop.planned_fault())


def _fly(flight: ClosedLoop, seconds: float, view: LiveView | None) -> Iterator[tuple[str, Frame]]:
    """The names and frames of a flight in progress, each shown once it is answered."""
    latency_ms = 1e3 * flight.latency_s
    for k, frame in enumerate(flight.fly(seconds)):
        if view is not None:
            answer = flight.flown.answers[-1]
            view.show(k, picture_name(k), frame, answer.result, answer.state, latency_ms)
        yield picture_name(k), frame


def _truth_rows(flight: ClosedLoop, town: Town, site: OrthoMap) -> Iterator[Truth]:
    """The true positions, ten per second; available after the flight."""
    for row in flight.flown.record:
        stamp_ns = START_NS + round(row.time_s * 1e9)
        yield truth_at(town, site.frame, stamp_ns, row.truth.position_m, row.truth.attitude)


def _record(
    out: Path, world: WorldSettings, loop: ClosedLoopSettings, site: OrthoMap, town: Town, device: str
) -> RunRecord:
    """The record of a run in ``track``'s form, so that ``evaluate`` can read it."""
    files: dict[str, Any] = {name: str((out / file).resolve()) for name, file in FOLDER_LAYOUT.items()}
    return RunRecord(
        **files,
        method=loop.method,
        profile="engine",
        device=device,
        origin=site.frame,
        ground_m=site.ground_m,
        ground_amsl_m=town.datum_amsl_m + site.ground_m,
        more={"scene": world.facts(), "closed_loop": {"minutes": loop.minutes, "fault": loop.fault}},
    )
