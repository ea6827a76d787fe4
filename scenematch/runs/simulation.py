"""Simulate a flight over a town or the user's map, and write a flight folder with truth."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from engine.camera import NADIR_PITCH_DEG, Camera
from engine.errors import OptionError
from engine.geo import wrap_heading_deg
from engine.maps.accuracy import GEOREFERENCE_TAG, SLOPE_TAG
from engine.values import Frame, Truth
from scenematch.files.flight import FRAME_COLUMNS, camera_info
from scenematch.files.geotiff import write_geotiff
from scenematch.files.telemetry import TelemetryRow, write_telemetry
from scenematch.files.truth import write_truth
from scenematch.runs.arguments import check_between, check_choice
from scenematch.runs.inputs import FlightFiles
from scenematch.runs.output import SILENT, Progress, StrPath, check_folder, prepare_folder
from scenematch.runs.results import OWNED
from scenematch.simulator import CONDITIONS, FlightPlan, FlightStyle, Town, build_town, plan_flight, world_from_map
from scenematch.simulator.flight import paper_camera, reach_m
from scenematch.simulator.town import EXACT, MAX_RELIEF_M

FOLDER_OWNED = ("frames/[0-9]*.jpg", "telemetry.csv", "truth.csv", "camera.yaml", "map.tif", "dsm.tif")
"""The files of a simulated flight's folder."""
LOOP_OWNED = ("loop.csv", "loop.json", *OWNED)
"""Further files that a closed loop writes."""
START_SIGMA_M = 10.0
MAX_PITCH_DEG = -30.0
"""Largest pitch of the camera: 60 degrees from the vertical."""
_JPEG_QUALITY = 95
_HEIGHT_M = FlightStyle().height_agl_m
_TOWN_PX, _GSD_M_PER_PX = (900, 1000), 0.53


@dataclass(frozen=True, slots=True, kw_only=True)
class WorldSettings:
    """The world to fly over.

    Attributes:
        seed: of town, path, sensors and camera.
        condition: light, season and weather in the frames; None is noon.
        relief_m: height of a town's hills.
        map: the user's map, used instead of a town.
        surface: heights of that map.
        camera_pitch_deg: pitch of the camera: -90 looks straight down, -45 looks 45 degrees ahead of that.

    Raises:
        OptionError: the arguments do not go together, there is no such condition, the hills are too high, or the
            camera looks too far from the vertical.
    """

    seed: int = 1
    condition: str | None = None
    relief_m: float = 0.0
    map: StrPath | None = None
    surface: StrPath | None = None
    camera_pitch_deg: float = NADIR_PITCH_DEG

    def __post_init__(self) -> None:
        if not NADIR_PITCH_DEG <= self.camera_pitch_deg <= MAX_PITCH_DEG:
            raise OptionError(
                f"camera_pitch_deg: expected {NADIR_PITCH_DEG:g} (straight down) to {MAX_PITCH_DEG:g}, "
                f"got {self.camera_pitch_deg:g}"
            )
        if self.condition is not None:
            check_choice("condition", self.condition, tuple(CONDITIONS))
        if self.surface is not None and self.map is None:
            raise OptionError(f"surface: expected with `map` only, got {self.surface}")
        check_between("relief_m", self.relief_m, 0.0, MAX_RELIEF_M)
        if self.relief_m and self.map is not None:
            raise OptionError(
                f"relief_m: expected without `map`, whose surface has its own, got {self.relief_m:g}"
            )

    def build(self) -> Town:
        """The world with its map: the seed's town, or the user's rasters."""
        if self.map is not None:
            return world_from_map(self.map, self.surface, condition=self.condition, seed=self.seed)
        # An oblique camera sees further, so the town is larger; the flight stays as long.
        more_m = 2.0 * (reach_m(self.camera(), _HEIGHT_M) - reach_m(paper_camera(), _HEIGHT_M))
        width_px, height_px = (n + math.ceil(more_m / _GSD_M_PER_PX) for n in _TOWN_PX)
        return build_town(
            self.seed,
            width_px=width_px,
            height_px=height_px,
            gsd_m_per_px=_GSD_M_PER_PX,
            condition=self.condition or "noon",
            relief_m=self.relief_m,
        )

    def camera(self) -> Camera:
        """The paper's camera, turned up by its pitch."""
        return paper_camera(self.camera_pitch_deg)

    def facts(self) -> dict[str, Any]:
        """The world as JSON values."""
        return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(self).items()}


def simulate(
    out: StrPath,
    world: WorldSettings | None = None,
    *,
    frames: int | None = None,
    force: bool = False,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Fly the built-in flight and write its folder.

    Args:
        out: the folder.
        world: what to fly over; None is the first town.
        frames: number of frames to fly; None is all.
        force: whether the folder may already exist.
        progress: receives progress and messages.

    Returns:
        Facts about the flight.

    Raises:
        OptionError, MapError: an argument or the map is invalid.
    """
    out, world = Path(out), world or WorldSettings()
    check_folder(out, force)
    progress.message("drawing the world and the flight over it")
    plan = plan_flight(world.seed, frames=frames, town=world.build(), camera=world.camera())
    prepare_folder(out, force, (*FOLDER_OWNED, *LOOP_OWNED))
    write_flight(out, plan, progress=progress)
    way_m = float(np.hypot(*np.diff(plan.truth.position_m[:, :2], axis=0).T).sum())
    seconds = (plan.timestamps_ns[-1] - plan.timestamps_ns[0]) * 1e-9
    return {"frames": len(plan), "seconds": seconds, "way_m": way_m, **world.facts(), "folder": str(out.resolve())}


def write_flight(folder: StrPath, plan: FlightPlan, *, progress: Progress = SILENT) -> FlightFiles:
    """Write the simulated flight to disk like any other flight; it is then read back."""
    truth = plan.truth_rows()
    named = ((picture_name(index), frame) for index, frame in enumerate(plan.iter_frames()))
    frames = progress.track(named, len(plan), "flying")
    write_folder(folder, plan.town, plan.camera, frames, truth, truth[0].lat_deg, truth[0].lon_deg)
    return FlightFiles.in_folder(folder)


def picture_name(index: int) -> str:
    """The file name of a simulated picture."""
    return f"{index:06d}.jpg"


def write_folder(
    folder: StrPath,
    town: Town,
    camera: Camera,
    frames: Iterable[tuple[str, Frame]],
    truth: Iterable[Truth],
    lat_deg: float,
    lon_deg: float,
) -> None:
    """Write the folder of a flight: frames, telemetry.csv, truth.csv, camera.yaml, map.tif and dsm.tif.

    Args:
        folder: created if it does not exist.
        town: provides the map and the surface model.
        camera: intrinsics and mount.
        frames: file name and stamped frame, consumed one at a time before ``truth``.
        truth: the true states, in the order of time.
        lat_deg: of the prior with which the telemetry begins.
        lon_deg: of the same.
    """
    folder = Path(folder)
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    rows: list[TelemetryRow] = []
    for name, frame in frames:
        picture = Image.fromarray(np.asarray(frame.image))
        picture.save(folder / "frames" / name, quality=_JPEG_QUALITY, subsampling=0)
        rows.append(_telemetry_row(name, frame))
    rows[0] = replace(rows[0], lat_deg=lat_deg, lon_deg=lon_deg, sigma_m=START_SIGMA_M)
    write_telemetry(folder / "telemetry.csv", rows)
    write_truth(folder / "truth.csv", list(truth))
    (folder / "camera.yaml").write_text(camera_info(camera), encoding="utf-8")
    grid = town.pixel_to_crs, town.crs_epsg
    write_geotiff(folder / "map.tif", town.ortho, *grid, tags={GEOREFERENCE_TAG: EXACT})
    write_geotiff(folder / "dsm.tif", town.surface_m, *grid, tags={SLOPE_TAG: EXACT})


def _telemetry_row(name: str, frame: Frame) -> TelemetryRow:
    known: dict[str, Any] = {column: getattr(frame, column) for column in FRAME_COLUMNS}
    known["heading_deg"] = wrap_heading_deg(known["heading_deg"])
    return TelemetryRow(frame=name, **known)
