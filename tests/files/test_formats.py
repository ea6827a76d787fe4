"""Telemetry, truth, frames, flights, tracks and GeoTIFF: what is read, what is written, what is refused."""

import dataclasses

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image

from engine import CalibrationError, Camera, MapError
from engine.values import NoFix, Prior, Reason, Truth, Window
from scenematch.files import telemetry as telemetry_files
from scenematch.files.flight import open_flight
from scenematch.files.frames import open_frames, read_image
from scenematch.files.geotiff import write_geotiff
from scenematch.files.telemetry import BOUNDS, DEFAULT_PRIOR_SIGMA_M, TelemetryRow, read_telemetry, write_telemetry
from scenematch.files.track import COLUMNS, NOTE_COLUMNS, TrackRow, read_track, track_row, write_track
from scenematch.files.truth import interpolate_truth, read_truth, write_truth
from tests.support.fixes import a_fix
from tests.support.photos import write_pictures
from tests.support.refusals import refusal
from tests.support.videos import write_video

HEADER = "timestamp_ns,frame,height_agl_m,heading_deg,lat_deg,lon_deg\n"


def picture(value, size=(8, 6)):
    return np.full((size[1], size[0], 3), value, np.uint8)


@pytest.fixture
def folder(tmp_path):
    """Three pictures whose names sort one way as text and another as numbers."""
    frames = write_pictures(tmp_path / "frames", {"1.png": 10, "2.png": 20, "10.png": 100})
    (frames / "notes.txt").write_text("no picture")
    (frames / "._1.png").write_text("what some systems leave behind")
    return frames


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Twelve frames; frame i is a flat picture of about 20 i."""
    path = tmp_path_factory.mktemp("video") / "flight.avi"
    write_video(path, [20 * k for k in range(12)], rate_hz=10.0)
    return path


# ------------------------------------------------------------------------------------------------ telemetry


def test_unknown_cells_and_columns_a_byte_order_mark_crlf_blank_lines_and_spaces_are_accepted(save):
    header = b"\xef\xbb\xbftimestamp_ns, frame ,height_agl_m,heading_deg,battery\r\n"
    rows = read_telemetry(save(header + b"5000000, a.jpg ,1.495e2,,full\r\n\r\n9000000,b.jpg,,-90,,,\r\n"))
    assert rows == [
        TelemetryRow(timestamp_ns=5_000_000, frame="a.jpg", height_agl_m=149.5),
        TelemetryRow(timestamp_ns=9_000_000, frame="b.jpg", heading_deg=270.0),
    ]
    assert rows[0].prior is None


def test_a_prior_without_sigma_takes_the_default(save):
    rows = read_telemetry(save("timestamp_ns,frame,lat_deg,lon_deg,sigma_m\n1,a,32.5,35.25,\n2,b,32.5,35.25,4\n"))
    assert rows[0].prior == Prior(lat_deg=32.5, lon_deg=35.25, sigma_m=DEFAULT_PRIOR_SIGMA_M)
    assert rows[1].prior == Prior(lat_deg=32.5, lon_deg=35.25, sigma_m=4.0)


def test_telemetry_round_trip(tmp_path):
    """With values at the ends of their ranges, unknown cells, stamps before 1970 and a name that needs quotes."""
    path, second = tmp_path / "telemetry.csv", 10**9
    known = {name: 1.25 + k for k, name in enumerate(BOUNDS)}
    ends = {"heading_deg": 359.9, "roll_deg": -180, "pitch_deg": 90, "lat_deg": -90, "lon_deg": 179.123456789}
    rows = [
        TelemetryRow(timestamp_ns=-(2**62) // second * second, frame='a,"b".jpg', **known),
        TelemetryRow(timestamp_ns=-second, frame="b.jpg"),
        TelemetryRow(timestamp_ns=2**62 // second * second, frame="c.jpg", **ends, alt_amsl_m=-500.0),
    ]
    write_telemetry(path, rows)
    assert read_telemetry(path) == rows


def test_golden_bytes_of_telemetry(tmp_path):
    path = tmp_path / "telemetry.csv"
    known = {"height_agl_m": 150.0, "roll_deg": -0.00001, "lat_deg": 1 / 3, "lon_deg": -2 / 3}
    rows = TelemetryRow(timestamp_ns=7, frame="a.jpg", **known), TelemetryRow(timestamp_ns=8, frame="b,c.jpg")
    write_telemetry(path, rows)
    assert path.read_bytes() == (
        b"timestamp_ns,frame,height_agl_m,roll_deg,lat_deg,lon_deg\n"
        b'7,a.jpg,150.000,0.0000,0.333333333,-0.666666667\n8,"b,c.jpg",,,,\n'
    )


BAD_TELEMETRY = {
    "empty": ("", "expected a header with timestamp_ns, frame, got an empty first line"),
    "no rows": (HEADER, "expected one row per frame, got a header and no rows"),
    "missing column": ("timestamp_ns,height_agl_m\n1,5\n", "line 1: lacks the column frame"),
    "duplicate column": ("timestamp_ns,frame,frame\n1,a,b\n",
     "line 1, frame: expected the column once, got it 2 times"),
    "short row": (HEADER + "1,a.jpg,5\n", "line 2: expected 6 cells as in the header, got 3"),
    "long row": (HEADER + "1,a.jpg,5,1,2,3,4\n", "line 2: expected 6 cells as in the header, got 7"),
    "repeated stamp": (HEADER + "5,a,,,,\n5,b,,,,\n",
     "line 3, timestamp_ns: expected a stamp later than the row before (5), got '5'"),
    "repeated frame": (HEADER + "5,a,,,,\n6,a,,,,\n",
     "line 3, frame: expected each frame once (it is also in line 2)"),
    "blank stamp": (HEADER + ",a,,,,\n", "line 2, timestamp_ns: expected whole nanoseconds, got ''"),
    "stamp in seconds": (HEADER + "1.5,a,,,,\n", "line 2, timestamp_ns: expected a whole number, got '1.5'"),
    "huge stamp": (HEADER + "9" * 19 + ",a,,,,\n", "line 2, timestamp_ns: expected a whole number"),
    "blank frame": (HEADER + "1,,,,,\n", "line 2, frame: expected a value"),
    **{f"{text} as a height": (HEADER + f"1,a,{text},,,\n",
     f"line 2, height_agl_m: expected a finite number above 0, got {text!r}")
     for text in ("nan", "1e999", "0.0", "high", "1_0")},
    "centidegrees": (HEADER + "1,a,5,21790,,\n", "heading_deg: expected degrees from -360 to 360, got '21790'"),
    "latitude": (HEADER + "1,a,5,,91,3\n", "lat_deg: expected degrees from -90 to 90, got '91'"),
    "longitude": (HEADER + "1,a,5,,9,361\n", "lon_deg: expected degrees from -180 to 360, got '361'"),
    "a sigma as wide as no map": ("timestamp_ns,frame,sigma_m\n1,a,1e200\n",
     "line 2, sigma_m: expected a number from 0 to 1e+06, got '1e200'"),
    "half a position": (HEADER + "1,a,5,,9,\n", "lon_deg: expected a value, as lat_deg has one, got ''"),
    "not UTF-8": (b"timestamp_ns,frame\n1,\xe9.jpg\n", "expected UTF-8 text, got the byte 0xe9"),
    "line in a cell": (HEADER + '1,a,"5\nx",,,\n', r"height_agl_m: expected a finite number above 0, got '5\nx'"),
    "long cell": (HEADER + "1,a," + "x" * 500 + ",,,\n", "got '" + "x" * 40 + "'..."),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_TELEMETRY, ids=list(BAD_TELEMETRY))
def test_bad_telemetry_is_refused_with_its_place(save, case):
    text, expected = BAD_TELEMETRY[case]
    message = refusal(read_telemetry, save(text))
    assert expected in message
    assert "telemetry.csv" in message


def test_missing_telemetry_and_a_folder_in_its_place_are_refused(tmp_path):
    assert refusal(read_telemetry, tmp_path / "none.csv").endswith("none.csv: no such file")
    assert "cannot be read" in refusal(read_telemetry, tmp_path)
    assert "cannot be written" in refusal(write_telemetry, tmp_path / "none" / "t.csv", [])


def test_ground_is_the_median_difference_of_the_two_heights():
    pairs = [(200.0, 150.0), (210.0, 159.0), (300.0, 100.0), (None, 5.0), (5.0, None)]
    rows = [TelemetryRow(timestamp_ns=0, frame="a", alt_amsl_m=a, height_agl_m=h) for a, h in pairs]
    assert telemetry_files.ground_amsl_m(rows) == 51.0
    assert telemetry_files.ground_amsl_m(rows[3:]) is None


# ---------------------------------------------------------------------------------------------------- truth


def test_truth_round_trip_and_refusals(tmp_path, save):
    rows = [
        Truth(timestamp_ns=5_000_000, lat_deg=1.123456789, lon_deg=-2.0, alt_amsl_m=200.1234, heading_deg=359.5),
        Truth(timestamp_ns=9_000_000, lat_deg=1.5, lon_deg=-2.5, roll_deg=-3.25),
    ]
    write_truth(tmp_path / "truth.csv", rows)
    assert read_truth(tmp_path / "truth.csv") == rows
    assert "lacks the column lon_deg" in refusal(read_truth, save("timestamp_ns,lat_deg\n1,2\n"))
    blank = save("timestamp_ns,lat_deg,lon_deg\n1,,3\n")
    assert "line 2, lat_deg: expected degrees" in refusal(read_truth, blank)


def test_truth_is_linear_between_neighbours_and_turns_the_short_way():
    rows = [
        Truth(timestamp_ns=0, lat_deg=10.0, lon_deg=179.99, alt_amsl_m=100.0, heading_deg=350.0, roll_deg=2.0),
        Truth(timestamp_ns=4_000_000_000, lat_deg=11.0, lon_deg=-179.99, alt_amsl_m=104.0, heading_deg=20.0),
    ]
    assert interpolate_truth(rows, 1_000_000_000) == Truth(
        timestamp_ns=1_000_000_000, lat_deg=pytest.approx(10.25), lon_deg=pytest.approx(179.995),
        alt_amsl_m=pytest.approx(101.0), heading_deg=pytest.approx(357.5),
    )  # fmt: skip
    assert interpolate_truth(rows, 2_000_000_000).heading_deg == pytest.approx(5.0)


def test_truth_is_unknown_outside_and_in_gaps():
    rows = [Truth(timestamp_ns=t * 10**9, lat_deg=0.0, lon_deg=0.0) for t in (10, 12, 18)]
    assert interpolate_truth(rows, 12 * 10**9) is rows[1]
    assert interpolate_truth(rows, 18 * 10**9) is rows[2]
    for stamp_s in (9, 19, 15):
        assert interpolate_truth(rows, stamp_s * 10**9) is None
    assert interpolate_truth([], 5) is None


# --------------------------------------------------------------------------------------------------- frames


def test_a_folder_reads_in_natural_order(folder):
    source = open_frames(folder)
    assert source.names == ["1.png", "2.png", "10.png"]
    assert "2.png" in source
    assert "notes.txt" not in source
    np.testing.assert_array_equal(source.read("10.png"), picture(100))
    assert "expected one of 3 pictures, 1.png to 10.png, got '3.png'" in refusal(source.read, "3.png")


@pytest.mark.parametrize(
    ("mode", "value", "expected"),
    [
        ("RGB", (200, 100, 50), (200, 100, 50)),
        ("RGBA", (9, 8, 7, 128), (9, 8, 7)),
        ("L", 7, (7, 7, 7)),
        ("I;16", 0x1280, (0x12, 0x12, 0x12)),
        ("1", 1, (255, 255, 255)),
        ("P", 0, (0, 0, 0)),
    ],
)
def test_every_kind_of_picture_becomes_rgb(tmp_path, mode, value, expected):
    Image.new(mode, (8, 6), value).save(tmp_path / "a.png")
    read = read_image(tmp_path / "a.png")
    assert (read.shape, read.dtype) == ((6, 8, 3), np.uint8)
    assert (read == expected).all()


def test_unreadable_pictures_are_refused(tmp_path):
    good = tmp_path / "good.jpg"
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(good)
    (tmp_path / "cut.jpg").write_bytes(good.read_bytes()[:600])
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "text.jpg").write_text("no picture")
    Image.new("F", (4, 4)).save(tmp_path / "float.tif")
    for name in ("cut.jpg", "empty.jpg", "text.jpg"):
        assert f"{name}: expected a readable picture" in refusal(read_image, tmp_path / name)
    assert "got mode F" in refusal(read_image, tmp_path / "float.tif")
    assert "no such picture" in refusal(read_image, tmp_path / "none.jpg")


def test_paths_without_frames_are_refused(tmp_path):
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "text.txt").write_text("no video" * 50)
    (tmp_path / "none").mkdir()
    assert "expected pictures" in refusal(open_frames, tmp_path / "none")
    assert "no such folder or video" in refusal(open_frames, tmp_path / "elsewhere")
    assert "got an empty file" in refusal(open_frames, tmp_path / "empty.mp4")
    assert "a file that is neither" in refusal(open_frames, tmp_path / "text.txt")


def test_one_picture_is_a_source_of_one(folder):
    assert open_frames(folder / "2.png").names == ["2.png"]


def value_of(source, name):
    return round(float(source.read(name).mean()) / 20)


def test_a_video_is_read_by_exact_index_in_any_order(video):
    source = open_frames(video)
    assert source.names == [str(i) for i in range(12)]
    order = ["0", "1", "5", "5", "11", "3", "4", "0"]
    assert [value_of(source, name) for name in order] == [int(name) for name in order]
    assert source.read("2").shape == (48, 64, 3)


def test_going_forward_in_a_video_opens_it_once(video, monkeypatch):
    opened, real = [], cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda path: opened.append(path) or real(path))
    source = open_frames(video)
    for name in ("0", "2", "3", "9", "9", "11"):
        source.read(name)
    assert len(opened) == 1
    source.read("1")
    assert len(opened) == 2


def test_a_frame_that_was_read_may_be_written_on(video):
    source = open_frames(video)
    source.read("3")[:] = 0
    assert value_of(source, "3") == 3


def test_an_index_outside_a_video_is_refused(video):
    source = open_frames(video)
    for name in ("12", "-1", "a.jpg", "01"):
        assert f"expected an index from 0 to 11 of the video, got {name!r}" in refusal(source.read, name)


class LyingCapture:
    """A video whose header counts frames wrongly."""

    counted, real = 15, cv2.VideoCapture

    def __init__(self, path):
        self._capture = self.real(path)

    def get(self, prop):
        return self.counted if prop == cv2.CAP_PROP_FRAME_COUNT else self._capture.get(prop)

    def __getattr__(self, name):
        return getattr(self._capture, name)


def test_a_video_that_ends_early_is_refused(video, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", LyingCapture)
    source = open_frames(video)
    assert value_of(source, "11") == 11
    for name in ("12", "14"):
        message = refusal(source.read, name)
        assert f"frame {name}: expected 15 frames as the file states, got no more than 12" in message
    assert value_of(source, "3") == 3


def test_a_video_that_does_not_say_how_long_it_is_is_counted(video, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", LyingCapture)
    monkeypatch.setattr(LyingCapture, "counted", -1)
    assert len(open_frames(video).names) == 12


# --------------------------------------------------------------------------------------------------- flight


def test_a_flight_joins_rows_and_pictures_and_counts_the_rest(folder, save):
    flight = open_flight(folder, save(HEADER + "5000000,10.png,150,90,32,35\n9000000,1.png,,,,\n"))
    assert (len(flight), flight.unused, flight.names) == (2, 1, ["10.png", "1.png"])
    first, second = flight
    np.testing.assert_array_equal(first.frame.image, picture(100))
    assert (first.name, first.frame.timestamp_ns, first.frame.height_agl_m) == ("10.png", 5_000_000, 150.0)
    assert first.frame.heading_deg == 90.0
    assert first.prior == Prior(lat_deg=32.0, lon_deg=35.0, sigma_m=DEFAULT_PRIOR_SIGMA_M)
    assert first.telemetry is flight.rows[0]
    assert second.prior is None
    assert [item.name for item in flight] == ["10.png", "1.png"]  # may be flown again


def test_a_row_that_names_no_picture_is_refused_before_the_flight(folder, save):
    message = refusal(open_flight, folder, save(HEADER + "5,1.png,,,,\n9,4.png,,,,\n"))
    assert "telemetry.csv: line 3, frame: expected one of 3 pictures, 1.png to 10.png, got '4.png'" in message


@pytest.mark.parametrize("name", ["flight.ts", "flight.klv", "GX010001.MP4"])
def test_metadata_in_a_video_is_refused_with_the_way_out(folder, save, name):
    """The first bytes are those of a transport stream and of a UAS data link's packet (MISB ST 0601)."""
    path = save(b"\x47\x40\x11" + bytes.fromhex("060e2b34020b01010e01030101000000"), name)
    message = refusal(open_flight, folder, path)
    assert message.startswith(f"{path}: expected a table or a flight log, got a video's metadata")
    assert "convert it to a .SRT" in message


def test_without_telemetry_frames_come_bare(folder, video):
    for source in (folder, video):
        items = list(open_flight(source))
        assert items[0].telemetry is items[0].prior is items[0].frame.timestamp_ns is None
    assert [item.name for item in open_flight(folder)] == ["1.png", "2.png", "10.png"]


def test_a_camera_of_another_size_is_refused_up_front(folder):
    assert len(open_flight(folder, camera=Camera.from_fov(8, 6, 60.0))) == 3
    message = refusal(open_flight, folder, camera=Camera.from_fov(300, 300, 60.0), error=CalibrationError)
    assert "calibrated for 300 x 300, but the frame is 8 x 6" in message


# -------------------------------------------------------------------------------------------------- GeoTIFF


@pytest.mark.parametrize("shape", [(30, 40), (30, 40, 3)])
@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_geotiff_keeps_pixels_and_moves_the_half_pixel(tmp_path, shape, dtype):
    array = np.random.default_rng(2).uniform(0, 255, shape).astype(dtype)
    centre = np.array([[0.5, 0.1, 600_000.0], [0.2, -0.6, 3_600_000.0]])
    write_geotiff(tmp_path / "a.tif", array, centre, 32636, nodata=0)
    with rasterio.open(tmp_path / "a.tif") as file:
        read = np.moveaxis(file.read(), 0, 2).reshape(shape)
        # rasterio's xy() answers for the centre of a pixel.
        assert file.xy(0, 0) == pytest.approx(centre[:, 2])
        assert file.xy(7, 11) == pytest.approx(centre @ [11, 7, 1])
        assert (file.crs.to_epsg(), file.nodata, file.profile["tiled"]) == (32636, 0, True)
        assert file.compression.name == "deflate"
    np.testing.assert_array_equal(read, array)


@pytest.mark.parametrize(("name", "crs"), [("a.tif", 999_999), ("none/a.tif", 4326)])
def test_geotiff_refuses_what_it_cannot_write(tmp_path, name, crs):
    given = np.zeros((4, 4), np.uint8), np.eye(2, 3), crs
    assert "cannot be written" in refusal(write_geotiff, tmp_path / name, *given, error=MapError)


# ---------------------------------------------------------------------------------------------------- track

PLACE = {"lat_deg": 32.7931868031, "lon_deg": 34.9888531542, "east_m": -12.34567, "north_m": 0.00004}
COVARIANCE_M2 = np.array([[4.0, -0.5, 0.0], [-0.5, 2.25, 0.0], [0.0, 0.0, 9.0]])
SEEN = {"timestamp_ns": 107_802_500_000, "score": 0.87654321, "window": Window(3, 4, 420, 415)}
FIX = a_fix(**PLACE, **SEEN, covariance_m2=COVARIANCE_M2)
REFUSAL = NoFix(reason=Reason.AMBIGUOUS, timestamp_ns=None, method="sift", score=-0.00001)


def test_golden_bytes_of_a_track(tmp_path):
    path = tmp_path / "track.csv"
    rows = [
        track_row("000000.jpg", FIX, latency_ms=12.3456, deadline_met=True),
        track_row("1", REFUSAL, latency_ms=40.0, deadline_met=False),
        track_row("2", dataclasses.replace(FIX, up_m=151.25), latency_ms=None, deadline_met=None),
    ]
    write_track(path, rows)
    assert path.read_bytes() == (
        b"timestamp_ns,frame,status,reason,lat_deg,lon_deg,east_m,north_m,up_m,sigma_east_m,sigma_north_m,"
        b"covariance_en_m2,score,method,window_width_px,window_height_px,latency_ms,deadline_met\n"
        b"107802500000,000000.jpg,fix,,32.793186803,34.988853154,-12.346,0.000,,2.0000,1.5000,"
        b"-0.500000,0.8765,ncc,420,415,12.346,true\n"
        b",1,no_fix,ambiguous,,,,,,,,,0.0000,sift,,,40.000,false\n"
        b"107802500000,2,fix,,32.793186803,34.988853154,-12.346,0.000,151.250,2.0000,1.5000,"
        b"-0.500000,0.8765,ncc,420,415,,\n"
    )


def test_a_track_reads_back(tmp_path):
    fix = dataclasses.replace(FIX, lat_deg=32.5, lon_deg=35.5, east_m=1.25, north_m=-2.5, score=0.5)
    rows = [
        TrackRow(timestamp_ns=5, frame="a", status="no_fix", reason="late", latency_ms=1.5, deadline_met=False),
        track_row("b", fix, latency_ms=2.5, deadline_met=True),
    ]
    write_track(tmp_path / "track.csv", rows)
    noted = dict.fromkeys(NOTE_COLUMNS[1:])
    assert read_track(tmp_path / "track.csv") == [dataclasses.replace(row, **noted) for row in rows]
    assert [row.fixed for row in rows] == [False, True]


def test_an_interrupted_run_keeps_its_rows(tmp_path):
    path = tmp_path / "track.csv"

    def answered():
        for count, name in enumerate("ab"):
            assert [row.frame for row in read_track(path)] == list("ab"[:count])
            yield track_row(name, REFUSAL, latency_ms=1.0, deadline_met=None)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_track(path, answered())
    assert [row.frame for row in read_track(path)] == ["a", "b"]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"status": "good"}, "line 2, status: expected fix or no_fix, got 'good'"),
        ({"lat_deg": ""}, "line 2, lat_deg: expected a number, since the row is a fix, got ''"),
        ({"reason": "bored"}, "line 2, reason: expected a known reason or nothing, got 'bored'"),
        ({"sigma_east_m": "-1"}, "line 2, sigma_east_m: expected a finite number of 0 or more, got '-1'"),
        ({"window_width_px": "1.5"}, "line 2, window_width_px: expected a whole number, got '1.5'"),
        ({"deadline_met": "maybe"}, "line 2, deadline_met: expected true, false or nothing, got 'maybe'"),
    ],
)
def test_a_bad_track_is_refused_with_its_place(tmp_path, change, expected):
    path = tmp_path / "track.csv"
    write_track(path, [track_row("a", FIX, latency_ms=1.0, deadline_met=True)])
    header, line, _ = path.read_text().split("\n")
    values = dict(zip(COLUMNS, line.split(","), strict=True)) | change
    path.write_text(f"{header}\n{','.join(values.values())}\n")
    assert expected in refusal(read_track, path)


def test_a_track_cannot_be_written_where_there_is_no_folder(tmp_path):
    assert "cannot be written" in refusal(write_track, tmp_path / "none" / "track.csv", [])
