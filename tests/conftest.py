"""Fixtures that many tests use: the shared flights, a simulated town and flight, and a ground drawn ray by ray.

What takes long to import is imported by the fixtures: the process that hands tests to workers runs none of them.
"""

import gc
import os
import shutil
from dataclasses import replace
from functools import cache

import cv2
import hypothesis
import numpy as np
import pytest

from engine import Fix
from scenematch.simulator import plan_flight
from tests.support import towns
from tests.support.paths import NO_SHARED, SHARED
from tests.support.towns import drawn_flight, drawn_town, site_of

hypothesis.settings.register_profile("tests", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("tests")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Half a million objects of modules and tests stay: the collector does not look through them again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _surroundings(tmp_path_factory):
    """What holds for all tests of a process; those of towns call `build_town` themselves."""
    import torch

    # Results do not depend on the number of cores, and test runs side by side do not fight for them.
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    if "PYTEST_XDIST_WORKER" in os.environ:  # each worker has a folder of its own in that of the run
        towns.kept_in = tmp_path_factory.getbasetemp().parent
    with pytest.MonkeyPatch.context() as patch:
        # Resampled maps stay out of the home directory.
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        # Who draws a town below the tests takes the one that was drawn before.
        for module in ("simulator", "simulator.flight", "runs.simulation"):
            patch.setattr(f"scenematch.{module}.build_town", drawn_town)
        patch.setattr("bench.inputs.scenes.build_town", drawn_town)
        yield


@pytest.fixture(name="bare_runs")
def _bare_runs():
    """For tests of commands: see :func:`tests.support.runs.bare_runs`."""
    from tests.support.runs import bare_runs

    with bare_runs():
        yield


@pytest.fixture
def save(tmp_path):
    """Write a file with given contents; its path."""

    def write(content, name="telemetry.csv"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.fixture(scope="session")
def shared():
    """The folder of the shared flights; tests that ask for it are skipped where it is missing."""
    if not SHARED.is_dir():
        pytest.skip(NO_SHARED)
    return SHARED


@pytest.fixture(scope="session")
def sim_town():
    return drawn_town(1)


@pytest.fixture(scope="session")
def sim_flight(sim_town):
    """The first 24 frames of the paper's flight over a simulated town."""
    return drawn_flight(plan_flight(1, town=sim_town, frames=24))


@pytest.fixture(scope="session")
def flight_in(tmp_path_factory):
    """Write up to eight frames of the usual flight to a folder, as `write_flight` does: they are drawn once."""
    from scenematch.runs.inputs import FlightFiles
    from scenematch.runs.simulation import write_flight

    @cache
    def drawn():
        folder = tmp_path_factory.mktemp("drawn")
        write_flight(folder, plan_flight(town=drawn_town(), frames=8))
        return folder

    def write(folder, frames):
        shutil.copytree(drawn(), folder, dirs_exist_ok=True)
        for table in (folder / "telemetry.csv", folder / "truth.csv"):
            lines = table.read_text(encoding="utf-8").splitlines(keepends=True)
            table.write_text("".join(lines[: 1 + frames]), encoding="utf-8")
        for picture in sorted((folder / "frames").iterdir())[frames:]:
            picture.unlink()
        return FlightFiles.in_folder(folder)

    return write


@pytest.fixture(scope="session")
def flight(flight_in, tmp_path_factory):
    """The folder of a flight of six frames, to be read and not written."""
    folder = tmp_path_factory.mktemp("flight")
    flight_in(folder, frames=6)
    return folder


@pytest.fixture(scope="session")
def sim_site(sim_town):
    """The town's map with its surface model."""
    return site_of(sim_town)


@pytest.fixture(scope="session")
def mirrored_site(sim_town):
    """The town as a mirror shows it: the same kind of streets, and none of its places."""
    ortho, surface_m = (np.ascontiguousarray(raster[:, ::-1]) for raster in (sim_town.ortho, sim_town.surface_m))
    return site_of(replace(sim_town, ortho=ortho, surface_m=surface_m))


@pytest.fixture(scope="session")
def other_site():
    """The map of another town with the same kind of streets."""
    return site_of(drawn_town(7))


@pytest.fixture(scope="session")
def camera():
    """The paper's: 300 x 300 px, 60 degrees, straight down."""
    from tests.support.ground import CAMERA

    return CAMERA


@pytest.fixture(scope="session")
def ground():
    """Ground on the central meridian: the map's up is true north to 0.003 degrees."""
    from tests.support.ground import Ground

    return Ground()


@pytest.fixture(scope="session")
def error_m():
    """Horizontal metres from a fix to a row of truth."""

    def measure(site, fix, truth):
        assert isinstance(fix, Fix), fix
        place = site.frame.enu_from_geodetic(truth.lat_deg, truth.lon_deg)
        return float(np.hypot(fix.east_m - place[0], fix.north_m - place[1]))

    return measure
