"""Published data sets: miniatures of their layouts become flights that are followed; bad truth is flagged."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from PIL import Image
from pyproj import Transformer
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.warp import reproject

from engine import Camera
from engine.errors import TelemetryError
from engine.geo import LocalFrame, ecef_from_geodetic, enu_from_body
from engine.maps.rasters import open_source
from engine.values import Attitude, Truth
from scenematch.cli.app import run
from scenematch.files.datasets.alto import EPSG
from scenematch.files.datasets.mosaic import Mosaic, MosaicTile, write_mosaic
from scenematch.files.datasets.ortholoc import find_ortholoc, read_ortholoc
from scenematch.files.geotiff import write_geotiff
from scenematch.files.telemetry import TelemetryRow, read_telemetry
from scenematch.files.truth import read_truth
from scenematch.files.truth_checks import check_truth
from scenematch.report.published import PUBLISHED, published_cells
from scenematch.runs.campaign_plan import RecordedFlight, plan_campaign
from scenematch.runs.dataset_import import check_flight
from scenematch.runs.settings import TrackSettings
from scenematch.runs.tracking import track
from scenematch.simulator import picture_at, plan_flight
from tests.support.paths import ROOT
from tests.support.towns import drawn_town

pytestmark = pytest.mark.usefixtures("bare_runs")
CAMERA = Camera.from_fov(300, 300, 60.0)  # the simulated flights'
GROUND_M = 120.0  # level of the miniatures' ground, above whatever their heights are counted from


@pytest.fixture(scope="module")
def plan():
    """Four frames of a flight that is under way."""
    return plan_flight(town=drawn_town(), frames=12)


@pytest.fixture(scope="module")
def frames(plan):
    return list(plan.iter_frames())[-4:]


@pytest.fixture(scope="module")
def truth(plan):
    return plan.truth_rows()[-4:]


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(image)).save(path, quality=95)


def table(path, header, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([header, *rows])


@pytest.fixture(scope="module")
def in_degrees(plan):
    """The town's map on an even grid of latitude and longitude, with its west, south, east and north."""
    town = plan.town
    rows, columns = town.ortho.shape[:2]
    matrix = town.pixel_to_crs.copy()
    matrix[:, 2] -= 0.5 * matrix[:, :2].sum(axis=1)
    own, crs = Affine(*matrix.ravel()), f"EPSG:{town.crs_epsg}"
    corners = np.array([[0, 0, 1], [columns, 0, 1], [0, rows, 1], [columns, rows, 1]]) @ matrix.T
    lon, lat = Transformer.from_crs(crs, 4326, always_xy=True).transform(*corners.T)
    west, south, east, north = lon.min(), lat.min(), lon.max(), lat.max()
    step = (north - south) / rows  # the same in both directions, as the data set's are
    width = int((east - west) / step)
    picture = np.zeros((3, rows, width), np.uint8)
    reproject(
        np.moveaxis(town.ortho, 2, 0), picture, src_transform=own, src_crs=crs,
        dst_transform=Affine(step, 0.0, west, 0.0, -step, north), dst_crs="EPSG:4326", resampling=Resampling.cubic,
    )  # fmt: skip
    return np.moveaxis(picture, 0, 2), tuple(float(v) for v in (west, south, west + step * width, north))


def followed(flight, tmp_path, frames, truth, *, method="ncc"):
    """Every frame of the flight has a fix where the town's truth is."""
    files = RecordedFlight(surface=None).files("flight", flight)
    summary = track(files, tmp_path / "out", TrackSettings(method=method), report=False)
    assert summary["fixes"] == summary["scored_fixes"] == len(frames)
    assert summary["max_m"] < 3.0  # without a surface model roofs lean
    stated = read_truth(flight / "truth.csv")
    frame = LocalFrame(stated[0].lat_deg, stated[0].lon_deg)
    assert len(stated) == len(truth)
    return frame, stated


def sequence(root, in_degrees, frames, truth, *, pieces=None, columns=10):
    """UAV-VisLoc's layout; the map in one file or in rows and columns of several."""
    picture, (west, south, east, north) = in_degrees
    header = ["num", "filename", "date", "lat", "lon", "height", "Omega", "Kappa", "Phi1", "Phi2"][:columns]
    rows = []
    for k, (frame, true) in enumerate(zip(frames, truth, strict=True)):
        name = f"03_{k + 1:04d}.JPG"
        save(root / "03" / "drone" / name, frame.image)
        date = f"2018-07-21T03:04:{5 + k:02d}.500000"
        values = [k + 1, name, date, true.lat_deg, true.lon_deg, frame.height_agl_m]
        rows.append([*values, frame.pitch_deg, frame.roll_deg, frame.heading_deg, 0.0][:columns])
    table(root / "03" / "03.csv", header, rows)
    edges = [("satellite03.tif", north, west, south, east, "Town"), ("satellite04.tif", 1, 0, 0, 1, "Sea")]
    header = ["mapname", "LT_lat_map", "LT_lon_map", "RB_lat_map", "RB_lon_map", "region"]
    table(root / "satellite_ coordinates_range.csv", header, edges)
    if pieces is None:
        save(root / "03" / "satellite03.tif", picture)
        return
    at_row, at_column = pieces
    for i, part in enumerate(np.split(picture, [at_row], axis=0)):
        for j, piece in enumerate(np.split(part, [at_column], axis=1)):
            save(root / "03" / f"satellite03_{i + 1:02d}-{j + 1:02d}.tif", piece)


def test_uav_visloc_is_followed_where_it_says_that_it_was(in_degrees, frames, truth, tmp_path, capsys):
    root, flight = tmp_path / "data", tmp_path / "flight"
    sequence(root, in_degrees, frames, truth)
    command = ["dataset", "import", "uav-visloc", str(root), "--part=03", f"--out={flight}", "--hfov-deg=60"]
    assert run([*command, "--height-is=agl", "--json"]) == 0
    said = capsys.readouterr()
    facts = json.loads(said.out)
    assert (facts["dataset"], facts["part"], facts["frames"], facts["findings"]) == ("UAV-VisLoc", "03", 4, [])
    assert "24 to 48 m" in said.err
    _, stated = followed(flight, tmp_path, frames, truth)
    for row, true in zip(stated, truth, strict=True):
        assert (row.lat_deg, row.lon_deg) == pytest.approx((true.lat_deg, true.lon_deg), abs=1e-8)
    rows = read_telemetry(flight / "telemetry.csv")
    assert rows[0].timestamp_ns == 1532142245_500000000  # taken as UTC
    assert [row.timestamp_ns - rows[0].timestamp_ns for row in rows] == [0, 10**9, 2 * 10**9, 3 * 10**9]
    assert rows[0].prior is not None
    assert all(row.prior is None for row in rows[1:])
    assert (flight / "frames" / "03_0001.JPG").is_symlink()

    assert run(command) == 2
    assert "--force" in capsys.readouterr().err
    assert run([*command, "--force"]) == 0
    assert "the authors do not say what they are counted from" in capsys.readouterr().err
    assert read_telemetry(flight / "telemetry.csv")[0].height_agl_m is None


def test_uav_visloc_in_pieces_is_the_same_map_and_a_sequence_may_lack_its_attitude(
    in_degrees, frames, truth, tmp_path, capsys
):
    maps = {}
    for name, more in (("whole", {}), ("cut", {"pieces": (301, 217), "columns": 6})):
        sequence(tmp_path / name, in_degrees, frames, truth, **more)
        command = ["dataset", "import", "uav-visloc", str(tmp_path / name), "--part=03", "--hfov-deg=60"]
        assert run([*command, f"--out={tmp_path / 'flights' / name}", "--height-is=amsl", "--ground-m=20"]) == 0
        with rasterio.open(tmp_path / "flights" / name / "map.tif") as file:
            maps[name] = (file.read(), tuple(file.bounds), file.dataset_mask())
    assert np.array_equal(maps["whole"][0], maps["cut"][0])
    assert maps["whole"][1] == pytest.approx(maps["cut"][1], abs=1e-9)
    assert np.array_equal(maps["whole"][0], np.moveaxis(in_degrees[0], 2, 0))
    assert (maps["cut"][2] == 255).all()
    stated = capsys.readouterr().err
    assert "this sequence has no attitude" in stated
    assert "4 of 4 rows have no heading" in stated
    row = read_telemetry(tmp_path / "flights" / "cut" / "telemetry.csv")[0]
    assert row.alt_amsl_m - row.height_agl_m == pytest.approx(20.0)


def test_uav_visloc_says_where_the_maps_own_georeference_disagrees(in_degrees, frames, truth, tmp_path, capsys):
    sequence(tmp_path, in_degrees, frames, truth)
    picture, (west, south, _, north) = in_degrees
    step = (north - south) / picture.shape[0]
    shifted = Affine(step, 0.0, west, 0.0, -step, north + 1e-4)
    profile = {
        "driver": "GTiff",
        "count": 3,
        "dtype": "uint8",
        "height": picture.shape[0],
        "width": picture.shape[1],
    }
    whole, crs = tmp_path / "03" / "satellite03.tif", rasterio.CRS.from_epsg(4326)
    with rasterio.open(whole, "w", crs=crs, transform=shifted, **profile) as file:
        file.write(np.moveaxis(picture, 2, 0))
    command = ["dataset", "import", "uav-visloc", str(tmp_path), "--part=03", "--hfov-deg=60"]
    assert run([*command, f"--out={tmp_path / 'flight'}", "--height-is=agl"]) == 0
    assert "georeference of satellite03.tif is up to 11 m off its published range" in capsys.readouterr().err
    with rasterio.open(tmp_path / "flight" / "map.tif") as file:
        assert file.bounds.top == pytest.approx(north, abs=1e-9)


@pytest.mark.slow
def test_wildnav_is_followed_on_its_map_of_pictures(in_degrees, frames, truth, tmp_path, capsys):
    picture, (west, south, east, north) = in_degrees
    query, there = tmp_path / "assets" / "query", tmp_path / "assets" / "map"
    gimbal = ["Gimball_Roll", "Gimball_Yaw", "Gimball_Pitch", "Flight_Roll", "Flight_Yaw", "Flight_Pitch"]
    rows = []
    for k, (frame, true) in enumerate(zip(frames, truth, strict=True)):
        save(query / f"drone_image_{k}.jpg", frame.image)
        signed = [f"{value:+.6f}" for value in (frame.height_agl_m, frame.roll_deg, frame.heading_deg)]
        pitch = f"{frame.pitch_deg - 90.0:+.6f}"
        rows.append([f"drone_image_{k}.jpg", true.lat_deg, true.lon_deg, *signed, pitch, "NaN", "NaN", "NaN"])
    rows.append(["drone_image_9.jpg", 60.0, 22.0, "+100", "NaN", "NaN", "NaN", "NaN", "NaN", "NaN"])
    table(query / "photo_metadata.csv", ["Filename", "Latitude", "Longitude", "Altitude", *gimbal], rows)
    half, rest = picture.shape[1] // 2 + 40, picture.shape[1] // 2 - 40  # they overlap
    step = (east - west) / picture.shape[1]
    save(there / "sat_map_00.png", picture[:, :half])
    save(there / "sat_map_01.png", picture[:, rest:])
    lines = ["Filename, Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_long"]
    lines += [f'"sat_map_00.png",   {north!r},    {west!r},  {south!r},  {west + step * half!r}']
    lines += [f'"sat_map_01.png",   {north!r},    {west + step * rest!r},  {south!r},  {east!r}']
    lines += ['"sat_map_02.png",   60.5,    22.1,  60.4,  22.2']
    (there / "map.csv").write_text("\n".join(lines), encoding="utf-8")

    flight = tmp_path / "flight"
    command = [
        "dataset",
        "import",
        "wildnav",
        str(tmp_path),
        f"--out={flight}",
        "--hfov-deg=60",
        "--height-is=agl",
    ]
    assert run(command) == 2
    assert "--interval-s: expected seconds between pictures" in capsys.readouterr().err
    assert not flight.exists()
    assert run([*command, "--interval-s=0.893"]) == 0
    stated = capsys.readouterr().err
    assert "1 of 5 pictures are missing" in stated
    assert "1 of 3 pictures of the map are missing" in stated
    followed(flight, tmp_path, frames, truth)


def test_wildnavs_own_map_builder_quotes_its_header_and_its_pictures_have_palettes(tmp_path):
    """As a fork's repository has them: one cell as the header, lines that end in CR, PNG with a colour table."""
    colours = np.random.default_rng(2).integers(0, 255, (16, 3), dtype=np.uint8)
    indices = np.random.default_rng(3).integers(0, 16, (40, 40), dtype=np.uint8)
    there, query = tmp_path / "assets" / "map", tmp_path / "assets" / "query"
    there.mkdir(parents=True)
    picture = Image.fromarray(indices, "P")
    picture.putpalette(colours.tobytes())
    picture.save(there / "sat_patch_0000.png")
    save(query / "drone_image_1.jpg", np.zeros((30, 40, 3), np.uint8))
    header = '"Filename, Top_left_lat,Top_left_lon,Bottom_right_lat,Bottom_right_long"'
    (there / "map.csv").write_bytes(f"{header}\rsat_patch_0000.png,60.41,22.46,60.40,22.47\r".encode())
    names = "Filename,Latitude,Longitude,Altitude,Gimball_Roll,Gimball_Yaw,Gimball_Pitch"
    (query / "photo_metadata.csv").write_text(f"{names}\ndrone_image_1.jpg,60.405,22.465,+120,+0.00,-4.70,-90.30")
    command = ["dataset", "import", "wildnav", str(tmp_path), f"--out={tmp_path / 'flight'}", "--hfov-deg=60"]
    assert run([*command, "--height-is=agl", "--interval-s=1"]) == 0
    with rasterio.open(tmp_path / "flight" / "map.tif") as file:
        assert np.array_equal(np.moveaxis(file.read(), 0, 2), colours[indices])


def test_vpair_is_followed_on_the_users_map(plan, frames, truth, tmp_path, capsys):
    write_geotiff(tmp_path / "town.tif", plan.town.ortho, plan.town.pixel_to_crs, plan.town.crs_epsg)
    rows = []
    for k, (frame, true) in enumerate(zip(frames, truth, strict=True)):
        save(tmp_path / "queries" / f"{k + 1:05d}.png", frame.image)
        place = ecef_from_geodetic(true.lat_deg, true.lon_deg, frame.height_agl_m + GROUND_M + 47.5)
        angles = [
            math.radians(v) for v in (frame.roll_deg, frame.pitch_deg, (frame.heading_deg + 180) % 360 - 180)
        ]
        rows.append([f"queries/{k + 1:05d}.png", *(repr(float(v)) for v in place), 47.5, *angles])
    table(tmp_path / "poses_query.txt", ["filepath", "x", "y", "z", "undulation", "roll", "pitch", "yaw"], rows)
    flight = tmp_path / "flight"
    command = [
        "dataset",
        "import",
        "vpair",
        str(tmp_path),
        f"--out={flight}",
        "--hfov-deg=60",
        "--interval-s=0.893",
    ]
    assert run(command) == 2
    assert "--map: expected a map, since the data set has none" in capsys.readouterr().err
    assert run([*command, f"--map={tmp_path / 'town.tif'}", f"--ground-m={GROUND_M}"]) == 0
    _, stated = followed(flight, tmp_path, frames, truth)
    for row, frame in zip(stated, frames, strict=True):
        assert row.alt_amsl_m == pytest.approx(frame.height_agl_m + GROUND_M, abs=1e-3)
        assert row.height_agl_m == pytest.approx(frame.height_agl_m, abs=1e-3)


def quaternion(matrix):
    """Of a rotation with a trace above -1, scalar last."""
    w = 0.5 * math.sqrt(1.0 + np.trace(matrix))
    return [(matrix[2, 1] - matrix[1, 2]) / (4 * w), (matrix[0, 2] - matrix[2, 0]) / (4 * w), (matrix[1, 0] - matrix[0, 1]) / (4 * w), w]  # fmt: skip  # noqa: E501


@pytest.mark.slow
def test_alto_is_followed_on_the_map_of_its_aerial_pictures(plan, frames, truth, tmp_path, capsys):
    """The town's coordinates count as those of ALTO's zone: as far from its meridian, as far from the equator."""
    town, val = plan.town, tmp_path / "Val"
    own = Transformer.from_crs(4326, town.crs_epsg, always_xy=True)
    zone = Transformer.from_crs(EPSG, 4326, always_xy=True)
    rows = []
    for k, (frame, true) in enumerate(zip(frames, truth, strict=True)):
        # The picture's right points to the nose there.
        save(val / "query_images" / f"{k:06d}.png", np.rot90(frame.image, -1))
        easting, northing = own.transform(true.lon_deg, true.lat_deg)
        lon, lat = zone.transform(easting, northing)
        body = enu_from_body(frame.roll_deg, frame.pitch_deg, frame.heading_deg)
        turn = quaternion(LocalFrame(lat, lon).enu_from_ecef.T @ body)
        rows.append([easting, northing, frame.height_agl_m + GROUND_M, *turn, f"{k:06d}.png"])
    header = ["easting", "northing", "altitude", "orient_x", "orient_y", "orient_z", "orient_w", "name"]
    table(val / "query.csv", header, rows)
    gsd_m, rows = town.gsd_m_per_px, []
    for k, left in enumerate(range(0, town.ortho.shape[1] - 200, 90)):
        name = f"offset_0_None/{k:06d}.png"
        piece = town.ortho[:, left : left + 300]
        save(val / "reference_images" / name, piece)
        middle = (left + (piece.shape[1] - 1) / 2, (piece.shape[0] - 1) / 2, 1.0)
        rows.append([*(town.pixel_to_crs @ middle), name])
    table(val / "reference.csv", ["easting", "northing", "name"], rows)
    flight = tmp_path / "flight"
    command = ["dataset", "import", "alto", str(tmp_path), f"--out={flight}", "--part=Val", "--hfov-deg=60"]
    assert run([*command, f"--gsd-m={gsd_m}", f"--ground-m={GROUND_M}", "--interval-s=0.893"]) == 0
    assert "the picture's right points to the nose" in capsys.readouterr().err
    followed(flight, tmp_path, frames, truth)
    for row, frame in zip(read_telemetry(flight / "telemetry.csv"), frames, strict=True):
        stated = (row.roll_deg, row.pitch_deg, row.heading_deg, row.height_agl_m)
        assert stated == pytest.approx(
            (frame.roll_deg, frame.pitch_deg, frame.heading_deg % 360, frame.height_agl_m), abs=2e-3
        )


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["mars", "."], 2, "NAME: expected one of uav-visloc, wildnav, vpair, alto, got 'mars'"),
        (["uav-visloc", "."], 2, "--part: expected one with uav-visloc"),
        (["vpair", ".", "--part=1"], 2, "--part: expected none with vpair, got 1"),
        (["vpair", ".", "--gsd-m=1"], 2, "--gsd-m: expected with alto only"),
        (["vpair", ".", "--height-is=sea"], 2, "--height-is: expected one of agl, amsl, ellipsoid, got 'sea'"),
        (["vpair", ".", "--camera=c.yaml"], 2, "--camera, --hfov-deg: expected one of the two"),
        (["vpair", ".", "--interval-s=inf"], 2, "--interval-s: expected 0.001 to 86400 seconds, got inf"),
        (["vpair", ".", "--interval-s=1e-12"], 2, "--interval-s: expected 0.001 to 86400 seconds, got 1e-12"),
        (["vpair", ".", "--interval-s=1e10"], 2, "--interval-s: expected 0.001 to 86400 seconds, got 1e+10"),
        (["vpair", ".", "--ground-m=nan"], 2, "--ground-m: expected -10000 to 10000 metres, got nan"),
        (["vpair", ".", "--ground-m=inf"], 2, "--ground-m: expected -10000 to 10000 metres, got inf"),
        (["vpair", ".", "--hfov-deg=0"], 2, "--hfov-deg: expected 0.1 to 179 degrees, got 0"),
        (["vpair", ".", "--hfov-deg=180"], 2, "--hfov-deg: expected 0.1 to 179 degrees, got 180"),
        (["vpair", ".", "--hfov-deg=nan"], 2, "--hfov-deg: expected 0.1 to 179 degrees, got nan"),
        (["alto", ".", "--part=Val", "--gsd-m=inf"], 2, "--gsd-m: expected 0.001 to 100 metres, got inf"),
        (["vpair", "nowhere"], 1, "nowhere/poses_query.txt: no such file"),
        (["uav-visloc", "nowhere", "--part=03"], 1, "nowhere/03/03.csv: no such file"),
    ],
)
def test_what_cannot_be_imported_is_said_in_one_line(arguments, code, message, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(["dataset", "import", "--hfov-deg=60", *arguments, f"--out={out}"]) == code
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_heights_that_are_not_above_the_ground_are_left_out_and_told(in_degrees, frames, truth, tmp_path, capsys):
    sequence(tmp_path, in_degrees, frames, truth)
    command = ["dataset", "import", "uav-visloc", str(tmp_path), "--part=03", "--hfov-deg=60", "--height-is=amsl"]
    assert run([*command, f"--out={tmp_path / 'flight'}", "--ground-m=9000"]) == 0
    assert "heights of 4 of 4 pictures are left out: they are not above --ground-m" in capsys.readouterr().err
    assert {row.height_agl_m for row in read_telemetry(tmp_path / "flight" / "telemetry.csv")} == {None}


def files_in(folder):
    """Every file with its content, links as what they lead to."""
    return {
        path.relative_to(folder).as_posix(): str(path.readlink()) if path.is_symlink() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_symlink() or path.is_file()
    }


def test_force_never_removes_what_is_read_nor_what_no_import_made(in_degrees, frames, truth, tmp_path, capsys):
    root, flight = tmp_path / "data", tmp_path / "flight"
    sequence(root, in_degrees, frames, truth)
    command = ["dataset", "import", "uav-visloc", str(root), "--part=03", f"--out={flight}", "--force"]
    assert run([*command, "--hfov-deg=60", "--height-is=agl"]) == 0
    (flight / "frames" / "notes.txt").write_text("mine", encoding="utf-8")
    (tmp_path / "link.yaml").symlink_to(flight / "camera.yaml")
    before = files_in(tmp_path)
    capsys.readouterr()
    for option in (
        "camera=flight/camera.yaml",
        "camera=link.yaml",
        "map=flight/map.tif",
        "surface=flight/map.tif",
    ):
        name, _, path = option.partition("=")
        more = [] if name == "camera" else ["--hfov-deg=60"]
        assert run([*command, f"--{name}={tmp_path / path}", *more]) == 2
        assert f"--out: expected a folder without --{name}, whose files it replaces" in capsys.readouterr().err
        assert files_in(tmp_path) == before
    within = ["dataset", "import", "uav-visloc", str(root), "--part=03", "--hfov-deg=60", "--force"]
    for out in (root, tmp_path):
        assert run([*within, f"--out={out}"]) == 2
        assert "--out: expected a folder without DIR" in capsys.readouterr().err
    assert files_in(tmp_path) == before

    assert run([*command, "--hfov-deg=60", "--height-is=agl"]) == 0  # as it was, and the notes stay
    assert files_in(tmp_path) == before


def test_force_leaves_photographs_alone_that_no_import_has_put_there(in_degrees, frames, truth, tmp_path, capsys):
    sequence(tmp_path / "data", in_degrees, frames, truth)
    mine, flight = tmp_path / "flight" / "frames" / "IMG_1.JPG", tmp_path / "flight"
    save(mine, frames[0].image)
    command = ["dataset", "import", "uav-visloc", str(tmp_path / "data"), "--part=03", f"--out={flight}"]
    command += ["--hfov-deg=60", "--force"]
    assert run(command) == 0
    assert mine.is_file()
    # What an import has copied, where a disk has no links, leaves with it.
    copied = flight / "frames" / "03_0001.JPG"
    copied.unlink()
    save(copied, frames[0].image)
    assert run(command) == 0
    assert copied.is_symlink()
    assert mine.is_file()

    (tmp_path / "album").mkdir()
    (tmp_path / "album" / "IMG_2.JPG").symlink_to(mine)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "frames").symlink_to(tmp_path / "album")
    capsys.readouterr()
    assert run([*command, f"--out={tmp_path / 'other'}"]) == 2
    assert "frames to be a folder of its own, got a link to" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "album").iterdir()] == ["IMG_2.JPG"]


def test_stamps_that_repeat_or_go_back_are_left_out_and_told(in_degrees, frames, truth, tmp_path, capsys):
    sequence(tmp_path, in_degrees, frames, truth)
    path = tmp_path / "03" / "03.csv"
    path.write_text(path.read_text().replace("03:04:07", "03:04:06"), encoding="utf-8")
    command = ["dataset", "import", "uav-visloc", str(tmp_path), "--part=03", "--hfov-deg=60", "--height-is=agl"]
    assert run([*command, f"--out={tmp_path / 'flight'}"]) == 0
    assert "1 of 4 stamps repeat or go back, left out" in capsys.readouterr().err
    assert [row.frame for row in read_telemetry(tmp_path / "flight" / "telemetry.csv")] == [
        "03_0001.JPG",
        "03_0002.JPG",
        "03_0004.JPG",
    ]


def test_a_mosaic_of_pieces_of_several_pixels_takes_the_median(tmp_path):
    rng = np.random.default_rng(3)
    fine = np.kron(rng.integers(0, 255, (20, 20, 3), dtype=np.uint8), np.ones((4, 4, 1), np.uint8))
    save(tmp_path / "a.png", fine)
    save(tmp_path / "b.png", fine)
    save(tmp_path / "c.png", fine[::2, ::2])
    pieces = [
        MosaicTile(tmp_path / f"{name}.png", x, 10.0, x + 10.0, 0.0)
        for name, x in (("a", 0), ("b", 10), ("c", 30))
    ]
    write_mosaic(tmp_path / "map.tif", Mosaic(pieces, epsg=32633))
    with rasterio.open(tmp_path / "map.tif") as file:
        assert (file.width, file.height) == (320, 80)
        assert file.transform.a == pytest.approx(0.125)
        mask = file.dataset_mask()
        data = np.moveaxis(file.read(), 0, 2)
    assert np.array_equal(data[:, :80], fine)
    assert np.array_equal(data[:, 80:160], fine)
    assert (mask[:, 160:240] == 0).all()
    assert (mask[:, 240:] == 255).all()
    assert np.abs(data[1::4, 241::4].astype(int) - fine[1::4, 1::4].astype(int)).mean() < 60


# ------------------------------------------------------------------------------------------------ truth


FRAME = LocalFrame(48.25, 15.0)


def honest(count=48, radius_m=400.0):
    """A circle at 20 m/s, 150 m above ground that lies 300 m above the sea, with the heading along it."""
    rows = []
    for k in range(count):
        angle = k * 20.0 / radius_m
        lat, lon = FRAME.geodetic_from_enu(radius_m * math.cos(angle), radius_m * math.sin(angle))
        heading = (-math.degrees(angle)) % 360.0
        rows.append(
            Truth(
                timestamp_ns=k * 10**9,
                lat_deg=float(lat),
                lon_deg=float(lon),
                alt_amsl_m=450.0,
                height_agl_m=150.0,
                heading_deg=heading,
            )
        )
    return rows


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """A map and a surface model of 300 m round the circle."""
    folder = tmp_path_factory.mktemp("ground")
    easting, northing = Transformer.from_crs(4326, 32633, always_xy=True).transform(FRAME.lon_deg, FRAME.lat_deg)
    matrix = np.array([[5.0, 0.0, easting - 500.0], [0.0, -5.0, northing + 500.0]])
    write_geotiff(folder / "map.tif", np.full((201, 201), 128, np.uint8), matrix, 32633)
    write_geotiff(folder / "dsm.tif", np.full((201, 201), 300.0, np.float32), matrix, 32633)
    return {"site": open_source(folder / "map.tif"), "surface": open_source(folder / "dsm.tif", "surface")}


def kinds(truth, ground, rows=()):
    return [finding.kind for finding in check_truth(truth, rows, **ground)]


def test_an_honest_flight_has_no_finding(ground):
    assert kinds(honest(), ground) == []
    assert kinds(honest(), {}) == []


def each(**change):
    return lambda row, k: replace(row, **{name: value(row, k) for name, value in change.items()})


FAULTS = {
    "jump": each(lat_deg=lambda row, k: row.lat_deg + (0.0008 if k == 20 else 0.0)),
    "frozen": None,
    "coarse": each(lat_deg=lambda row, k: round(row.lat_deg, 4), lon_deg=lambda row, k: round(row.lon_deg, 4)),
    "outside": each(lon_deg=lambda row, k: row.lon_deg + 0.004),
}


def broken(kind):
    rows = honest()
    if kind == "frozen":
        return [replace(rows[k - k % 2], timestamp_ns=rows[k].timestamp_ns, heading_deg=rows[k].heading_deg) for k in range(len(rows))]  # fmt: skip  # noqa: E501
    return [FAULTS[kind](row, k) for k, row in enumerate(rows)]


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_of_the_places_is_named(kind, ground):
    assert kinds(broken(kind), ground) == [kind]


@pytest.mark.parametrize(
    ("change", "expected", "words"),
    [
        (each(height_agl_m=lambda row, k: 450.0), ["datum", "datum"], ("above the sea", "the same numbers")),
        (each(height_agl_m=lambda row, k: 195.0), ["datum"], ("+45 m", "geoid")),
        (each(alt_amsl_m=lambda row, k: 150.0), ["datum", "datum", "datum"], ("-150 m above the surface",)),
        (
            each(height_agl_m=lambda row, k: 1.0, alt_amsl_m=lambda row, k: None),
            ["height"],
            ("median height above the ground is 1 m",),
        ),
        (each(heading_deg=lambda row, k: None), ["heading"], ("48 of 48 rows have no heading",)),
        (each(heading_deg=lambda row, k: (-row.heading_deg) % 360.0), ["heading"], ("mirrored",)),
        (
            each(heading_deg=lambda row, k: (row.heading_deg + 90.0) % 360.0),
            ["heading"],
            ("degrees off the course", "throughout"),
        ),
        (each(heading_deg=lambda row, k: (row.heading_deg + 8.0) % 360.0), [], ()),  # wind
    ],
)
def test_a_fault_of_heights_and_headings_is_named(change, expected, words, ground):
    found = check_truth([change(row, k) for k, row in enumerate(honest())], [], **ground)
    assert [finding.kind for finding in found] == expected
    text = " ".join(finding.text for finding in found)
    assert all(word in text for word in words)


def test_without_a_surface_model_a_height_that_follows_the_hills_is_doubted():
    rows = [replace(row, height_agl_m=150.0 + 60.0 * (k % 3), alt_amsl_m=None) for k, row in enumerate(honest())]
    (finding,) = check_truth(rows, [])
    assert finding.kind == "datum"
    assert "over hills" in finding.text


def test_frames_without_truth_are_counted_and_the_telemetrys_heading_is_judged():
    rows = [TelemetryRow(timestamp_ns=k * 10**9, frame=str(k), heading_deg=90.0) for k in (46, 47, 80, 81)]
    found = check_truth(honest(), rows)
    assert [finding.kind for finding in found] == ["unknown"]
    assert "2 of 4 frames have no truth; the first is 80" in found[0].text
    reversed_rows = [
        TelemetryRow(timestamp_ns=row.timestamp_ns, frame=str(k), heading_deg=(row.heading_deg + 180.0) % 360.0)
        for k, row in enumerate(honest())
    ]
    (finding,) = check_truth(honest(), reversed_rows)
    assert "reversed" in finding.text


def test_the_command_says_what_it_finds_and_leaves_with_one(plan, frames, truth, tmp_path, capsys):
    from scenematch.runs.simulation import write_flight

    write_flight(tmp_path, plan)
    assert run(["dataset", "check", str(tmp_path)]) == 0
    assert "nothing found" in capsys.readouterr().out
    assert check_flight(tmp_path) == []
    assert run(["dataset", "check", str(tmp_path), "--max-speed-mps=2", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)[0]["kind"] == "jump"
    (tmp_path / "truth.csv").unlink()
    assert run(["dataset", "check", str(tmp_path)]) == 1
    assert "truth.csv: no such file" in capsys.readouterr().err


def test_the_page_has_the_published_figures_of_the_code():
    page = (ROOT / "docs" / "datasets.md").read_text(encoding="utf-8")
    for dataset, figures in PUBLISHED.items():
        for one in figures:
            *cells, source = published_cells(one)
            assert f"| {dataset} | {' | '.join(cells)} | <{source}> |" in page


# ------------------------------------------------------------------------------------- single photographs


def local_of(plan, truth, origin_m):
    """East, north and up of the camera in metres of the town's grid about an origin."""
    to_grid = Transformer.from_crs(4326, plan.town.crs_epsg, always_xy=True)
    easting, northing = to_grid.transform(truth.lon_deg, truth.lat_deg)
    return np.array([easting - origin_m[0], northing - origin_m[1], truth.alt_amsl_m - plan.town.datum_amsl_m])


def grid_heading_deg(plan, truth):
    """The heading from the grid's north, which stands for the true one where a data set has local metres."""
    to_grid = Transformer.from_crs(4326, plan.town.crs_epsg, always_xy=True)
    a = to_grid.transform(truth.lon_deg, truth.lat_deg)
    b = to_grid.transform(truth.lon_deg, truth.lat_deg + 1e-4)
    return truth.heading_deg + math.degrees(math.atan2(b[0] - a[0], b[1] - a[1]))


def singles_followed(out, count):
    """Each of the flights has a fix by SIFT where it was."""
    found = sorted(path.parent for path in out.glob("*/telemetry.csv"))
    assert len(found) == count
    for flight in found:
        files = RecordedFlight().files(flight.name, flight)
        assert files.map.surface is not None
        for method in ("ncc", "sift"):
            tracks = out / "tracks" / flight.name / method
            summary = track(files, tracks, TrackSettings(method=method), report=False)
            assert summary["fixes"] == summary["scored_fixes"] == 1
            assert summary["max_m"] < 2.0
    return found


@pytest.mark.slow
def test_ortholoc_becomes_flights_of_one_frame_that_are_followed(plan, frames, truth, tmp_path, capsys):
    town = plan.town
    rows, columns = town.surface_m.shape
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    places = np.stack([x, y, np.ones_like(x)], axis=-1) @ town.pixel_to_crs.T
    world = np.concatenate([places, town.surface_m[..., None]], axis=-1)
    world[:40, :40] = np.nan
    for k, tilt_deg in enumerate((0.0, 0.0, 50.0)):
        true = truth[k]
        attitude = (true.roll_deg, true.pitch_deg + tilt_deg, grid_heading_deg(plan, true))
        rotation = (enu_from_body(*attitude) @ CAMERA.mount).T  # camera from world
        centre = local_of(plan, true, (0.0, 0.0))
        np.savez(
            tmp_path / f"L01_R{k:04d}.npz",
            sample_id=f"L01_R{k:04d}",
            image_query=frames[k].image,
            image_dop=town.ortho,
            dsm=world,
            scale=np.array([1.0, -1.0]),
            intrinsics=CAMERA.matrix,
            extrinsics=np.column_stack([rotation, -rotation @ centre]),
        )
    out = tmp_path / "out"
    assert run(["dataset", "import", "ortholoc", str(tmp_path), f"--out={out}", "--json"]) == 0
    said = capsys.readouterr()
    facts = json.loads(said.out)
    assert (facts["dataset"], facts["frames"], facts["too oblique"]) == ("OrthoLoC", 2, 1)
    assert "the true ones" in said.err
    singles_followed(out, 2)
    plans = plan_campaign(out / "campaign.toml", tmp_path / "campaign")
    assert [job.name for job in plans.runs] == [f"L01_R000{k}/{run}" for k in (0, 1) for run in ("ncc", "sift")]
    assert set(plans.groups.values()) == {"OrthoLoC"}
    row = read_telemetry(out / "L01_R0000" / "telemetry.csv")[0]
    stated = (row.roll_deg, row.pitch_deg, row.height_agl_m)
    assert stated == pytest.approx((truth[0].roll_deg, truth[0].pitch_deg, truth[0].height_agl_m), abs=20.0)


@pytest.mark.slow
def test_anyvisloc_becomes_flights_of_one_frame_on_one_map(plan, truth, tmp_path, capsys):
    """Gimbals keep the roll at 0 there: the frames are drawn again without theirs."""
    town, scene = plan.town, tmp_path / "Scene_01"
    corner = town.pixel_to_crs[:, 2]  # centre of the first pixel
    save(scene / "aerial_map.png", town.ortho)
    np.save(scene / "aerial_dsm.npy", town.surface_m[::2, ::2])
    gsd = town.gsd_m_per_px
    mode = {
        "map_path": "aerial_map.png",
        "dsm_path": "aerial_dsm.npy",
        "map_origin_local": [0.0, 0.0],
        "map_resolution": [gsd, gsd],
        "dsm_resolution": [2 * gsd, 2 * gsd],
    }
    (scene / "L01_reference.json").write_text(json.dumps({"modes": {"aerial": mode}}), encoding="utf-8")
    for k, true in enumerate(truth[:2]):
        attitude = Attitude(0.0, true.pitch_deg, true.heading_deg)
        place = plan.truth.position_m[len(plan) - 4 + k]
        image = picture_at(town, CAMERA, plan.origin, place, attitude, np.random.default_rng(k))
        east, north, up = local_of(plan, true, corner)
        np.savez(
            scene / f"L01_{k + 1:04d}.npz",
            image=image,
            K=CAMERA.matrix,
            dist=np.zeros(5),
            xyz=np.array([east, -north, up]),
            euler_deg=np.array([0.0, true.pitch_deg, grid_heading_deg(plan, true)]),
        )
    out = tmp_path / "out"
    command = ["dataset", "import", "anyvisloc", str(tmp_path), f"--out={out}"]
    assert run([*command, "--part=Scene_01", "--hfov-deg=60"]) == 2
    assert "--hfov-deg: expected none with anyvisloc" in capsys.readouterr().err
    assert run(command) == 2
    assert "--part: expected a scene with anyvisloc" in capsys.readouterr().err
    assert run([*command, "--part=Scene_01", "--reference=satellite"]) == 1
    assert "expected modes.satellite with its map and DSM" in capsys.readouterr().err
    assert not out.exists()
    assert run([*command, "--part=Scene_01"]) == 0
    flights = singles_followed(out, 2)
    assert all((flight / "map.tif").samefile(out / "map" / "map.tif") for flight in flights)
    capsys.readouterr()
    for limit, count in ((1, 1), (2, 2), (7, 2)):
        one = [*command[:-1], f"--out={tmp_path / f'limit{limit}'}", "--part=Scene_01", f"--limit={limit}"]
        assert run([*one, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["frames"] == count
        assert len(list((tmp_path / f"limit{limit}").glob("*/telemetry.csv"))) == count
    assert run([*one, "--max-tilt-deg=nan"]) == 2
    assert "--max-tilt-deg: expected 0 to 90 degrees, got nan" in capsys.readouterr().err

    # Done again, a flight of the import is replaced, and a folder of anybody else's is not.
    assert run([*one, "--force"]) == 0
    (tmp_path / "limit7" / "L01_0002" / "dataset.json").unlink()
    before = files_in(tmp_path / "limit7")
    assert run([*one, "--force"]) == 2
    assert "expected flights of an earlier import to replace" in capsys.readouterr().err
    within = ["dataset", "import", "anyvisloc", str(tmp_path), "--part=Scene_01", "--force"]
    for place in (scene, tmp_path):
        assert run([*within, f"--out={place}"]) == 2
        assert "--out: expected a folder without DIR" in capsys.readouterr().err
    assert files_in(tmp_path / "limit7") == before


def ortholoc_sample(path, **more):
    """A sample of OrthoLoC with its heights unknown in a corner, as the arrays of some samples say."""
    x, y = np.meshgrid(np.arange(24.0), np.arange(24.0))
    world = np.stack([x, -y, np.full_like(x, 7.0)], axis=-1)
    np.savez(
        path, image_query=np.zeros((20, 30, 3), np.uint8), image_dop=np.zeros((24, 24, 3), np.uint8), dsm=world,
        intrinsics=Camera.from_fov(30, 20, 60.0).matrix,
        extrinsics=np.array([[1.0, 0, 0, -12], [0, -1, 0, -12], [0, 0, -1, 90]]), **more,
    )  # fmt: skip
    return path


def test_ortholocs_mask_says_where_heights_are_known(tmp_path):
    """Demonstration samples have names of their own."""
    mask = np.ones((24, 24), bool)
    mask[:5, :7] = False
    path = ortholoc_sample(tmp_path / "urban_residential_xDOPDSM.npz", mask_dsm=mask)
    assert find_ortholoc(tmp_path) == [path]
    _, local_map = read_ortholoc(path)
    assert np.array_equal(np.isfinite(local_map.surface_m), mask)
    with pytest.raises(TelemetryError, match=r"expected mask_dsm as image_dop, got \(3, 3\)"):
        read_ortholoc(ortholoc_sample(tmp_path / "other.npz", mask_dsm=np.ones((3, 3), bool)))


def test_a_sample_that_would_run_code_is_refused(tmp_path, capsys):
    np.savez(tmp_path / "L01_R0000.npz", image_query=np.array([{"a": 1}], dtype=object))
    assert run(["dataset", "import", "ortholoc", str(tmp_path), f"--out={tmp_path / 'out'}"]) == 1
    assert "expected NumPy arrays" in capsys.readouterr().err
