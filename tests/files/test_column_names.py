"""Telemetry with the columns of other programs: named in the settings, or told as not read."""

import pytest

from engine.errors import OptionError
from scenematch import MapInput, TrackSettings
from scenematch.files.telemetry import open_telemetry
from scenematch.runs.inputs import FlightFiles, open_inputs
from tests.support.photos import write_pictures
from tests.support.refusals import misuse, refusal

OTHERS = "time_us,Image Name,altitude_agl [m],Yaw,Latitude,Longitude,battery\n0,0.png,120.5,-90,48.5,16.5,99\n"
MORE = "500000,1.png,121.5,-91,48.5,16.5,98\n"
NAMES = {
    "timestamp_us": "time_us", "frame": "Image Name", "height_agl_m": "altitude_agl [m]", "heading_deg": "Yaw",
    "lat_deg": "Latitude", "lon_deg": "Longitude",
}  # fmt: skip


PLACE = "[telemetry_columns] of the settings names those that are ours"


def test_named_columns_are_read_and_the_others_told_in_one_line(save):
    names = {ours: theirs for ours, theirs in NAMES.items() if theirs != "Yaw"}
    rows, remarks = open_telemetry(save(OTHERS + MORE), names=names)
    row = rows[1]
    assert (row.timestamp_ns, row.frame, row.height_agl_m, row.heading_deg) == (500_000_000, "1.png", 121.5, None)
    assert (row.lat_deg, row.lon_deg) == (48.5, 16.5)
    assert remarks == ["telemetry.csv: columns that are not read: Yaw, battery; " + PLACE]


def test_a_missing_required_column_is_told_with_those_that_are_there(save):
    message = refusal(open_telemetry, save("speed,frame\n1,a.png\n"))
    assert message.endswith("line 1: lacks the column timestamp_ns; its columns are 'speed,frame'; " + PLACE)
    message = refusal(open_telemetry, save(OTHERS), names={"timestamp_us": "time_us"})
    assert "lacks the column frame; its columns are 'time_us,Image Name," in message


def test_a_name_that_the_file_lacks_is_refused(save):
    message = refusal(open_telemetry, save(OTHERS), names=NAMES | {"height_agl_m": "alt"})
    assert "line 1: lacks the column alt, which the settings name as height_agl_m" in message


def test_a_run_reads_them_by_its_settings(tmp_path, save):
    frames = write_pictures(tmp_path / "frames", {"0.png": 0, "1.png": 0})
    given = {"map": "none.tif", "frames": frames, "hfov_deg": 60.0}
    flight = FlightFiles.from_flat(**given, telemetry=save(OTHERS + MORE)).open_flight(NAMES)
    assert [row.height_agl_m for row in flight.rows] == [120.5, 121.5]
    assert len(flight.remarks) == 1
    with pytest.raises(OptionError, match="telemetry_columns: expected a table as telemetry, got None"):
        FlightFiles.from_flat(**given).open_flight({"frame": "image"})


def test_runs_of_one_flight_name_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(MapInput, "open", lambda self, progress: None)
    files = FlightFiles.from_flat(map="none.tif", frames=tmp_path, hfov_deg=60.0)
    runs = [TrackSettings(), TrackSettings(telemetry_columns={"frame": "image"})]
    assert "telemetry_columns: expected the same of all runs" in misuse(open_inputs, files, runs)
