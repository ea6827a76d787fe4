"""Miniatures of the data sets, made with the simulator, become flights that are followed to their truth."""

import csv
import sys

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from bench import datasets
from scenematch import FlightFiles, TrackSettings, track
from scenematch.files.telemetry import read_telemetry
from scenematch.files.truth import read_truth
from scenematch.simulator import plan_flight
from tests.support.towns import drawn_town

pytestmark = pytest.mark.usefixtures("bare_runs")


@pytest.fixture(scope="module")
def taken():
    """Four frames of a flight that is under way, with their truth."""
    plan = plan_flight(town=drawn_town(), frames=7)
    return list(zip(list(plan.iter_frames())[-4:], plan.truth_rows()[-4:], strict=True))


@pytest.fixture(scope="module")
def in_degrees(flight):
    """The town's map on an even grid of latitude and longitude, with its west, south, east and north."""
    grid = {"crs": "EPSG:4326", "resampling": Resampling.cubic}
    with rasterio.open(flight / "map.tif") as own, WarpedVRT(own, **grid) as warped:
        return np.moveaxis(warped.read([1, 2, 3]), 0, 2), tuple(warped.bounds)


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(image)).save(path, quality=95)


def table(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(rows)


def made(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["datasets", *map(str, arguments)])
    datasets.main()
    return capsys.readouterr().out


def uav_visloc(root, in_degrees, taken, *, cut=None):
    picture, (west, south, east, north) = in_degrees
    rows = [["num", "filename", "date", "lat", "lon", "height", "Omega", "Kappa", "Phi1", "Phi2"]]
    for k, (frame, true) in enumerate(taken):
        name = f"03_{k + 1:04d}.JPG"
        save(root / "03" / "drone" / name, frame.image)
        pose = [true.lat_deg, true.lon_deg, frame.height_agl_m, frame.pitch_deg, frame.roll_deg, frame.heading_deg]
        rows.append([k + 1, name, f"2018-07-21T03:04:{5 + k:02d}.500000", *pose, 0.0])
    table(root / "03" / "03.csv", rows)
    header = ["mapname", "LT_lat_map", "LT_lon_map", "RB_lat_map", "RB_lon_map", "region"]
    edges = ["satellite03.tif", north, west, south, east, "Town"]
    table(root / "satellite_ coordinates_range.csv", [header, ["satellite04.tif", 1, 0, 0, 1, "Sea"], edges])
    if cut is None:
        save(root / "03" / "satellite03.tif", picture)
        return
    for i, part in enumerate(np.split(picture, [cut[0]], axis=0)):
        for j, piece in enumerate(np.split(part, [cut[1]], axis=1)):
            save(root / "03" / f"satellite03_{i + 1:02d}-{j + 1:02d}.tif", piece)


def followed(flight, out, taken):
    summary = track(FlightFiles.in_folder(flight), out, TrackSettings(method="ncc"), report=False)
    assert summary["fixes"] == summary["scored_fixes"] == len(taken)
    assert summary["max_m"] < 3.0  # without a surface model roofs lean
    for row, (_, true) in zip(read_truth(flight / "truth.csv"), taken, strict=True):
        assert (row.lat_deg, row.lon_deg) == pytest.approx((true.lat_deg, true.lon_deg), abs=1e-8)


def test_uav_visloc_is_followed_and_its_map_may_be_in_pieces(in_degrees, taken, tmp_path, monkeypatch, capsys):
    maps = {}
    for name, cut in (("whole", None), ("pieces", (301, 217))):
        uav_visloc(tmp_path / name, in_degrees, taken, cut=cut)
        flight = tmp_path / f"{name}-flight"
        said = made(monkeypatch, capsys, "uav-visloc", tmp_path / name, "--part=03", "--hfov-deg=60",
                    "--height-is=agl", f"--out={flight}")  # fmt: skip
        assert "4 of 4 photographs" in said
        with rasterio.open(flight / "map.tif") as file:
            maps[name] = (file.read([1, 2, 3]), file.dataset_mask(), tuple(file.bounds))
    np.testing.assert_array_equal(maps["whole"][0], np.moveaxis(in_degrees[0], 2, 0))
    np.testing.assert_array_equal(maps["whole"][0], maps["pieces"][0])
    assert (maps["pieces"][1] == 255).all()
    assert maps["whole"][2] == pytest.approx(maps["pieces"][2], abs=1e-9)
    rows = read_telemetry(tmp_path / "whole-flight" / "telemetry.csv")
    assert rows[0].timestamp_ns == 1532142245_500000000  # taken as UTC
    assert [row.prior is not None for row in rows] == [True, False, False, False]
    followed(tmp_path / "whole-flight", tmp_path / "out", taken)


def test_wildnav_is_followed_on_its_map_of_pictures(in_degrees, taken, tmp_path, monkeypatch, capsys):
    picture, (west, south, east, north) = in_degrees
    query, ground = tmp_path / "assets" / "query", tmp_path / "assets" / "map"
    rows = [["Filename", "Latitude", "Longitude", "Altitude", "Gimball_Roll", "Gimball_Yaw", "Gimball_Pitch"]]
    for k, (frame, true) in enumerate(taken):
        save(query / f"drone_image_{k}.jpg", frame.image)
        angles = [f"{v:+.6f}" for v in (frame.roll_deg, frame.heading_deg, frame.pitch_deg - 90.0)]
        rows.append([f"drone_image_{k}.jpg", true.lat_deg, true.lon_deg, f"{frame.height_agl_m:+.6f}", *angles])
    rows.append(["drone_image_9.jpg", 60.0, 22.0, "+100", "NaN", "NaN", "NaN"])
    table(query / "photo_metadata.csv", rows)
    half, rest = picture.shape[1] // 2 + 40, picture.shape[1] // 2 - 40  # they overlap
    step = (east - west) / picture.shape[1]
    save(ground / "sat_map_00.png", picture[:, :half])
    save(ground / "sat_map_01.png", picture[:, rest:])
    (ground / "map.csv").write_text(
        '"Filename, Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_long"\r'  # as a fork writes it
        f"sat_map_00.png,   {north!r},    {west!r},  {south!r},  {west + step * half!r}\r"
        f"sat_map_01.png,   {north!r},    {west + step * rest!r},  {south!r},  {east!r}\r"
        "sat_map_02.png,   60.5,    22.1,  60.4,  22.2",
        encoding="utf-8",
    )
    command = ["wildnav", tmp_path, "--hfov-deg=60", "--height-is=agl", f"--out={tmp_path / 'flight'}"]
    with pytest.raises(SystemExit, match="interval-s: expected seconds between photographs"):
        made(monkeypatch, capsys, *command)
    assert not (tmp_path / "flight").exists()
    assert "4 of 5 photographs" in made(monkeypatch, capsys, *command, "--interval-s=0.893")
    followed(tmp_path / "flight", tmp_path / "out", taken)
