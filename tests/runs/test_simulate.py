"""The command `simulate`: folders that are read back as flights, a loop that is closed, and what is refused."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from engine import Camera, OrthoMap
from scenematch.cli.app import run
from scenematch.files.flight import open_flight
from scenematch.files.track import read_track
from scenematch.files.truth import interpolate_truth, read_truth
from scenematch.simulator import build_town
from tests.support.commands import file_options, refusal
from tests.support.runs import bare_runs

FOLDER = {"frames", "telemetry.csv", "truth.csv", "camera.yaml", "map.tif", "dsm.tif"}
pytestmark = pytest.mark.usefixtures("bare_runs")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An open flight of three frames."""
    out = tmp_path_factory.mktemp("open") / "flight"
    assert run(["simulate", "--out", str(out), "--frames", "3", "--seed", "1"]) == 0
    return out


def own_map(folder):
    return file_options(folder, camera=None, frames=None, telemetry=None)


@pytest.fixture(scope="module")
def loop(folder, tmp_path_factory):
    """Six seconds by the engine's fixes, over the map of that flight."""
    out = tmp_path_factory.mktemp("closed") / "flight"
    arguments = ["simulate", "--out", str(out), *own_map(folder), "--closed-loop", "--minutes", "0.1"]
    with bare_runs():
        assert run([*arguments, "--method", "ncc"]) == 0
    return out


def test_a_flight_folder_is_what_track_reads(folder):
    assert {path.name for path in folder.iterdir()} == FOLDER
    flight = open_flight(folder / "frames", folder / "telemetry.csv", Camera.load(folder / "camera.yaml"))
    truth = read_truth(folder / "truth.csv")
    site = OrthoMap.open(folder / "map.tif", surface=folder / "dsm.tif")
    assert len(flight) == len(truth) == 3
    assert [item.prior is not None for item in flight] == [True, False, False]
    for item, true in zip(flight, truth, strict=True):
        assert item.frame.timestamp_ns == true.timestamp_ns
        assert item.frame.height_agl_m == pytest.approx(true.height_agl_m, abs=4.0)
        x, y = site.pixel_from_geodetic(true.lat_deg, true.lon_deg)
        assert 0 < x < site.width_px
        assert 0 < y < site.height_px


@pytest.mark.slow
def test_one_seed_gives_the_same_bytes(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("scenematch.runs.simulation.build_town", build_town)  # drawn again, not taken again
    again = tmp_path / "again"
    assert run(["simulate", "--out", str(again), "--frames", "2", "--seed", "1"]) == 0
    for name in ("map.tif", "dsm.tif", "camera.yaml", "frames/000000.jpg", "frames/000001.jpg"):
        assert (again / name).read_bytes() == (folder / name).read_bytes(), name
    assert (folder / "truth.csv").read_text().startswith((again / "truth.csv").read_text())


def test_a_map_of_ones_own_is_the_world_and_the_day_changes_its_pictures(folder, tmp_path):
    pictures = []
    for condition in ([], ["--condition", "evening"]):
        out = tmp_path / f"own{len(condition)}"
        assert run(["simulate", "--out", str(out), "--frames", "1", *own_map(folder), *condition]) == 0
        pictures.append((out / "frames/000000.jpg").read_bytes())
        given, written = OrthoMap.open(folder / "map.tif"), OrthoMap.open(out / "map.tif")
        np.testing.assert_allclose(written.bounds_deg, given.bounds_deg, atol=1e-9)
    assert pictures[0] != pictures[1]


@pytest.mark.slow
def test_a_closed_loop_leaves_a_flight_folder_with_its_results(loop):
    names = {path.name for path in loop.iterdir()}
    assert names >= FOLDER | {"track.csv", "loop.csv", "summary.json", "loop.json"}
    flight = open_flight(loop / "frames", loop / "telemetry.csv", Camera.load(loop / "camera.yaml"))
    rows, truth = read_track(loop / "track.csv"), read_truth(loop / "truth.csv")
    assert len(flight) == len(rows) == 30
    assert [row.timestamp_ns for row in rows] == [item.frame.timestamp_ns for item in flight]
    fixed = [row for row in rows if row.fixed]
    assert len(fixed) > 25
    site = OrthoMap.open(loop / "map.tif")
    for row in fixed:
        true = interpolate_truth(truth, row.timestamp_ns)
        place = site.frame.enu_from_geodetic(true.lat_deg, true.lon_deg)
        assert np.hypot(row.east_m - place[0], row.north_m - place[1]) < 5.0


@pytest.mark.slow
def test_its_figures_are_those_of_its_record(loop):
    figures = json.loads((loop / "loop.json").read_text())
    with (loop / "loop.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 60
    off = [[float(r[f"true_{a}_m"]) - float(r[f"plan_{a}_m"]) for a in ("east", "north")] for r in rows]
    assert figures["plan_rms_m"] == pytest.approx(np.sqrt(np.mean(np.sum(np.square(off), axis=1))), abs=2e-3)
    assert figures["plan_rms_m"] < 3.0
    assert figures["handed_over"] is False
    assert figures["frames"] == 30
    assert {r["mode"] for r in rows} == {"follow"}


@pytest.mark.slow
def test_a_flight_that_was_tracked_into_a_loops_folder_was_steered_by_nothing(folder, loop, tmp_path):
    out = Path(shutil.copytree(loop, tmp_path / "loop"))
    assert run(["evaluate", str(out)]) == 0
    assert "Closed loop: steered by" in (out / "report.html").read_text(encoding="utf-8")
    again = ["track", *file_options(folder), f"--out={out}", "--method=ncc", "--device=cpu", "--force"]
    assert run(again) == 0
    assert "Closed loop" not in (out / "report.html").read_text(encoding="utf-8")
    assert run(["evaluate", str(out)]) == 0
    assert "Closed loop" not in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_an_older_run_is_kept_without_force_and_leaves_nothing_with_it(folder, loop, capsys):
    before = (loop / "truth.csv").read_bytes()
    assert "--force" in refusal(capsys, ["simulate", "--out", loop, "--frames", "1"])
    assert (loop / "truth.csv").read_bytes() == before
    (loop / "mine.txt").write_text("kept")
    assert run(["simulate", "--out", str(loop), "--frames", "1", *own_map(folder), "--force"]) == 0
    assert {path.name for path in loop.iterdir()} == FOLDER | {"mine.txt"}
    assert len(list((loop / "frames").iterdir())) == 1
