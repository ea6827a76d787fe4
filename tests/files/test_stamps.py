"""Stamps in other units, dates, semicolons and decimal commas: read, said, or refused."""

import csv
import datetime

import pytest

from scenematch.files.flight import open_flight
from scenematch.files.telemetry import open_telemetry, read_telemetry
from scenematch.files.truth import read_truth
from tests.support.photos import write_pictures
from tests.support.refusals import refusal

NS = [k * 500_000_000 for k in range(60)]
BOOT_NS = [12_345_000_000 + ns for ns in NS]
UTC_NS = [1_777_636_800_250_000_000 + ns for ns in NS]


def table(path, stamps, column="timestamp_ns", delimiter=",", more=()):
    """What a spreadsheet or csv.writer makes of a list."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, delimiter=delimiter)
        writer.writerow([column, "frame", *(name for name, _ in more)])
        writer.writerows([stamp, f"{k}.jpg", *(v for _, v in more)] for k, stamp in enumerate(stamps))
    return path


def stamps(path):
    return [row.timestamp_ns for row in read_telemetry(path)]


@pytest.mark.parametrize("truth_ns", [NS, BOOT_NS, UTC_NS], ids=["from 0", "boot", "UTC"])
@pytest.mark.parametrize(
    ("per_s", "word"),
    [(1, "seconds"), (10**3, "milliseconds"), (10**6, "microseconds"), (10**9, None)],
)
def test_the_unit_is_recognised_and_said_in_one_line(tmp_path, truth_ns, per_s, word):
    given = [ns / 10**9 if per_s == 1 else ns * per_s // 10**9 for ns in truth_ns]
    rows, remarks = open_telemetry(table(tmp_path / "t.csv", given))
    assert [row.timestamp_ns for row in rows] == pytest.approx(truth_ns, abs=0, rel=1e-15)
    said = [] if word is None else [f"t.csv: timestamp_ns is taken as {word}"]
    assert [remark.split(":")[:2] for remark in remarks] == [line.split(":") for line in said]


@pytest.mark.parametrize(
    ("column", "per_s"), [("timestamp_us", 10**6), ("timestamp_ms", 10**3), ("timestamp_s", 1)]
)
def test_a_name_that_states_the_unit_needs_no_words(tmp_path, column, per_s):
    rows, remarks = open_telemetry(table(tmp_path / "t.csv", [k * 10 * per_s for k in range(5)], column))
    assert remarks == []
    assert [row.timestamp_ns for row in rows] == [k * 10**10 for k in range(5)]


def test_microseconds_of_utc_between_photographs_are_not_nanoseconds(tmp_path):
    path = table(tmp_path / "t.csv", [1_777_636_800_000_000 + 2_000_000 * k for k in range(9)])
    assert stamps(path)[:2] == [1_777_636_800_000_000_000, 1_777_636_802_000_000_000]


def test_dates_as_python_writes_them(tmp_path):
    start = datetime.datetime(2026, 5, 1, 14, 0, 0, 250_000, datetime.timezone(datetime.timedelta(hours=2)))
    given = [(start + datetime.timedelta(milliseconds=500 * k)).isoformat() for k in range(60)]
    rows, remarks = open_telemetry(table(tmp_path / "t.csv", given))
    assert [row.timestamp_ns for row in rows] == UTC_NS
    assert remarks == []


def test_dates_without_a_zone_are_utc_and_said(tmp_path):
    moments = [datetime.datetime.fromtimestamp(ns / 1e9, datetime.UTC) for ns in UTC_NS]
    given = [moment.strftime("%Y-%m-%d %H:%M:%S.%f")[:-3] for moment in moments]  # as a database writes them
    rows, remarks = open_telemetry(table(tmp_path / "t.csv", given))
    assert [row.timestamp_ns for row in rows] == UTC_NS
    assert remarks == ["t.csv: timestamp_ns holds dates without a time zone, taken as UTC"]
    assert open_telemetry(table(tmp_path / "t.csv", given, "timestamp_utc"))[1] == []


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("1970-01-01T00:00:00Z", 0),
        ("2026-05-01T12:00:00.123456789Z", 1_777_636_800_123_456_789),
        ("2026/05/01 12:00:00,5 UTC", 1_777_636_800_500_000_000),
        ("2026-05-01T06:30:00-05:30", 1_777_636_800_000_000_000),
        ("2024-02-29T00:00:00+0000", 1_709_164_800_000_000_000),
        ("2016-12-31T23:59:60.5Z", 1_483_228_800_500_000_000),  # a leap second
    ],
)
def test_a_date_to_the_nanosecond(save, text, ns):
    assert stamps(save(f'timestamp_utc,frame\n"{text}",a.jpg\n')) == [ns]


REFUSED = {
    "ambiguous": ([10, 20, 30],
     "rows 10 apart, which may be milliseconds or seconds: name the column timestamp_ms or"),
    "too dense": ([0, 0.001, 0.002], "rows 0.001 apart, which is no camera's"),
    "seconds that would not fit": ([10**15, 10**15 + 1], "rows 1 apart, which is no camera's"),
    "a date that is none": (["2026-02-30T00:00:00Z"], "expected a date in UTC such as"),
    "day first": (["01.05.2026 12:00"], "expected a number or a date in UTC, got '01.05.2026 12:00'"),
    "mixed": (["2026-02-03T00:00:00Z", 5], "line 3, timestamp_ns: expected a date in UTC"),
    "back": ([1.0, 0.5], "line 3, timestamp_ns: expected a stamp later than the row before (1.0), got '0.5'"),
    "a fraction of a nanosecond": ([0.5, 1e9, 2e9], "expected a whole number, got '0.5'"),
    "a name that states a wrong unit": ([0.0, 0.5, 1.0, 1.5],
     "timestamp_ms: expected milliseconds, got rows 0.5 apart, which may be", {"column": "timestamp_ms"}),
    "two decimal marks": ([0, 10**9], "line 2: expected one decimal mark, got '12,5' and '1.234'",
     {"delimiter": ";", "more": [("height_agl_m", "1.234"), ("alt_amsl_m", "12,5")]}),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED, ids=list(REFUSED))
def test_what_cannot_be_told_is_refused(tmp_path, case):
    given, words, *more = REFUSED[case]
    assert words in refusal(read_telemetry, table(tmp_path / "t.csv", given, **dict(*more)))


@pytest.mark.parametrize("delimiter", [";", "\t"])
@pytest.mark.parametrize("mark", [".", ","])
def test_semicolons_and_decimal_commas(tmp_path, delimiter, mark):
    more = [("height_agl_m", f"149{mark}5"), ("lat_deg", f"-33{mark}25"), ("lon_deg", f"1{mark}5e1")]
    rows = read_telemetry(table(tmp_path / "t.csv", ["0", f"0{mark}5"], "timestamp_s", delimiter, more))
    assert [row.timestamp_ns for row in rows] == [0, 500_000_000]
    assert (rows[1].height_agl_m, rows[1].lat_deg, rows[1].lon_deg) == (149.5, -33.25, 15.0)
    assert rows[1].frame == "1.jpg"


def test_the_truth_is_on_the_same_clock(save):
    rows = read_truth(save("timestamp_ns;lat_deg;lon_deg\n0;48,5;16,5\n500;48,5;16,5\n", "truth.csv"))
    assert [(row.timestamp_ns, row.lat_deg) for row in rows] == [(0, 48.5), (500_000_000, 48.5)]


def test_a_flight_says_how_it_was_read(tmp_path):
    frames = write_pictures(tmp_path / "frames", {f"{k}.jpg": 0 for k in range(3)})
    flight = open_flight(frames, table(tmp_path / "telemetry.csv", [0, 33, 67]))
    assert list(flight.remarks) == ["telemetry.csv: timestamp_ns is taken as milliseconds: rows are 33.5 apart"]
    assert [row.timestamp_ns for row in flight.rows] == [0, 33_000_000, 67_000_000]
