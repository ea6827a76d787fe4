"""Tracks in other programs' formats, read back by other parsers (gpxpy, GDAL): places, times, gaps."""

import datetime
import io
import json
import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import gpxpy
import numpy as np
import pyogrio
import pytest
from scipy.spatial.transform import Rotation

from engine.errors import TelemetryError
from engine.geo import enu_from_body
from scenematch.cli.app import run
from scenematch.files import export
from scenematch.files.track import TrackRow, with_notes, write_notes, write_track
from tests.support.commands import answer
from tests.support.commands import refusal as refusal_of

T0 = 1_700_000_000_000_000_000  # 2023-11-14 22:13:20 UTC
GPX = "{http://www.topografix.com/GPX/1/1}"


def fix(k, lat_deg=32.5, lon_deg=35.25, *, start_ns=T0, up_m=None, **more):
    return TrackRow(
        timestamp_ns=None if start_ns is None else start_ns + k * 250_000_000, frame=f"<{k}>&.png", status="fix",
        lat_deg=lat_deg + k * 1e-5, lon_deg=lon_deg - k * 2e-5, east_m=1.5 * k, north_m=-0.5 * k, up_m=up_m,
        sigma_east_m=0.25, sigma_north_m=0.5, covariance_en_m2=0.01, score=0.8, method="ncc", **more,
    )  # fmt: skip


def refusal(k):
    return TrackRow(timestamp_ns=T0 + k * 250_000_000, frame=f"{k}.png", status="no_fix", reason="low_score")


RUNS = ([0, 1], [3], [6, 7, 8])
ROWS = [fix(0), fix(1), refusal(2), fix(3), refusal(4), refusal(5), fix(6), fix(7), fix(8)]


def places(ks):
    """(N, 2) longitude and latitude of fixes."""
    return np.array([[ROWS[k].lon_deg, ROWS[k].lat_deg] for k in ks])


def test_the_180th_meridian_ends_a_segment_and_longitudes_stay_on_their_circle():
    rows = [fix(0, lon_deg=179.9999), fix(0, lon_deg=180.0001), fix(0, lon_deg=-179.9998)]
    assert [len(run) for run in export.segments(rows)] == [1, 2]
    points = json.loads(export.to_geojson(rows))["features"][1:]
    assert [p["geometry"]["coordinates"][0] for p in points] == pytest.approx([179.9999, -179.9999, -179.9998])


def test_gpx_has_a_segment_a_run_with_places_times_and_heights_in_the_order_of_the_schema():
    rows = [replace(row, alt_amsl_m=170.0 + 0.125 * k) if row.fixed else row for k, row in enumerate(ROWS)]
    text, begin = export.to_gpx(rows), datetime.datetime.fromtimestamp(T0 / 1e9, datetime.UTC)
    (track,) = gpxpy.parse(text).tracks
    for segment, ks in zip(track.segments, RUNS, strict=True):
        found = np.array([[point.longitude, point.latitude] for point in segment.points])
        assert found == pytest.approx(places(ks), abs=1e-9)
        assert [point.elevation for point in segment.points] == [rows[k].alt_amsl_m for k in ks]
        assert [(point.time - begin).total_seconds() for point in segment.points] == [0.25 * k for k in ks]
        assert [point.name for point in segment.points] == [rows[k].frame for k in ks]
    root = ElementTree.fromstring(text)
    assert (root.tag, root.attrib["version"]) == (f"{GPX}gpx", "1.1")
    named, segment, *_ = root.find(f"{GPX}trk")
    assert named.tag == f"{GPX}name"
    assert [child.tag.removeprefix(GPX) for child in segment[0]] == ["ele", "time", "name"]


def test_gdal_opens_geojson_with_lines_of_two_points_or_more_and_every_fix_with_its_sigma(save):
    path = save(export.to_geojson(ROWS), "track.geojson")
    with warnings.catch_warnings():  # pyogrio's own, of NumPy 2.5
        warnings.filterwarnings("ignore", "The 'generic' unit for NumPy timedelta", DeprecationWarning)
        facts, _, geometries, values = pyogrio.raw.read(path)
    assert facts["crs"] == "EPSG:4326"
    lines, *points = geometries
    assert (lines[1], lines[5]) == (5, 2)  # OGC's multi-line of two: a run of one fix is no line
    assert all(wkb[1] == 1 for wkb in points)
    found = np.array([np.frombuffer(wkb, "<f8", count=2, offset=5) for wkb in points])
    fixes = [k for run in RUNS for k in run]
    assert found == pytest.approx(places(fixes), abs=1e-9)
    fields = {name: column[1:].tolist() for name, column in zip(facts["fields"], values, strict=True)}
    for name in ("frame", "sigma_east_m", "sigma_north_m"):
        assert fields[name] == [getattr(ROWS[k], name) for k in fixes], name
    (only,) = json.loads(export.to_geojson([fix(0)]))["features"]
    assert (only["geometry"]["type"], only["properties"]["timestamp_ns"]) == ("Point", T0)


def test_tum_keeps_every_nanosecond_and_says_what_is_not_known():
    rows = [fix(0, start_ns=T0 + 1), refusal(1), fix(2, start_ns=-600_000_000), fix(0, start_ns=5)]
    head, *lines = export.to_tum(rows).splitlines()
    assert head.startswith("#")
    assert "quaternion is unity" in head
    assert "z is 0" in head
    assert lines == [
        "1700000000.000000001 0.0000 0.0000 0.0000 0 0 0 1",
        "-0.100000000 3.0000 -1.0000 0.0000 0 0 0 1",
        "0.000000005 0.0000 0.0000 0.0000 0 0 0 1",
    ]
    with pytest.raises(TelemetryError, match="timestamp_ns: expected a stamp for the format tum"):
        export.to_tum([fix(0, start_ns=None)])


def test_tum_has_whole_poses_and_leaves_out_what_is_none():
    angles = [(1.0, -2.0, 0.0), (10.0, 20.0, 359.5), (-3.0, 4.0, 181.0)]
    names = ("roll_deg", "pitch_deg", "heading_deg")
    whole = [fix(k, up_m=150.0 + k, **dict(zip(names, angles[k], strict=True))) for k in range(3)]
    flat, level = fix(3, heading_deg=90.0), fix(4, up_m=150.0)
    text = export.to_tum([*whole, flat, refusal(9), level])
    assert "not known" not in text
    table = np.loadtxt(io.StringIO(text))
    assert table[:, 3].tolist() == [150.0, 151.0, 152.0]
    assert table[:, 1:3] == pytest.approx(np.array([[row.east_m, row.north_m] for row in whole]))
    body_frd = Rotation.from_quat(table[:, 4:]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    for turn, roll_pitch_heading in zip(body_frd, angles, strict=True):
        assert turn == pytest.approx(enu_from_body(*roll_pitch_heading), abs=1e-8)
    # Without any attitude a height is still a reason to leave the others out, never a z of 0 among 150.
    assert np.loadtxt(io.StringIO(export.to_tum([flat, level])), ndmin=2)[:, 3].tolist() == [150.0]


def test_notes_complete_the_pose_of_a_fix(tmp_path):
    known = {"heading_deg": 12.5, "roll_deg": -1.0, "pitch_deg": 2.0, "sigma_up_m": 0.3}
    write_notes(tmp_path / "notes.csv", [replace(row, state="tracking", **known) for row in ROWS[:2]])
    rows = with_notes(ROWS[:4], tmp_path / "notes.csv")
    assert [export.angles_deg(row) for row in rows] == [(-1.0, 2.0, 12.5)] * 2 + [None] * 2
    point = json.loads(export.to_geojson(rows))["features"][1]["properties"]
    assert {name: point[name] for name in known} == known
    assert json.loads(export.to_geojson(rows))["features"][-1]["properties"]["sigma_up_m"] is None


def test_times_of_day_are_left_out_without_utc():
    assert "<time>" not in export.to_gpx([fix(0, start_ns=12_000_000_000), fix(0, start_ns=None)])


@pytest.mark.parametrize("kind", export.WRITERS)
def test_the_command_writes_each_format_and_replaces_only_when_told(kind, tmp_path, capfd):
    write_track(tmp_path / "track.csv", ROWS)
    arguments, written = ["export", str(tmp_path), "--format", kind], tmp_path / f"track.{kind}"
    stated = answer(capfd, arguments)
    assert (stated["fixes"], stated["segments"]) == (6, 3)
    written.write_text("mine")
    assert "exists; choose another file, or add --force" in refusal_of(capfd, arguments)
    assert written.read_text() == "mine"
    assert run([*arguments, "--force"]) == 0
    assert written.stat().st_size > 100


def test_the_truth_comes_at_the_moments_of_the_fixes_that_it_covers(tmp_path, capfd):
    write_track(tmp_path / "track.csv", ROWS)
    settings = {
        "map": "m.tif", "surface": None, "truth": None, "method": "ncc", "profile": "engine", "ground_m": 5.0,
        "ground_amsl_m": 20.0, "origin": {"lat_deg": 32.5, "lon_deg": 35.25},
    }  # fmt: skip
    (tmp_path / "summary.json").write_text(json.dumps({"settings": settings}))
    truth = tmp_path / "t.csv"
    begin, end = (f"{T0 + ms * 10**6},32.5,35.25,{170 + ms / 1000},0,0,90" for ms in (0, 1600))
    header = "timestamp_ns,lat_deg,lon_deg,alt_amsl_m,roll_deg,pitch_deg,heading_deg"
    truth.write_text("\n".join([header, begin, end, ""]))
    arguments = ["export", str(tmp_path), "--format", "tum", "--truth", str(truth)]
    assert run(arguments) == 0
    # Above the ground of 20 - 5 m, and heading east is the identity of forward, left, up.
    lines = [f"{T0 // 10**9 + t:.9f} 0.0000 0.0000 {155 + t:.4f} 0 0 0 1" for t in (0.0, 0.25, 0.75, 1.5)]
    assert [line.replace("-0.0", "0.0") for line in (tmp_path / "truth.tum").read_text().splitlines()[1:]] == lines
    capfd.readouterr()
    assert "truth.tum exists" in refusal_of(capfd, arguments)
    truth.write_text("timestamp_ns,lat_deg,lon_deg\n1,32.5,35.25\n2,32.5,35.25\n")
    assert "expected the truth at the moment of a fix, got none" in refusal_of(capfd, [*arguments, "--force"], 1)


def test_the_command_refuses_in_one_line(tmp_path, capfd):
    export_gpx = ["export", tmp_path, "--format=gpx"]
    assert "no such file" in refusal_of(capfd, export_gpx, 1)
    write_track(tmp_path / "track.csv", [refusal(0)])
    assert "expected a track with a fix, got 1 rows without" in refusal_of(capfd, export_gpx, 1)
    line = refusal_of(capfd, [*export_gpx, "--format=shp"])
    assert line.startswith("--format: expected one of gpx, geojson, tum")
    write_track(tmp_path / "track.csv", ROWS)
    out = tmp_path / "none" / "x.gpx"
    assert "cannot be written" in refusal_of(capfd, [*export_gpx, f"--out={out}"], 1)
