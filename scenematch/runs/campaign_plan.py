"""Plans of campaigns: the TOML file that lists flights and methods, the jobs that come of it, and their inputs."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from engine.errors import OptionError
from engine.maps.rasters import GEOREFERENCE_TAG, stated_sigma
from scenematch.files.datasets.sequence import MANIFEST
from scenematch.files.logs.readers import LogClock
from scenematch.files.settings import read_settings
from scenematch.runs.arguments import check_choice
from scenematch.runs.comparison import parse_runs
from scenematch.runs.inputs import FOLDER_LAYOUT, FlightFiles
from scenematch.runs.jobs import Job, SimulateTask, TrackTask
from scenematch.runs.renaming import renamed_in_errors
from scenematch.runs.settings import TrackSettings
from scenematch.runs.simulation import WorldSettings
from scenematch.simulator import CONDITIONS
from scenematch.simulator.town import MAX_RELIEF_M

RUNS, FLIGHTS, UNFINISHED = "runs", "flights", "unfinished"
"""Folders of a campaign's output folder."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedFlight:
    """The files of a recorded flight, in the layout of a flight folder unless named.

    Attributes:
        folder: that the others lie in, as seen from the campaign's file.
        map: the map.
        surface: its surface model; left out where it has the usual name and is not there, as the next three are.
        camera: the calibration; left out likewise, then ``hfov_deg`` or the photographs' EXIF.
        frames: a folder of pictures, a video or a bag.
        telemetry: telemetry.csv or a log.
        frame_stamps: with a log, a CSV with timestamp_ns and frame; without it the frames' own stamps.
        log_offset_s: with a log, added to the frames' stamps.
        image_topic: of the pictures, where the frames are a bag with several.
        odometry_topic: another odometry that the velocity is taken from, where the telemetry is a bag.
        every: one frame in so many is used.
        truth: truth.csv or a log.
        map_sigma_m: georeferencing accuracy of the map per axis; none is what the map states.
        map_bounds: "W,S,E,N" of a picture without georeference, in degrees or in ``map_crs``.
        map_crs: of a map that names none.
        hfov_deg: horizontal field of view, in place of a calibration.
        mount: how the camera is mounted, by name.
        camera_pitch_deg: of the camera, -90 looks straight down.
        scale_calibration: whether the calibration is scaled to pictures of another size and the same shape.
        group: flights of one group are pooled in the table; without it those of a published data set are, and any
            other flight is a group of its own.
    """

    folder: str = "."
    map: str = "map.tif"
    surface: str | None = "dsm.tif"
    camera: str = "camera.yaml"
    frames: str = "frames"
    telemetry: str | None = "telemetry.csv"
    frame_stamps: str | None = None
    log_offset_s: float = 0.0
    image_topic: str | None = None
    odometry_topic: str | None = None
    every: int = 1
    truth: str | None = "truth.csv"
    map_sigma_m: float | None = None
    map_bounds: str | None = None
    map_crs: str | None = None
    hfov_deg: float | None = None
    mount: str | None = None
    camera_pitch_deg: float | None = None
    scale_calibration: bool = False
    group: str | None = None

    def __post_init__(self) -> None:
        with renamed_in_errors(offset_s="log_offset_s"):
            LogClock(offset_s=self.log_offset_s)
        stated_sigma(self.map_sigma_m, None, GEOREFERENCE_TAG, "map_sigma_m")

    def files(self, name: str, base: Path) -> FlightFiles:
        """The files as :func:`scenematch.runs.tracking.track` takes them.

        Raises:
            OptionError: one that is needed or was named is not there.
        """
        defaults, folder = RecordedFlight(), base / self.folder

        def needed(what: str) -> Path:
            path: Path = folder / getattr(self, what)
            if not path.exists():
                raise OptionError(f"flights.{name}.{what}: expected a file that is there, got {path}")
            return path.resolve()

        def optional(what: str) -> Path | None:
            file = getattr(self, what)
            if file is None or (file == getattr(defaults, what) and not (folder / file).exists()):
                return None
            return needed(what)

        try:
            return FlightFiles.from_flat(
                map=needed("map"),
                surface=optional("surface"),
                camera=optional("camera"),
                frames=needed("frames"),
                telemetry=optional("telemetry"),
                truth=optional("truth"),
                frame_stamps=optional("frame_stamps"),
                log_offset_s=self.log_offset_s,
                image_topic=self.image_topic,
                odometry_topic=self.odometry_topic,
                every=self.every,
                map_sigma_m=self.map_sigma_m,
                map_bounds=self.map_bounds,
                map_crs=self.map_crs,
                hfov_deg=self.hfov_deg,
                mount=self.mount,
                camera_pitch_deg=self.camera_pitch_deg,
                scale_calibration=self.scale_calibration,
            )
        except OptionError as error:
            raise OptionError(f"flights.{name}: {error}") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedFlights:
    """Simulated flights: every seed in every condition.

    Attributes:
        seeds: of town, path, sensors and camera.
        conditions: of the frames; the map is of noon.
        frames: of each flight; none flies to the end.
        relief_m: height of the hills.

    Raises:
        OptionError: a value is out of range, or there is no such condition.
    """

    seeds: tuple[int, ...] = ()
    conditions: tuple[str, ...] = ("noon",)
    frames: int | None = None
    relief_m: float = 0.0

    def __post_init__(self) -> None:
        for condition in self.conditions:
            check_choice("conditions", condition, tuple(CONDITIONS))
        for seed in self.seeds:
            if seed < 0:
                raise OptionError(f"seeds: expected 0 or more, got {seed}")
        if self.frames is not None and self.frames < 1:
            raise OptionError(f"frames: expected 1 or more, got {self.frames}")
        if not 0.0 <= self.relief_m <= MAX_RELIEF_M:
            raise OptionError(f"relief_m: expected 0 to {MAX_RELIEF_M:g}, got {self.relief_m:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Campaign:
    """What a campaign's file holds.

    Attributes:
        runs: how each flight is tracked: METHOD, METHOD/PROFILE or a settings file each.
        flights: the recorded ones, by name.
        simulated: the simulated ones.
    """

    runs: tuple[str, ...] = ()
    flights: dict[str, RecordedFlight] = field(default_factory=dict)
    simulated: SimulatedFlights = field(default_factory=SimulatedFlights)

    def __post_init__(self) -> None:
        for name in self.flights:
            if not _NAME.fullmatch(name):
                raise OptionError(f"flights: expected a name of letters, digits, '_', '.' and '-', got {name!r}")


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """All the jobs of a campaign.

    Attributes:
        simulated: flights to be simulated, before the runs over them.
        runs: a flight by a method each.
        groups: of each run's flight, what it is pooled with.
    """

    simulated: list[Job]
    runs: list[Job]
    groups: dict[str, str]


def plan_campaign(path: Path, out: Path) -> CampaignPlan:
    """Read a campaign's file, and find every input.

    Raises:
        OptionError, OSError: it cannot be read, or asks for what is not there.
    """
    campaign = read_settings(path, Campaign)
    try:
        return _plan(campaign, path.parent, out)
    except OptionError as error:
        raise OptionError(f"{path}: {error}") from None


def _plan(campaign: Campaign, base: Path, out: Path) -> CampaignPlan:
    runs = _runs(campaign, base)
    simulated: list[Job] = []
    files, groups, hashes = dict[str, FlightFiles](), dict[str, str](), dict[str, dict[str, str]]()
    for name, world in _worlds(campaign.simulated):
        if name in campaign.flights:
            raise OptionError(f"flights.{name}: expected another name, this is a simulated flight's")
        job = _simulate_job(name, world, campaign.simulated.frames, out)
        simulated.append(job)
        files[name], groups[name], hashes[name] = _files_to_come(job), f"simulated {world.condition}", job.inputs
    for name, flight in campaign.flights.items():
        files[name] = flight.files(name, base)
        groups[name] = flight.group or _dataset(base / flight.folder) or name
        hashes[name] = _input_hashes(files[name])
    if not files:
        raise OptionError("expected flights, as [flights.NAME] or as seeds in [simulated], got none")
    jobs = []
    for flight_name in files:
        for run_name, settings in runs.items():
            name, inputs = f"{flight_name}/{run_name}", hashes[flight_name] | _settings_hash(settings)
            task = TrackTask(files[flight_name], settings)
            jobs.append(Job(name, out / RUNS / name, out / UNFINISHED, inputs, task))
    return CampaignPlan(simulated, jobs, groups)


def _files_to_come(job: Job) -> FlightFiles:
    """All the files of a flight folder, which the job is going to write."""
    paths: dict[str, Any] = {name: job.folder / file for name, file in FOLDER_LAYOUT.items()}
    return FlightFiles.from_flat(**paths)


def _dataset(folder: Path) -> str | None:
    """The published data set that a flight folder was made from, or None."""
    try:
        name = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))["dataset"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return name if isinstance(name, str) else None


def _runs(campaign: Campaign, base: Path) -> dict[str, TrackSettings]:
    """The methods; a settings file is looked for beside the campaign's."""
    texts = [str(base / text) if (base / text).is_file() else text for text in campaign.runs]
    if not texts:
        raise OptionError('runs: expected a list of METHOD, METHOD/PROFILE or settings files, such as ["ncc"]')
    try:
        runs = parse_runs(texts)
    except OptionError as error:
        raise OptionError(f"runs: {str(error).removeprefix('runs: ')}") from None
    # Whether there is a GPU differs from machine to machine of a cluster; results must not.
    return {
        name: replace(settings, device="cpu") if settings.device == "auto" else settings
        for name, settings in runs.items()
    }


def _worlds(simulated: SimulatedFlights) -> Iterator[tuple[str, WorldSettings]]:
    for condition in simulated.conditions:
        for seed in simulated.seeds:
            world = WorldSettings(seed=seed, condition=condition, relief_m=simulated.relief_m)
            yield f"town-{seed}-{condition}", world


def _simulate_job(name: str, world: WorldSettings, frames: int | None, out: Path) -> Job:
    facts = json.dumps(world.facts() | {"frames": frames})
    inputs = {"simulation": facts, "engine": version("scenematch-engine")}
    return Job(name, out / FLIGHTS / name, out / UNFINISHED, inputs, SimulateTask(world, frames))


def _settings_hash(settings: TrackSettings) -> dict[str, str]:
    text = json.dumps(asdict(settings), sort_keys=True, default=str)
    return {
        "settings": hashlib.blake2b(text.encode(), digest_size=16).hexdigest(),
        "engine": version("scenematch-engine"),
    }


def _input_hashes(files: FlightFiles) -> dict[str, str]:
    """A hash of the content of each input; no stamp of a file has to be trusted."""
    given = files.flat()
    paths = {name: given[name] for name in (*FOLDER_LAYOUT, "frame_stamps")}
    hashes = {name: _content_hash(path) for name, path in paths.items() if path is not None}
    values = {name: given[name] for name in _VALUES}
    values |= {
        "log_offset_s": files.log_offset_s or None,
        "scale_calibration": given["scale_calibration"] or None,
        "every": files.every if files.every > 1 else None,
    }
    return hashes | {name: repr(value) for name, value in values.items() if value is not None}


_VALUES = (
    "image_topic", "odometry_topic", "map_sigma_m", "map_bounds", "map_crs", "hfov_deg", "mount",
    "camera_pitch_deg",
)  # fmt: skip


@cache
def _content_hash(path: Path) -> str:
    """Of a file's bytes, or of all the files in a folder with their names."""
    digest = hashlib.blake2b(digest_size=16)
    if path.is_file():
        with path.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    else:
        for file in sorted(file for file in path.rglob("*") if file.is_file()):
            digest.update(f"{file.relative_to(path).as_posix()} {_content_hash(file)}\n".encode())
    return digest.hexdigest()
