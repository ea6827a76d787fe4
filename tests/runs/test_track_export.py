"""A tracked flight and its truth as TUM, read back: the same errors as the summary's, in position and attitude."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenematch import TrackSettings, export_track, track
from scenematch.files.track import read_track, with_notes
from tests.support.runs import bare_runs

ROUNDED_M = 0.5e-3 * 2**0.5  # each axis of track.csv is rounded to a millimetre


@pytest.fixture(scope="module")
def finished(flight_in, tmp_path_factory):
    """Flight folder and output folder of a flight, tracked by NCC, with both TUM files."""
    folder = tmp_path_factory.mktemp("export")
    files = flight_in(folder / "flight", frames=5)
    out = folder / "out"
    with bare_runs():
        track(files, out, TrackSettings(device="cpu"))
    export_track(out, "tum")
    export_track(out, "tum", truth=folder / "flight" / "truth.csv")
    return out


def tum(path):
    """Stamps (N,), places (N, 3) and rotations of a file."""
    table = np.loadtxt(path, ndmin=2)
    return table[:, 0], table[:, 1:4], Rotation.from_quat(table[:, 4:])


def test_the_two_files_differ_by_the_errors_of_the_summary(finished):
    summary = json.loads((finished / "summary.json").read_text())
    (stamps, places, _), (true_stamps, true_places, _) = (tum(finished / f"{n}.tum") for n in ("track", "truth"))
    assert len(stamps) == summary["fixes"] > 2
    assert stamps.tolist() == true_stamps.tolist()
    off_m = places - true_places
    assert np.sqrt((off_m[:, :2] ** 2).sum(axis=1).mean()) == pytest.approx(summary["rms_m"], abs=ROUNDED_M)
    assert np.sqrt((off_m[:, 2] ** 2).mean()) == pytest.approx(summary["height_rms_m"], abs=1e-3)


def test_the_attitude_is_that_of_the_fixes_and_near_the_truth(finished):
    (_, _, turns), (_, _, true_turns) = (tum(finished / f"{name}.tum") for name in ("track", "truth"))
    assert np.degrees((turns * true_turns.inv()).magnitude()).max() < 2.0
    assert np.degrees(turns.magnitude()).max() > 1.0  # no identity among them
    rows = with_notes(read_track(finished / "track.csv"), finished / "notes.csv")
    notes = [row for row in rows if row.roll_deg is not None]
    assert len(notes) == len(turns)
    assert all(note.sigma_up_m > 0.0 for note in notes)


def test_evo_reports_the_rms_of_the_summary(finished):
    """By the command of the documentation, in a process of its own: evo is GPL, and no dependency."""
    command = shutil.which("evo_ape", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if command is None:
        pytest.skip("evo is not installed")
    files = [str(finished / f"{name}.tum") for name in ("truth", "track")]
    asked = ["--pose_relation", "trans_part", "--project_to_plane", "xy"]
    done = subprocess.run([command, "tum", *files, *asked], capture_output=True, text=True, check=True)
    found = dict(re.findall(r"^\s*(\w+)\s+([\d.]+)$", done.stdout, re.MULTILINE))
    summary = json.loads((finished / "summary.json").read_text())
    assert float(found["rmse"]) == pytest.approx(summary["rms_m"], abs=ROUNDED_M)


def test_a_run_of_before_is_exported_without_what_it_did_not_note(finished, tmp_path):
    for name in ("track.csv", "summary.json"):
        (tmp_path / name).write_bytes((finished / name).read_bytes())
    head = "frame,state,window_x0_px,window_y0_px,heading_deg,stage,confidence,detail"
    lines = [line.split(",") for line in (finished / "notes.csv").read_text().splitlines()[1:]]
    (tmp_path / "notes.csv").write_text("\n".join([head, *(",".join([*line[:7], ""]) for line in lines), ""]))
    assert export_track(tmp_path, "tum")["left_out"] == 0
    assert "quaternion is unity" in (tmp_path / "track.tum").read_text().splitlines()[0]
    measured = [row.up_m for row in read_track(tmp_path / "track.csv") if row.fixed]
    assert tum(tmp_path / "track.tum")[1][:, 2] == pytest.approx(measured, abs=1e-3)


def test_heights_are_above_the_sea_where_the_surface_says_so(finished, tmp_path):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    assert "<ele>" not in Path(export_track(finished, "gpx")["file"]).read_text()
    summary = json.loads((tmp_path / "summary.json").read_text())
    summary["settings"]["surface_datum"] = "EGM96 height"
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    text = Path(export_track(tmp_path, "gpx")["file"]).read_text()
    measured = [row.up_m for row in read_track(tmp_path / "track.csv") if row.up_m is not None]
    assert [float(each) for each in re.findall("<ele>(.+)</ele>", text)] == pytest.approx(measured, abs=1e-3)
