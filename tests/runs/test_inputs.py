"""Inputs of a run that no file was written for: pictures with corners, lenses by their field of view, mounts."""

import re
import shlex
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from PIL import Image

from engine.camera import Camera, mount_rotation
from engine.errors import CalibrationError, MapError, OptionError
from engine.geo import LocalFrame
from scenematch import BridgeFiles, CameraInput, Corrections, FlightFiles, MapInput
from scenematch.cli.app import run
from scenematch.files.flight import camera_info
from scenematch.files.geotiff import write_geotiff
from scenematch.runs.evaluation import recorded_files
from scenematch.runs.inputs import check_pictures
from scenematch.runs.record import RunRecord
from tests.support.commands import refusal
from tests.support.photos import gimbal, photograph
from tests.support.refusals import misuse
from tests.support.refusals import refusal as refusal_of_call
from tests.support.videos import write_subtitles, write_video

UTM, WEST, NORTH = "EPSG:32633", 598_000.0, 5_342_000.0
FOCAL_35MM = 0xA405


def noise(rows=60, columns=80):
    return np.random.default_rng(3).integers(0, 256, (rows, columns), dtype=np.uint8)


@pytest.fixture
def map_file(tmp_path):
    write_geotiff(tmp_path / "map.tif", noise(), [[0.5, 0, WEST + 0.25], [0, -0.5, NORTH - 0.25]], 32633)
    return tmp_path / "map.tif"


@pytest.fixture
def shot(tmp_path):
    Image.fromarray(noise()).save(tmp_path / "shot.png")
    return tmp_path / "shot.png"


# ---------------------------------------------------------------------------------------------------- maps


def test_a_picture_is_placed_by_edges_in_the_units_of_its_crs(shot):
    site = MapInput(shot, map_bounds=f"{WEST},{NORTH - 30},{WEST + 40},{NORTH}", map_crs=UTM).open()
    assert (site.width_px, site.height_px, site.gsd_m_per_px) == (80, 60, pytest.approx(0.5, rel=1e-3))
    west, south, east, north = site.bounds_deg
    again = MapInput(shot, map_bounds=f"{west},{south},{east},{north}").open()  # degrees, which need no CRS
    middles = [(each.frame.lat_deg, each.frame.lon_deg) for each in (site, again)]
    assert middles[0] == pytest.approx(middles[1], abs=5e-6)  # a copy on a metric grid is up to a pixel wider


def test_edges_in_degrees_stay_degrees_with_a_projected_crs(shot):
    site = MapInput(shot, map_bounds="16.0,48.0,16.001,48.0005018", map_crs="EPSG:3857").open()
    assert site.bounds_deg == pytest.approx((16.0, 48.0, 16.001, 48.0005018), abs=1e-7)


def test_a_geotiff_that_names_no_crs_is_given_one(map_file):
    named = MapInput(map_file).open()
    with rasterio.open(map_file, "r+") as dataset:
        dataset.crs = rasterio.crs.CRS()
    words = "names no CRS; give `map_crs`, such as EPSG:32636"
    assert words in refusal_of_call(MapInput(map_file).open, error=MapError)
    assert MapInput(map_file, map_crs=UTM).open().bounds_deg == pytest.approx(named.bounds_deg, abs=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"map_bounds": "17,48,16,49"}, "map_bounds: expected west before east and south before north"),
        ({"map_bounds": "16,48,17,49", "map_crs": UTM}, "map_bounds: expected a rectangle in crs"),
        ({"map_bounds": "16,48,17,49", "map_crs": "EPSG:5"}, "map_crs: expected"),
        ({"map_bounds": "598000,5341970,598040,5342000"},
         "map_bounds: expected west < east and south < north in degrees"),
    ],
)  # fmt: skip
def test_edges_that_place_no_picture_are_wrong_usage(shot, options, words):
    assert misuse(lambda: MapInput(shot, **options).open()).startswith(words)


def test_a_map_with_a_place_of_its_own_refuses_another(map_file):
    words = "map_bounds: expected none for a file with a georeference of its own"
    assert words in misuse(MapInput(map_file, map_bounds="16,48,17,49").open)
    assert "map_crs: expected none, since" in misuse(MapInput(map_file, map_crs="EPSG:32634").open)


def test_the_command_line_names_its_options(shot, capsys):
    assert "give --map-bounds (west, south, east, north)" in refusal(capsys, ["map", "info", shot], 1)
    line = refusal(capsys, ["map", "info", shot, "--map-bounds", "1,2,3"])
    assert line == "--map-bounds: expected W,S,E,N in degrees or in --map-crs, got '1,2,3'\n"
    bounds = ["--map-bounds", "16.0,48.0,16.001,48.0005018", "--map-crs", "EPSG:3857"]
    assert run(["map", "info", str(shot), *bounds]) == 0


# -------------------------------------------------------------------------------------------------- cameras


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(3):
        photograph(folder / f"{k}.jpg", f"2024:05:06 07:08:0{k}", tags={FOCAL_35MM: 24}, size_px=(320, 240))
    return folder


def load(files):
    return files.load_camera(files.open_flight())


def test_the_camera_is_that_of_the_photographs_or_of_a_field_of_view(photos):
    own = load(FlightFiles.from_flat(map="m.tif", frames=photos))
    assert own.focal_px == pytest.approx(400.0 * 24.0 / np.hypot(36.0, 24.0))
    assert np.allclose(own.mount, mount_rotation())
    lens = {"hfov_deg": 90.0, "mount": "nadir-tail", "camera_pitch_deg": -70.0}
    given = load(FlightFiles.from_flat(map="m.tif", frames=photos, **lens))
    assert given.focal_px == pytest.approx(160.0)
    assert np.allclose(given.mount, mount_rotation("nadir-tail", -70.0))


def test_a_mount_counts_more_than_the_calibrations(photos, save):
    path = save(camera_info(Camera.from_fov(320, 240, 60.0)), "camera.yaml")
    camera = load(FlightFiles.from_flat(map="m.tif", frames=photos, camera=path, mount="forward-45"))
    assert camera.focal_px == pytest.approx(160.0 / np.tan(np.radians(30.0)))
    assert np.allclose(camera.mount, mount_rotation("forward-45"))


def test_where_a_gimbal_says_where_the_camera_looks_a_mount_is_refused(tmp_path):
    photograph(tmp_path / "a.jpg", xmp=gimbal(), tags={FOCAL_35MM: 24})
    load(FlightFiles.from_flat(map="m.tif", frames=tmp_path))
    with pytest.raises(CalibrationError, match="mount: expected nadir, since the telemetry's gimbal angles"):
        load(FlightFiles.from_flat(map="m.tif", frames=tmp_path, mount="nadir-tail"))
    photograph(tmp_path / "a.jpg", xmp=gimbal("+0.0", "+0.0", "+0.0"), tags={FOCAL_35MM: 24})
    load(FlightFiles.from_flat(map="m.tif", frames=tmp_path, mount="nadir-tail"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"hfov_deg": 60.0, "camera": "c.yaml"}, "hfov_deg: expected without `camera`"),
        ({"hfov_deg": 180.0}, "hfov_deg: expected above 0 and below 180, got 180"),
        ({"mount": "side"}, "mount: expected one of nadir, .*forward-45, got 'side'"),
        ({"camera_pitch_deg": 45.0}, "camera_pitch_deg: expected -90"),
        ({"frames": "f.MP4"}, "camera: expected a calibration, or `hfov_deg`: a video contains neither"),
    ],
)
def test_what_says_nothing_of_a_camera_is_wrong_usage(options, words):
    assert re.search(words, misuse(FlightFiles.from_flat, **{"map": "m.tif", "frames": "f"} | options))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "camera: expected a calibration of the camera that `camera_source` opens, or `hfov_deg`"),
        ({"hfov_deg": 64.0}, r"camera_source: expected a camera, got the video .*\.mp4; `frames` plays it"),
        ({"camera": "c.yaml"}, r"camera_source: expected a camera, got the video .*\.mp4; `frames` plays it"),
    ],
)
def test_a_bridge_refuses_a_camera_without_a_calibration_and_a_video_as_one(tmp_path, options, words):
    video = tmp_path / "DJI_0001.mp4"
    video.touch()
    with pytest.raises(OptionError, match=words):
        BridgeFiles(map=MapInput("m.tif"), camera_source=str(video), camera=CameraInput(**options))


def test_a_live_camera_by_its_field_of_view_has_the_size_of_its_first_picture(tmp_path):
    picture, messages = tmp_path / "1.jpg", []
    Image.fromarray(noise()).save(picture)
    source = f"exec:{shlex.join(['cat', str(picture)])}"
    lens = CameraInput(hfov_deg=90.0, mount="nadir-tail")
    files = BridgeFiles(map=MapInput("m.tif"), camera_source=source, camera=lens)
    camera = files.load_camera(SimpleNamespace(message=messages.append))
    assert (camera.width_px, camera.height_px, camera.matrix[0, 0]) == (80, 60, pytest.approx(40.0))
    assert np.array_equal(camera.mount, mount_rotation("nadir-tail"))
    assert messages[-1] == "camera: 80 x 60, 90 degrees wide"
    silent = BridgeFiles(map=MapInput("m.tif"), camera_source="exec:true", camera=CameraInput(hfov_deg=90.0))
    assert "camera_source: expected pictures, got none" in refusal_of_call(silent.load_camera)


def test_a_live_camera_that_gives_no_picture_is_not_waited_for_without_end(monkeypatch):
    monkeypatch.setattr("scenematch.bridges.pictures._FIRST_PICTURE_S", 0.1)
    files = BridgeFiles(map=MapInput("m.tif"), camera_source="exec:sleep 60", camera=CameraInput(hfov_deg=90.0))
    assert "camera_source: expected a picture within 0.1 s, got none" in refusal_of_call(files.load_camera)


def test_the_delay_of_a_camera_needs_to_know_its_lens(capsys):
    command = ["bridge", "mavlink", "--measure-delay", "--connect=udpin:127.0.0.1:0", "--camera-source=0"]
    assert refusal(capsys, command).startswith("--camera: expected a calibration, or --hfov-deg")


def test_a_bridge_that_plays_pictures_takes_a_field_of_view_or_their_own(tmp_path):
    Image.fromarray(noise()).save(tmp_path / "1.png")
    wide = BridgeFiles(map=MapInput("m.tif"), frames=tmp_path, camera=CameraInput(hfov_deg=90.0)).load_camera()
    assert (wide.width_px, wide.height_px, wide.matrix[0, 0]) == (80, 60, pytest.approx(40.0))
    with pytest.raises(CalibrationError, match=r"1\.png: expected a focal length"):
        BridgeFiles(map=MapInput("m.tif"), frames=tmp_path).load_camera()


def test_one_frame_in_some_keeps_its_own_telemetry(tmp_path):
    """Of a video with a log: pictures, stamps, heights and corrections are those of the frames that are left."""
    path = tmp_path / "DJI_0002.avi"
    write_video(path, [30 * k for k in range(8)])
    texts = (f"[latitude: 48.1] [longitude: 16.2] [rel_alt: {80.0 + k * k}]" for k in range(8))
    write_subtitles(tmp_path / "DJI_0002.SRT", texts)
    late = Corrections(offset_s=0.04)  # by one frame, which only all of the rows can say
    named = {"map": "m.tif", "frames": path, "hfov_deg": 70.0}
    whole, part = FlightFiles.from_flat(**named), FlightFiles.from_flat(**named, every=3, corrections=late)
    assert whole.telemetry == tmp_path / "DJI_0002.SRT"
    assert len(whole.open_flight()) == 8
    assert load(whole).width_px == 64
    flight = part.open_flight()
    assert (flight.names, flight.heights, flight.unused) == (["0", "3", "6"], {"take-off": 3}, 0)
    assert [item.frame.timestamp_ns for item in flight] == [0, 120_000_000, 240_000_000]
    assert [item.frame.height_agl_m for item in flight] == pytest.approx([80.0, 84.0, 105.0])
    assert [item.frame.image.mean() for item in flight] == pytest.approx([0.0, 90.0, 180.0], abs=3.0)
    unstamped = FlightFiles.from_flat(**(named | {"frames": path.rename(tmp_path / "bare.avi")}), every=3)
    assert [item.name for item in unstamped.open_flight()] == ["0", "3", "6"]


@pytest.fixture
def calibration(save):
    """For pictures of twice the photographs' size."""
    matrix = np.array([[500.0, 0.0, 319.5], [0.0, 505.0, 239.5], [0.0, 0.0, 1.0]])
    lens = Camera(640, 480, matrix, distortion=np.array([-0.28, 0.09, 7e-4, -4e-4, -0.01]))
    return save(camera_info(lens), "640x480.yaml")


def test_a_calibration_is_scaled_on_request_and_said(photos, calibration):
    given = {"camera": calibration, "scale_calibration": True, "mount": "nadir-tail"}
    files = FlightFiles.from_flat(map="m.tif", frames=photos, **given)
    messages = []
    camera = files.load_camera(files.open_flight(), SimpleNamespace(message=messages.append))
    assert (camera.width_px, camera.height_px) == (320, 240)
    assert (camera.matrix[0, 0], camera.matrix[0, 2]) == (250.0, 159.5)
    assert np.allclose(camera.mount, mount_rotation("nadir-tail"))
    assert messages == ["the calibration for 640 x 480 is scaled to pictures of 320 x 240"]
    check_pictures(files.open_flight(), camera)


def test_without_the_request_another_size_is_refused_and_the_request_named(photos, calibration, map_file, capsys):
    files = FlightFiles.from_flat(map="m.tif", frames=photos, camera=calibration)
    flight = files.open_flight()
    with pytest.raises(CalibrationError, match=r"0\.jpg: camera: calibrated for 640 x 480, .*`scale_calibration`"):
        check_pictures(flight, files.load_camera(flight))
    line = refusal(capsys, ["locate", photos / "0.jpg", "--map", map_file, "--camera", calibration], 1)
    assert "resized without cropping, add --settings input.scale_calibration" in line


def test_nothing_to_scale_and_another_shape_are_refused(photos, calibration):
    unscalable = {"map": "m.tif", "frames": photos, "scale_calibration": True}
    assert "scale_calibration: expected with `camera`" in misuse(FlightFiles.from_flat, **unscalable)
    calibration.write_text(calibration.read_text().replace("image_height: 480", "image_height: 360"))
    files = FlightFiles.from_flat(map="m.tif", frames=photos, camera=calibration, scale_calibration=True)
    assert "a part may have been cut off" in refusal_of_call(load, files, error=CalibrationError)
    unscaled = FlightFiles.from_flat(map="m.tif", frames=photos, camera=calibration)
    flight = unscaled.open_flight()
    with pytest.raises(CalibrationError, match="320 x 240; their aspect ratios differ: give the calibration of"):
        check_pictures(flight, unscaled.load_camera(flight))


@pytest.mark.parametrize(
    ("given", "camera"),
    [
        ({"hfov_deg": 70.0, "mount": "nadir-left", "camera_pitch_deg": -80.0}, None),
        ({"frames": "/f.bag", "odometry_topic": "/vio", "every": 3, "mount": "nadir-left"}, "/f.bag"),
        ({"camera": "/c.yaml", "scale_calibration": True}, "/c.yaml"),
    ],
    ids=["field of view", "bag", "calibration"],
)
def test_a_record_gives_the_same_files(photos, given, camera):
    given = {"map": "/m.tif", "frames": str(photos)} | given
    record = RunRecord(
        **(given | {"camera": camera}), surface=None, truth=None, method="ncc", profile="engine",
        origin=LocalFrame(48.0, 16.0), ground_m=0.0, ground_amsl_m=None,
    )  # fmt: skip
    assert recorded_files(record) == FlightFiles.from_flat(**given)
