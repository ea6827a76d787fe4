"""Flight logs: written here byte by byte with known values, read back at the frames' moments."""

import json
import math
import struct
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from bench.inputs import log_files
from bench.inputs.log_files import ELSE, UTC_NS, S, dataflash_flight, ulog_flight, ulog_message, write_dataflash
from scenematch.cli.app import run
from scenematch.files.flight import open_flight
from scenematch.files.logs.readers import open_log, open_truth, stamp_frames
from scenematch.files.resampling import MAX_SAMPLE_GAP_NS, interpolate, make_series, rows_and_sources_at
from scenematch.files.telemetry import read_telemetry, take_off_sigma_m
from scenematch.files.truth import interpolate_truth, read_truth
from tests.support.commands import answer, file_options
from tests.support.photos import write_pictures
from tests.support.refusals import misuse, refusal
from tests.support.videos import write_subtitles, write_video


def at(log, *seconds):
    rows, sources = rows_and_sources_at(log, [round(s * S) for s in seconds], list(map(str, range(len(seconds)))))
    return rows, dict(Counter(filter(None, sources)))


# ------------------------------------------------------------------------------------------------- resampling


def test_values_are_linear_between_samples_to_the_nanosecond_and_angles_take_the_short_way():
    angle = make_series([0, S, 2 * S], [350.0, 10.0, 190.5])
    values = interpolate(angle, np.array([0, S // 2, 3 * S // 4, S, 3 * S // 2]), is_angle=True)
    assert values % 360.0 == pytest.approx([350.0, 0.0, 5.0, 10.0, 280.25])
    line = make_series([UTC_NS, UTC_NS + 4], [1.0, 3.0])
    assert interpolate(line, UTC_NS + np.arange(5)) == pytest.approx([1.0, 1.5, 2.0, 2.5, 3.0])


def test_gaps_and_the_time_outside_say_nothing():
    series = make_series([0, S, S + MAX_SAMPLE_GAP_NS + 1], [1.0, 2.0, 4.0])
    moments = np.array([-S, -1, S // 2, S, S + 1, 2 * S, S + MAX_SAMPLE_GAP_NS + 1, 9 * S])
    known = np.isfinite(interpolate(series, moments))
    assert known.tolist() == [False, True, True, True, False, False, True, False]


def test_a_series_is_sorted_and_without_samples_that_are_no_numbers():
    series = make_series([3, 1, 2, 2, 4], [30.0, 10.0, 20.0, 99.0, math.nan], [True] * 5)
    assert (series.stamps_ns.tolist(), series.values.tolist()) == ([1, 2, 3], [10.0, 20.0, 30.0])
    assert make_series([1], [math.inf]) is None
    one = interpolate(make_series([S], [7.0]), np.array([S, 2 * S]))
    assert one[0] == 7.0
    assert np.isnan(one[1])


# -------------------------------------------------------------------------------------------------- DataFlash


def test_dataflash_in_the_engines_units(tmp_path):
    log = open_log(dataflash_flight(tmp_path / "1.BIN"))
    (first, row, late), heights = at(log, 60.0, 62.5, 68.5)
    assert (first.roll_deg, first.pitch_deg, first.heading_deg) == pytest.approx((10.0, -5.0, 350.0))
    assert (row.heading_deg, late.heading_deg) == pytest.approx((355.0, 7.0))
    assert (row.east_velocity_mps, row.north_velocity_mps) == pytest.approx((-0.5, 8.0))
    assert (row.lat_deg, row.lon_deg, row.sigma_m) == pytest.approx((32.50025, 35.25, 1.5), abs=1e-9)
    assert row.alt_amsl_m == pytest.approx(702.5)
    lean = math.cos(math.radians(10)) * math.cos(math.radians(5))
    assert (row.height_agl_m, late.height_agl_m) == pytest.approx((50.0 * lean, 98.5))
    assert heights == {"rangefinder": 2, "terrain": 1}
    assert log.utc_ns == UTC_NS - 60 * S


def test_of_messages_that_are_not_good_none_is_used(tmp_path):
    bad = [("RFND", 60_000_000, 0, 3.0, 2, 25), ("RFND", 60_500_000, 0, 3.0, 4, 0), ("TERR", 61_000_000, 1, 5.0)]
    place = ("POS", 60_000_000, 0, 0, 700.0, 120.0, 0.0), ("POS", 61_000_000, 0, 0, 700.0, 120.0, 0.0)
    log = open_log(write_dataflash(tmp_path / "1.bin", [*bad, *place]))
    rows, heights = at(log, 60.5)
    assert (rows[0].height_agl_m, rows[0].lat_deg, rows[0].sigma_m) == (120.0, None, None)
    assert heights == {"take-off": 1}


def test_without_an_estimator_the_receiver_says_where_and_how_fast(tmp_path):
    said = 0, 3, log_files.GPS_MS, log_files.GPS_WEEK, 325_000_000, -352_500_000, 71_250, 8.0, 210.0
    gps = [("GPS", us, *said) for us in (500_000, 1_000_000)]
    (row,), heights = at(open_log(write_dataflash(tmp_path / "1.bin", gps)), 0.75)
    assert (row.lat_deg, row.lon_deg, row.alt_amsl_m) == pytest.approx((32.5, -35.25, 712.5))
    assert (row.east_velocity_mps, row.north_velocity_mps) == pytest.approx((-4.0, -8.0 * math.sqrt(0.75)))
    assert heights == {}


def test_frames_stamped_in_utc_are_brought_to_the_logs_clock(tmp_path):
    path = dataflash_flight(tmp_path / "1.BIN")
    stamp_ns = UTC_NS + 2 * S + S // 2
    (row,), _ = rows_and_sources_at(open_log(path), [stamp_ns], ["a.png"])
    assert (row.timestamp_ns, row.heading_deg) == (stamp_ns, pytest.approx(355.0))
    truth = open_truth(path, stamp_ns)
    assert [t.timestamp_ns - UTC_NS for t in truth] == [k * S for k in range(11)]
    assert [t.timestamp_ns for t in open_truth(path)] == [(60 + k) * S for k in range(11)]
    assert (truth[3].lat_deg, truth[3].alt_amsl_m, truth[3].heading_deg) == pytest.approx((32.5003, 703.0, 356.0))
    without = write_dataflash(tmp_path / "2.BIN", [("ATT", 1_000_000, 0, 0, 0)])
    assert "expected GPS time" in refusal(rows_and_sources_at, open_log(without), [stamp_ns], ["a.png"])
    assert "expected positions to serve as truth" in refusal(open_truth, without)


# ------------------------------------------------------------------------------------------------------- ULog


def test_ulog_in_the_engines_units(tmp_path):
    log = open_log(ulog_flight(tmp_path / "1.ulg"))
    rows, heights = at(log, 30.0, 30.5, 32.5, 34.0)
    first = rows[0]
    assert (first.roll_deg, first.pitch_deg, first.heading_deg) == pytest.approx((12.0, -7.0, 350.0), abs=1e-4)
    assert rows[1].heading_deg == pytest.approx(355.0, abs=1e-4)
    assert (rows[1].north_velocity_mps, rows[1].east_velocity_mps) == (3.0, -4.0)
    assert (rows[2].lat_deg, rows[2].lon_deg, rows[2].sigma_m) == pytest.approx((47.500025, 8.25, 0.75), abs=1e-9)
    lean = math.cos(math.radians(12)) * math.cos(math.radians(7))
    assert [row.height_agl_m for row in rows] == pytest.approx([30.0 * lean, 30.0 * lean, 60.0, 74.0], rel=1e-5)
    assert heights == {"rangefinder": 2, "terrain": 1, "take-off": 1}
    assert log.utc_ns == UTC_NS - 30 * S


def test_ulog_of_the_receiver_alone_is_in_whole_units(tmp_path):
    without = ("vehicle_global_position", "distance_sensor")
    (row,), _ = at(open_log(ulog_flight(tmp_path / "1.ulg", without=without)), 31.0)
    assert (row.lat_deg, row.lon_deg, row.alt_amsl_m, row.sigma_m) == pytest.approx((47.5, 8.25, 500.0, 1.0))


def test_an_estimators_own_topics_stand_for_those_of_the_vehicle(tmp_path):
    moments = (30.0, 31.5, 33.0)
    usual = at(open_log(ulog_flight(tmp_path / "1.ulg")), *moments)
    renamed = open_log(ulog_flight(tmp_path / "2.ulg", names=ELSE))
    assert at(renamed, *moments) == usual
    assert renamed.utc_ns == UTC_NS - 30 * S


# -------------------------------------------------------------------------------------------------------- SRT

NEW = """{k}
00:00:0{k},000 --> 00:00:0{k},033
<font size="28">FrameCnt: {k}, DiffTime: 33ms
2023-11-14 22:13:2{k}.123
[iso: 100] [shutter: 1/1000.0] [fnum: 2.8] [ev: 0] [latitude: 32.50{k}] [{longitude}: -35.250000] \
[rel_alt: 8{k}.500 abs_alt: 712.300] [gb_yaw: {yaw} gb_pitch: -90.0 gb_roll: 0.0] </font>

"""
OLD = """{k}
00:00:0{k},000 --> 00:00:0{k},500
HOME(-35.2500,32.5000) 2017.05.06 12:13:1{k}
GPS(-35.2500,32.50{k},17) BAROMETER:8{k}.5
ISO:100 Shutter:320 EV:0 Fnum:F2.8

"""
MINI = """{k}
00:00:0{k},000 --> 00:00:0{k},500
F/2.8, SS 206.14, ISO 150, EV 0, DZOOM 1.000, GPS (-35.2500, 32.50{k}, 17), D 24.35m, H 8{k}.5m, H.S 0.00m/s

"""


@pytest.mark.parametrize(
    "cue", [NEW.replace("{longitude}", "longitude"), NEW.replace("{longitude}", "longtitude"), OLD, MINI]
)
def test_both_kinds_of_subtitles(cue, tmp_path):
    text = "".join(cue.format(k=k, yaw=-10.0 + 20.0 * k) for k in range(3)).replace("\n", "\r\n")
    (tmp_path / "v.SRT").write_bytes(b"\xef\xbb\xbf" + text.encode())
    rows, heights = at(open_log(tmp_path / "v.SRT"), 0.0, 0.5, 2.05)
    assert [row.lat_deg for row in rows] == pytest.approx([32.5, 32.5005, 32.502], abs=1e-9)
    assert rows[0].lon_deg == pytest.approx(-35.25)
    assert [row.height_agl_m for row in rows] == pytest.approx([80.5, 81.0, 82.5])
    assert heights == {"take-off": 3}
    if "gb_yaw" in cue:
        assert rows[0].heading_deg == pytest.approx(350.0)
        assert (rows[1].heading_deg + 180.0) % 360.0 == pytest.approx(180.0)
        level = rows[1].roll_deg, rows[1].pitch_deg, rows[1].alt_amsl_m
        assert level == pytest.approx((0.0, 0.0, 712.3), abs=1e-9)


def test_a_gimbal_before_the_vertical_is_a_body_with_its_nose_up(tmp_path):
    text = NEW.replace("{longitude}", "longitude").replace("gb_pitch: -90.0", "gb_pitch: -80.0")
    (tmp_path / "v.srt").write_text(text.format(k=0, yaw=40.0))
    (row,), _ = at(open_log(tmp_path / "v.srt"), 0.0)
    assert (row.roll_deg, row.pitch_deg, row.heading_deg) == pytest.approx((0.0, 10.0, 40.0), abs=1e-9)


# ------------------------------------------------------------------------------------------- the frames' stamps


@pytest.fixture
def pictures(tmp_path):
    return write_pictures(tmp_path / "frames", {"1.png": 1, "2.png": 2, "10.png": 10})


def cams(*seconds):
    return [("CAM", round(s * 1e6), k) for k, s in enumerate(seconds)]


def test_camera_messages_stamp_pictures_in_their_order(pictures, tmp_path):
    log = dataflash_flight(tmp_path / "1.BIN", more=cams(61.0, 62.0, 64.5))
    flight = open_flight(pictures, log)
    assert [row.frame for row in flight.rows] == ["1.png", "2.png", "10.png"]
    assert [row.timestamp_ns for row in flight.rows] == [61 * S, 62 * S, 64 * S + S // 2]
    assert [item.frame.heading_deg for item in flight] == pytest.approx([352.0, 354.0, 359.0])
    assert flight.heights == {"rangefinder": 3}
    late = open_flight(pictures, log, log_offset_s=0.25)
    assert [row.timestamp_ns for row in late.rows] == [61 * S + S // 4, 62 * S + S // 4, 64 * S + 3 * S // 4]
    more = ulog_flight(tmp_path / "1.ulg", more=[("camera_capture", us, 0) for us in (30_500_000, 31, 31_500_000)])
    assert [row.timestamp_ns for row in open_flight(pictures, more).rows] == [31_000, 61 * S // 2, 63 * S // 2]


def test_a_list_of_frames_stamps_them(pictures, tmp_path):
    log, stamps = dataflash_flight(tmp_path / "1.BIN"), tmp_path / "stamps.csv"
    stamps.write_text("timestamp_ns,frame\n0,1.png\n2500000000,10.png\n")
    flight = open_flight(pictures, log, frame_stamps=stamps, log_offset_s=60.0)
    assert [(row.frame, row.timestamp_ns) for row in flight.rows] == [("1.png", 60 * S), ("10.png", 125 * S // 2)]
    assert [row.heading_deg for row in flight.rows] == pytest.approx([350.0, 355.0])
    message = refusal(open_flight, pictures, log, frame_stamps=stamps)
    assert "expected frames taken from 60.000 to 70.000 s of the log, got frames from 0.000 to 2.500 s" in message
    assert "`log_offset_s`" in message


FRAME = """<font size="28">{count}2023-11-14 22:13:20.123
[latitude: 32.5000{n:02d}] [longitude: -35.250000] [rel_alt: 80.500 abs_alt: 712.300] {gimbal}</font>"""


def subtitles(path, frames=60, count="FrameCnt: {n}, DiffTime: 33ms\n", gimbal="", step_ms=40):
    """Subtitles of a video at 25 Hz, a cue a frame."""
    texts = (FRAME.format(n=n, count=count.format(n=n), gimbal=gimbal) for n in range(1, frames + 1))
    return write_subtitles(path, texts, step_ms)


def extracted(folder, names):
    return write_pictures(folder, dict.fromkeys(names, 0))


@pytest.mark.parametrize("ending", ["SRT", "srt"])
def test_subtitles_beside_a_video_are_taken(tmp_path, ending):
    path = tmp_path / "DJI_0001.mp4"
    write_video(path, [40 * k for k in range(5)], size=(32, 32), codec="mp4v")
    assert not open_flight(path).rows
    subtitles(tmp_path / f"DJI_0001.{ending}", gimbal="[gb_yaw: 20.0 gb_pitch: -90.0 gb_roll: 0.0]")
    flight = open_flight(path)
    assert [row.timestamp_ns for row in flight.rows] == [k * S // 25 for k in range(5)]
    assert [row.lat_deg for row in flight.rows] == pytest.approx([32.5 + 1e-6 * (k + 1) for k in range(5)])
    assert [row.heading_deg for row in flight.rows] == pytest.approx([20.0] * 5)
    assert flight.has_gimbal
    assert {row.height_sigma_m for row in flight.rows} == {take_off_sigma_m(80.5)}
    assert {row.prior.sigma_m for row in flight.rows} == {15.0}


@pytest.mark.parametrize("count", ["FrameCnt: {n}, DiffTime: 33ms\n", "SrtCnt : {n}, DiffTime : 33ms\n"])
@pytest.mark.parametrize(
    ("names", "frames"),
    [
        (["f_0000.png", "f_0030.png", "f_0045.png"], [0, 30, 45]),  # from 0, as OpenCV counts
        (["DJI_0001_frame0001.png", "DJI_0001_frame0026.png"], [0, 25]),  # from 1, as ffmpeg does
        ([f"{k}.png" for k in range(1, 61)], list(range(60))),
    ],
)
def test_extracted_frames_are_stamped_by_their_numbers(tmp_path, names, frames, count):
    log = subtitles(tmp_path / "DJI_0001.SRT", count=count)
    flight = open_flight(extracted(tmp_path / "frames", names), log)
    assert [row.frame for row in flight.rows] == names
    assert [row.timestamp_ns for row in flight.rows] == [k * S // 25 for k in frames]
    assert [row.lat_deg for row in flight.rows] == pytest.approx([32.5 + 1e-6 * (k + 1) for k in frames])


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["a.png", "b.png"], "expected pictures with the numbers of the video's frames in their names, or"),
        (["1_a.png", "01_b.png"], "expected pictures with the numbers"),
        (["1.png", "90.png"], "got number 90 for a video of 60 frames"),
        (["1.png", "2.png", "3.png"], "got 1 to 3 without a gap for a video of 60 frames"),
    ],
)
def test_numbers_that_are_none_of_the_video_are_refused(tmp_path, names, said):
    log, folder = subtitles(tmp_path / "v.SRT"), extracted(tmp_path / "frames", names)
    assert said in refusal(open_flight, folder, log)


def test_of_a_cue_a_second_each_is_of_one_picture(tmp_path):
    log = subtitles(tmp_path / "v.SRT", frames=3, count="", step_ms=1000)
    flight = open_flight(extracted(tmp_path / "frames", ["1.png", "2.png", "3.png"]), log)
    assert [row.timestamp_ns for row in flight.rows] == [0, S, 2 * S]
    other = extracted(tmp_path / "other", ["1.png", "31.png"])
    assert "for each of 2 pictures, got 3; give their times" in refusal(open_flight, other, log)


def test_a_gimbal_of_zeros_in_subtitles_is_none(tmp_path):
    log = subtitles(tmp_path / "v.SRT", gimbal="[gb_yaw: 0.0 gb_pitch: 0.0 gb_roll: 0.0]")
    flight = open_flight(extracted(tmp_path / "frames", ["1.png", "50.png"]), log)
    assert [(row.roll_deg, row.pitch_deg, row.heading_deg) for row in flight.rows] == [(None, None, None)] * 2
    assert not flight.has_gimbal


def test_where_nothing_stamps_the_frames_the_message_says_how(pictures, tmp_path):
    log = dataflash_flight(tmp_path / "1.BIN")
    assert "no `frame_stamps` was given" in refusal(open_flight, pictures, log)
    message = refusal(open_flight, pictures, dataflash_flight(tmp_path / "2.BIN", more=cams(61.0, 62.0)))
    assert "expected a camera message for each of 3 pictures, got 2" in message
    message = misuse(open_flight, pictures, log, log_offset_s=math.inf)
    assert "log_offset_s: expected finite seconds" in message


def test_exif_times_stamp_photographs(monkeypatch, pictures, tmp_path):
    log = open_log(dataflash_flight(tmp_path / "1.BIN"))
    rows = [SimpleNamespace(timestamp_ns=UTC_NS + k * S, frame=f"{k}.png") for k in (1, 2)]
    monkeypatch.setattr("scenematch.files.logs.readers.photo_telemetry", lambda _: (rows, []))
    stamps_ns, names = stamp_frames(SimpleNamespace(path=pictures, names=["1.png", "2.png"]), log)
    assert (stamps_ns, names) == ([UTC_NS + S, UTC_NS + 2 * S], ["1.png", "2.png"])


# -------------------------------------------------------------------------------------------------- bad files


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.srt", b"", "expected a flight log, got an empty file"),
        ("a.BIN", b"ULog\x01\x12\x35" + bytes(20), "which begins with A3 95 80, got 55 4c 6f"),
        ("a.ulg", b"\xa3\x95\x80" + bytes(20), "which begins with 'ULog' 01 12 35, got a3 95 80"),
        ("a.ulg", b"ULog", "which begins with 'ULog'"),
        ("a.srt", b"\xff\xd8\xff\xe0 jpeg", "expected subtitles as UTF-8 text, got the byte 0xff"),
        ("a.srt", b"hello", "expected subtitles with 00:00:00,000 --> 00:00:00,033, got none"),
        ("a.srt", b"1\n00:00:01,000 --> 00:00:02,000\nGood morning.\n", "got a log with none of them"),
        ("a.BIN", b"\xa3\x95\x80" + bytes(40), "a.BIN: expected"),
        ("a.ulg", b"ULog\x01\x12\x35\x01" + bytes(8), "a.ulg: expected"),
    ],
)
def test_foreign_and_empty_files_are_refused_in_one_line(name, content, said, save):
    message = refusal(open_log, save(content, name))
    assert name in message
    assert said in message


def test_a_file_that_is_missing_or_a_folder(tmp_path, save):
    assert refusal(open_log, tmp_path / "a.BIN").endswith("a.BIN: no such file")
    (tmp_path / "b.ulg").mkdir()
    assert "cannot be read" in refusal(open_log, tmp_path / "b.ulg")
    assert "expected a log named .bin, .ulg, .srt" in refusal(open_log, save("x", "a.txt"))


def test_a_ulog_that_leads_its_parser_in_circles_is_refused(save):
    """The last message ends behind the file, and is longer than pyulog believes: alone, it goes back for ever."""
    head = b"ULog\x01\x12\x35\x01" + bytes(8) + ulog_message("B", bytes(40))
    data = head + ulog_message("I", bytes(30_000)) + struct.pack("<HB", 0x3030, ord("z")) + bytes(10)
    assert "its definitions are damaged" in refusal(open_log, save(data, "a.ulg"))


@pytest.mark.parametrize("count", [40, pytest.param(150, marks=pytest.mark.slow)])
def test_mutated_files_are_read_or_refused(count, capfd):
    """In one line and in time, and no parser prints; logs, bags, tables and routes."""
    from bench.live.fuzz_files import fuzz

    done = fuzz(count=count, seed=2)
    assert len(done.outcomes) == 11
    assert all(stated.total() == count > stated["refused"] > 0 for stated in done.outcomes.values())
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("piece", [" ", "\n", "a.", "<", "GPS(1,2,", "a  ", "1", "a:"])
def test_no_text_takes_longer_than_its_length(piece, save):
    text = "1\n00:00:01,000 --> 00:00:02,000\na" + piece * 100_000 + "[rel_alt: 5.0]"
    (row,), _ = at(open_log(save(text, "a.srt")), 1.0)
    assert row.height_agl_m == 5.0


def test_a_format_of_length_zero_ends(tmp_path, save):
    data = bytearray(dataflash_flight(tmp_path / "a.BIN").read_bytes())
    data[89 + 4] = 0  # of the second format, that of ATT
    (row,), _ = at(open_log(save(bytes(data), "b.BIN")), 60.0)
    assert (row.heading_deg, row.lat_deg) == (None, pytest.approx(32.5))


def test_what_lies_between_messages_is_skipped(tmp_path, save):
    whole = dataflash_flight(tmp_path / "a.BIN").read_bytes()
    first = whole.index(b"\xa3\x95\x02", 9 * 89)  # the first POS, after the formats
    data = whole[:first] + b"\xa3\x95\xff noise \xa3" + whole[first:]
    assert at(open_log(save(data, "b.BIN")), 60.0, 65.0) == at(open_log(tmp_path / "a.BIN"), 60.0, 65.0)


def test_dataflash_is_read_as_pymavlink_reads_it(tmp_path):
    from pymavlink.DFReader import DFReader_binary

    path = dataflash_flight(tmp_path / "a.BIN")
    reader, log, count = DFReader_binary(str(path)), open_log(path), 0
    while (message := reader.recv_match(type=["ATT", "POS"])) is not None:
        (row,), _ = at(log, message.TimeUS / 1e6)
        count += 1
        if message.get_type() == "ATT":
            stated = (message.Roll, message.Pitch, message.Yaw % 360.0)
            assert (row.roll_deg, row.pitch_deg, row.heading_deg) == pytest.approx(stated)
        else:
            stated = (message.Lat, message.Lng, message.Alt)
            assert (row.lat_deg, row.lon_deg, row.alt_amsl_m) == pytest.approx(stated)
    reader.close()
    assert count == 22


# ----------------------------------------------------------------------------------------- at the command line


@pytest.mark.usefixtures("bare_runs")
def test_a_flight_is_followed_by_its_log_and_scored_by_it(flight_in, tmp_path, capfd):
    """And scored again by the record of how its frames were stamped: half a second before the log."""
    folder, stamps, out = tmp_path / "flown", tmp_path / "stamps.csv", tmp_path / "out"
    flight_in(folder, frames=3)
    truth, messages, lines = read_truth(folder / "truth.csv"), [], ["timestamp_ns,frame"]
    for row in read_telemetry(folder / "telemetry.csv"):
        us, place = row.timestamp_ns // 1000, interpolate_truth(truth, row.timestamp_ns)
        lat, lon = round(place.lat_deg * 1e7), round(place.lon_deg * 1e7)
        angles = (row.roll_deg, row.pitch_deg, row.heading_deg)
        messages += [
            ("ATT", us, *(round(angle * 100) for angle in angles)),
            ("POS", us, lat, lon, 0.0, row.height_agl_m, 0.0),
            ("XKF1", us, 0, row.north_velocity_mps or 0.0, row.east_velocity_mps or 0.0),
        ]
        lines.append(f"{(us - 500_000) * 1000},{row.frame}")
    log = write_dataflash(folder / "flight.BIN", messages)
    stamps.write_text("\n".join(lines) + "\n", encoding="utf-8")
    files = file_options(folder, surface=None, telemetry=log, truth=log)
    said = (f"frame_stamps={stamps}", "log_offset_s=0.5", "map_sigma_m=2")
    assert run(["track", *files, *(f"--settings=input.{text}" for text in said), f"--out={out}", "--json"]) == 0
    printed = capfd.readouterr()
    assert "height above ground of 3 frames, by source: take-off 3" in printed.err
    summary = json.loads(printed.out)
    assert summary["fixes"] == summary["scored_fixes"] == 3
    assert summary["rms_m"] < 1.0
    assert summary["settings"]["heights"] == {"take-off": 3}
    before = [(out / name).read_bytes() for name in ("report.html", "summary.json")]
    assert b"No frames are shown" not in before[0]
    assert all(word in before[0] for word in (str(stamps).encode(), b"<td>log offset (s)</td>", b"map sigma (m)"))
    assert answer(capfd, ["evaluate", out]) == summary
    assert [(out / name).read_bytes() for name in ("report.html", "summary.json")] == before
