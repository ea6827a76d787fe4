"""Exported tracks opened by the libraries that people open them with: gpxpy, and GDAL by pyogrio."""

import datetime
import warnings

import numpy as np
import pytest

from scenematch.files import export
from scenematch.files.export import PoseRow

T0 = 1_700_000_000_000_000_000  # 2023-11-14 22:13:20 UTC


def row(k, **more):
    """A fix every quarter of a second, south of the equator and west of Greenwich."""
    return PoseRow(
        timestamp_ns=T0 + k * 250_000_000, frame=f"<{k}>&.png", status="fix", lat_deg=-32.5 + k * 1e-5,
        lon_deg=-35.25 - k * 2e-5, east_m=1.5 * k, north_m=-0.5 * k, up_m=150.0, alt_amsl_m=170.0 + 0.125 * k,
        sigma_east_m=0.25, sigma_north_m=0.5, covariance_en_m2=0.01, score=0.8, method="ncc", **more,
    )  # fmt: skip


FIXES = {k: row(k) for k in (0, 1, 3, 6, 7, 8)}
RUNS = ((0, 1), (3,), (6, 7, 8))
REFUSED = PoseRow(timestamp_ns=None, frame="x.png", status="no_fix", reason="low_score")
ROWS = [FIXES.get(k, REFUSED) for k in range(9)]


def moment(k):
    return datetime.datetime.fromtimestamp(T0 / 1e9, datetime.UTC) + datetime.timedelta(milliseconds=250 * k)


def places(ks):
    """(N, 2) longitude and latitude of fixes."""
    return np.array([[FIXES[k].lon_deg, FIXES[k].lat_deg] for k in ks])


def test_gpxpy_finds_a_segment_a_run_with_its_places_times_and_heights():
    gpxpy = pytest.importorskip("gpxpy", reason="gpxpy is not installed")
    (track,) = gpxpy.parse(export.to_gpx(ROWS)).tracks
    assert len(track.segments) == len(RUNS)
    for segment, ks in zip(track.segments, RUNS, strict=True):
        found = np.array([[point.longitude, point.latitude] for point in segment.points])
        assert found == pytest.approx(places(ks), abs=1e-9)
        assert [point.elevation for point in segment.points] == [FIXES[k].alt_amsl_m for k in ks]
        assert [point.time for point in segment.points] == [moment(k) for k in ks]


def points_of(geometries):
    """(N, 2) of points in WKB, with a height or without."""
    return np.array([np.frombuffer(wkb, "<f8", count=2, offset=5) for wkb in geometries])


def gdal_layer(path, layer=None):
    """Geometries and fields of a vector file, by GDAL."""
    pyogrio = pytest.importorskip("pyogrio", reason="pyogrio is not installed")
    with warnings.catch_warnings():  # pyogrio's own, of NumPy 2.5
        warnings.filterwarnings("ignore", "The 'generic' unit for NumPy timedelta", DeprecationWarning)
        facts, _, geometries, values = pyogrio.raw.read(path, layer=layer)
    return facts, geometries, dict(zip(facts["fields"], values, strict=True))


def test_gdal_opens_geojson_with_every_fix_and_its_sigma(tmp_path):
    path = tmp_path / "track.geojson"
    path.write_text(export.to_geojson(ROWS), encoding="utf-8")
    facts, geometries, fields = gdal_layer(path)
    is_point = np.array([wkb[1] == 1 for wkb in geometries])  # OGC's type codes: 1 a point, 5 a multi-line
    assert facts["crs"] == "EPSG:4326"
    assert points_of(geometries[is_point]) == pytest.approx(places(FIXES), abs=1e-9)
    assert fields["frame"][is_point].tolist() == [fix.frame for fix in FIXES.values()]
    assert fields["sigma_east_m"][is_point].tolist() == [0.25] * len(FIXES)
    (lines,) = geometries[~is_point]
    assert (lines[1], lines[5]) == (5, 2)  # a run of one fix is no line


def test_gdal_opens_gpx_with_the_points_in_their_segments(tmp_path):
    path = tmp_path / "track.gpx"
    path.write_text(export.to_gpx(ROWS), encoding="utf-8")
    _, geometries, fields = gdal_layer(path, "track_points")
    assert points_of(geometries) == pytest.approx(places(FIXES), abs=1e-9)
    assert fields["track_seg_id"].tolist() == [run for run, ks in enumerate(RUNS) for _ in ks]
    assert fields["ele"].tolist() == [fix.alt_amsl_m for fix in FIXES.values()]
