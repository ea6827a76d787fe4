"""``simulate``: a flight that did not happen, as a folder that ``track`` reads; or one flown by the fixes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import check_choice, check_device, check_folder, prepare_folder
from engine.errors import OptionError
from engine.formats.flight import write_flight_folder
from engine.formats.track import TrackRow, read_track, track_row, write_track
from engine.formats.truth import read_truth
from engine.matcher import METHODS, SceneMatcher
from engine.orthomap import OrthoMap
from engine.report.closed_loop import draw_loop, summarise_loop, write_loop_csv
from engine.report.figures import draw_figures
from engine.report.metrics import Ground, summarise
from engine.runs.demo import START_SIGMA_M, write_flight
from engine.runs.tracking import OWNED
from engine.runs.watching import Watching, watched
from engine.sim import CONDITIONS, FlightStyle, Town, build_town, picture_at, plan_flight, world_from_map
from engine.sim.faults import KINDS, Fault
from engine.sim.flight import grid_at
from engine.sim.light import Image
from engine.sim.loop import START_NS, ClosedLoop
from engine.sim.pilot import plan_rounds
from engine.sim.quadrotor import State
from engine.sim.town import EXACT, RELIEF_MAX_M, generator
from engine.values import Frame, Prior, Truth

if TYPE_CHECKING:  # rerun is optional
    from engine.report.live_view import LiveView

FOLDER = ("frames/[0-9]*.jpg", "telemetry.csv", "truth.csv", "camera.yaml", "map.tif", "dsm.tif")
RESULTS = ("loop.csv", "loop.json", "loop.png", "loop-path.png", *OWNED)
FAULT_S = 60.0
"""When a fault begins; in a flight that is shorter than twice that, halfway."""
_FILES = {
    "map": "map.tif",
    "surface": "dsm.tif",
    "camera": "camera.yaml",
    "frames": "frames",
    "telemetry": "telemetry.csv",
    "truth": "truth.csv",
}
_MIN_HALF_SIDE_M = 10.0  # half of a side of the rounds
_EDGE_M = 6.0  # that a level footprint keeps from the map's edge


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldSettings:
    """What is flown over, as the command line has it.

    Raises:
        OptionError: the options do not go together, there is no such condition, or the hills are too high.
    """

    seed: int = 1
    condition: str | None = None
    relief_m: float = 0.0
    map: Path | None = None
    surface: Path | None = None

    def __post_init__(self) -> None:
        if self.condition is not None:
            check_choice("--condition", self.condition, tuple(CONDITIONS))
        if self.surface is not None and self.map is None:
            raise OptionError(f"--surface: expected with --map only, got {self.surface}")
        if not 0.0 <= self.relief_m <= RELIEF_MAX_M:
            raise OptionError(f"--relief-m: expected 0 to {RELIEF_MAX_M:g}, got {self.relief_m:g}")
        if self.relief_m and self.map is not None:
            raise OptionError(
                f"--relief-m: expected without --map, whose surface has its own, got {self.relief_m:g}"
            )

    def build(self) -> Town:
        """The world with its map: a town of the seed's, or the user's rasters."""
        if self.map is not None:
            return world_from_map(self.map, self.surface, condition=self.condition, seed=self.seed)
        return build_town(self.seed, condition=self.condition, relief_m=self.relief_m)

    def facts(self) -> dict[str, Any]:
        """The same as JSON can hold it."""
        return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self).items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopSettings:
    """How the loop is closed, as the command line has it.

    Raises:
        OptionError: a word or a number is none of those that are expected.
        DeviceError: the device is missing.
    """

    minutes: float = 5.0
    method: str = "auto"
    fault: str = "none"
    device: str = "auto"

    def __post_init__(self) -> None:
        check_choice("--method", self.method, METHODS)
        check_choice("--fault", self.fault, KINDS)
        if not 0.1 <= self.minutes <= 120.0:
            raise OptionError(f"--minutes: expected 0.1 to 120, got {self.minutes:g}")
        check_device("--device", self.device)

    def planned_fault(self) -> Fault:
        """The fault with its times: ten seconds, but a map that is shifted stays so."""
        start_s = min(FAULT_S, 30.0 * self.minutes)
        return Fault(kind=self.fault, start_s=start_s, duration_s=math.inf if self.fault == "shifted" else 10.0)


def run_simulate(out: Path, scene: WorldSettings, *, frames: int | None, force: bool) -> dict[str, Any]:
    """Fly the built-in flight and write its folder; returns facts about it."""
    check_folder(out, force)
    console.say("drawing the world and the flight over it")
    plan = plan_flight(scene.seed, frames=frames, town=scene.build())
    prepare_folder(out, force, (*FOLDER, *RESULTS))
    write_flight(out, plan)
    console.say(
        f"follow it: scenematch track --map {out}/map.tif --surface {out}/dsm.tif --camera {out}/camera.yaml "
        f"--frames {out}/frames --telemetry {out}/telemetry.csv --out {out}-track"
    )
    way_m = float(np.hypot(*np.diff(plan.truth.position_m[:, :2], axis=0).T).sum())
    seconds = (plan.timestamps_ns[-1] - plan.timestamps_ns[0]) * 1e-9
    return {"frames": len(plan), "seconds": seconds, "way_m": way_m, **scene.facts(), "folder": str(out.resolve())}


def run_closed_loop(
    out: Path, scene: WorldSettings, loop: LoopSettings, *, force: bool, watching: Watching | None = None
) -> dict[str, Any]:
    """Fly by the engine's fixes, and write the flight's folder with its track and figures; returns the figures."""
    check_folder(out, force)
    watching = watching or Watching()
    watching.check(force=force)
    console.say("drawing the world")
    town, camera = scene.build(), Camera.from_fov(300, 300, 60.0)
    site = town.site()
    matcher = SceneMatcher(site, camera, loop.method, loop.device)
    matcher.warmup()
    flight = close_loop(town, camera, matcher, scene.seed, loop)
    prepare_folder(out, force, (*FOLDER, *RESULTS))
    with watched(matcher, watching) as view:
        _write_folder(out, flight, town, camera, site, loop, view)
    record = _record(out, scene, loop, site, town, str(matcher.device))
    return _write_results(out, flight, site, record)


def _write_results(out: Path, flight: ClosedLoop, site: OrthoMap, record: dict[str, Any]) -> dict[str, Any]:
    """Track, record, figures of merit and plots of a flight that was flown."""
    flown, told_ms = flight.flown, 1e3 * flight.options.latency_s
    rows = [
        track_row(_name(k), answer.result, latency_ms=told_ms, deadline_met=None)
        for k, answer in enumerate(flown.answers)
    ]
    write_track(out / "track.csv", rows)
    rows = read_track(out / "track.csv")  # as they stand in the file, so that evaluate gives the same figures
    write_loop_csv(out / "loop.csv", flown)
    figures = summarise_loop(flown)
    summary = _summarise(out, rows, site, record)
    figures |= {name: summary[name] for name in ("availability", "wrong_over_10m", "false_fixes")}
    (out / "loop.json").write_text(json.dumps(figures | {"settings": record}, indent=2) + "\n", encoding="utf-8")
    scene, fault = record["scene"], flight.fault
    day = scene["condition"] or "noon"
    title = f"closed loop, seed {scene['seed']}, {day}, {record['method']}, fault: {fault.kind}"
    title += f"\ntrue track {figures['plan_rms_m']:.2f} m RMS from the plan"
    draw_loop(out, flown, title, fault)
    return figures | {"folder": str(out.resolve())}


def _summarise(out: Path, rows: list[TrackRow], site: OrthoMap, record: dict[str, Any]) -> dict[str, Any]:
    """Write summary.json and the figures of the track, as ``track`` does."""
    truth, ground = read_truth(out / "truth.csv"), Ground(record["ground_m"], record["ground_amsl_m"])
    summary = summarise(rows, truth, frame=site.frame, ground=ground) | {"settings": record}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    draw_figures(out, rows, truth, site=site, title=f"{record['method']}, closed loop", ground=ground)
    return summary


def close_loop(town: Town, camera: Camera, matcher: SceneMatcher, seed: int, loop: LoopSettings) -> ClosedLoop:
    """The flight that ``loop`` asks for, not begun yet: rounds of the town, 150 m above its ground."""
    site = matcher.site
    style = FlightStyle()
    corner = np.linalg.inv(camera.matrix) @ (camera.width_px - 0.5, camera.height_px - 0.5, 1.0)
    reach_m = style.height_agl_m * math.hypot(corner[0], corner[1]) + _EDGE_M
    half_m = [0.5 * n * site.gsd_m_per_px - reach_m for n in (site.width_px, site.height_px)]
    if min(half_m) < _MIN_HALF_SIDE_M:
        sides = " x ".join(f"{n * site.gsd_m_per_px:.0f}" for n in (site.width_px, site.height_px))
        raise OptionError(
            f"--map: expected {2.0 * (reach_m + _MIN_HALF_SIDE_M):.0f} m or more a side, got {sides} m"
        )
    style = replace(style, height_agl_m=style.height_agl_m + site.ground_m)
    route = plan_rounds((half_m[0], half_m[1]), 60.0 * loop.minutes, style)
    rng = generator(seed, 0xCA)

    def view(state: State) -> Image:
        return picture_at(town, camera, site.frame, state.position_m, state.attitude, rng)

    return ClosedLoop(route, view, matcher, seed=seed, fault=loop.planned_fault())


def _name(k: int) -> str:
    return f"{k:06d}.jpg"


def _fly(flight: ClosedLoop, seconds: float, view: LiveView | None) -> Iterator[Frame]:
    """The frames of a flight while it is flown, each shown once it is answered."""
    told_ms = 1e3 * flight.options.latency_s
    for k, frame in enumerate(flight.fly(seconds)):
        if view is not None:
            answer = flight.flown.answers[-1]
            view.show(k, _name(k), frame, answer.result, answer.state, told_ms)
        yield frame


def _write_folder(
    out: Path,
    flight: ClosedLoop,
    town: Town,
    camera: Camera,
    site: OrthoMap,
    loop: LoopSettings,
    view: LiveView | None,
) -> None:
    """Fly, and write the folder as it goes: pictures, telemetry by the filter, truth, camera and map."""
    seconds = 60.0 * loop.minutes
    count = int(seconds * flight.options.frame_rate_hz)
    frames = console.progress(_fly(flight, seconds, view), count, "flying")
    start = flight.flown.start_m
    lat, lon = site.frame.geodetic_from_enu(start[0], start[1])
    write_flight_folder(
        out,
        frames=((_name(k), frame) for k, frame in enumerate(frames)),
        truth=_truth_rows(flight, town, site),
        camera=camera,
        ortho_rgb=town.ortho,
        pixel_to_crs=town.pixel_to_crs,
        crs_epsg=town.crs_epsg,
        surface_m=town.surface_m,
        start=Prior(lat_deg=float(lat), lon_deg=float(lon), sigma_m=START_SIGMA_M),
        georeference_sigma_m=EXACT,
        slope_sigma_deg=EXACT,
    )


def _truth_rows(flight: ClosedLoop, town: Town, site: OrthoMap) -> Iterator[Truth]:
    """Where the vehicle really was, ten times a second; to be asked for when it has been flown."""
    for row in flight.flown.record:
        east, north, up = (float(v) for v in row.truth.position_m)
        lat, lon = site.frame.geodetic_from_enu(east, north)
        attitude = row.truth.attitude
        yield Truth(
            timestamp_ns=START_NS + round(row.time_s * 1e9),
            lat_deg=float(lat),
            lon_deg=float(lon),
            alt_amsl_m=town.datum_amsl_m + up,
            height_agl_m=up - town.world.ground_at(grid_at(town, site.frame, row.truth.position_m)),
            roll_deg=attitude.roll_deg,
            pitch_deg=attitude.pitch_deg,
            heading_deg=attitude.heading_deg,
        )


def _record(
    out: Path, scene: WorldSettings, loop: LoopSettings, site: OrthoMap, town: Town, device: str
) -> dict[str, Any]:
    """What a run was made of, in the words of ``track``, so that ``evaluate`` reads it."""
    files = {name: str((out / file).resolve()) for name, file in _FILES.items()}
    return files | {
        "method": loop.method,
        "profile": "engine",
        "device": device,
        "origin": {"lat_deg": site.frame.lat_deg, "lon_deg": site.frame.lon_deg},
        "ground_m": site.ground_m,
        "ground_amsl_m": town.datum_amsl_m + site.ground_m,
        "scene": scene.facts(),
        "closed_loop": {"minutes": loop.minutes, "fault": loop.fault},
    }
