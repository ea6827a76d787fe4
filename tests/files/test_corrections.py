"""Corrections of telemetry: units, signs, swapped columns, offsets and a clock, and what is refused."""

import math
from dataclasses import replace

import pytest

from engine.errors import OptionError, TelemetryError
from scenematch.files.corrections import Corrections
from scenematch.files.telemetry import TelemetryRow
from tests.support.refusals import misuse, refusal

ROW = TelemetryRow(
    timestamp_ns=1_000_000_000, frame="a.jpg", height_agl_m=100.0, roll_deg=3.0, pitch_deg=-4.0, heading_deg=350.0,
    east_velocity_mps=1.0, north_velocity_mps=2.0,
)  # fmt: skip


def corrected(row=ROW, **given):
    return Corrections(**given).applied([row])[0]


def test_the_defaults_change_nothing():
    assert Corrections().changes_nothing
    assert Corrections().applied([ROW]) == [ROW]


def test_radians_become_degrees():
    row = corrected(replace(ROW, roll_deg=0.1, pitch_deg=-0.2, heading_deg=3.0), angles="radians")
    angles_deg = [math.degrees(v) for v in (0.1, -0.2, 3.0)]
    assert [row.roll_deg, row.pitch_deg, row.heading_deg] == pytest.approx(angles_deg)


def test_columns_are_made_of_the_row_as_it_was():
    row = corrected(columns=("roll_deg=pitch_deg", "pitch_deg=-roll_deg"))
    assert (row.roll_deg, row.pitch_deg) == (-4.0, -3.0)
    assert corrected(columns=("height_agl_m=0.3048*height_agl_m",)).height_agl_m == pytest.approx(30.48)
    assert corrected(columns=("heading_deg=-heading_deg+90",)).heading_deg == pytest.approx(100.0)
    assert corrected(columns=("timestamp_ns=1000000*timestamp_ns",)).timestamp_ns == 10**15


def test_offsets_are_added_a_heading_wraps_and_a_height_below_the_ground_becomes_unknown():
    assert corrected(heading_offset_deg=20.0).heading_deg == pytest.approx(10.0)
    assert corrected(height_offset_m=-30.0).height_agl_m == 70.0
    assert corrected(height_offset_m=-120.0).height_agl_m is None  # of one above the sea, before take-off


def test_a_late_telemetry_is_moved_to_its_pictures():
    rows = [replace(ROW, timestamp_ns=k * 10**9, roll_deg=k, heading_deg=(358 + k) % 360) for k in range(6)]
    moved = Corrections(offset_s=-0.5).applied(rows)  # stamps that are 0.5 s too late
    assert [row.roll_deg for row in moved] == pytest.approx([0.5, 1.5, 2.5, 3.5, 4.5, 5.0])
    assert [row.heading_deg for row in moved] == pytest.approx([358.5, 359.5, 0.5, 1.5, 2.5, 3.0])
    assert [row.timestamp_ns for row in moved] == [row.timestamp_ns for row in rows]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"angles": "grads"}, "angles: expected degrees or radians, got 'grads'"),
        ({"columns": ("roll_deg",)}, "columns: expected NAME="),
        ({"columns": ("roll_deg=2*yaw",)}, "columns: expected one of timestamp_ns, "),
        ({"columns": ("roll_deg=pitch_deg", "roll_deg=roll_deg")}, "columns: expected each name once"),
        ({"heading_offset_deg": math.nan}, "heading_offset_deg: expected -360 to 360, got nan"),
        ({"offset_s": 1e9}, "offset_s: expected -100000 to 100000"),
    ],
)
def test_what_cannot_be_is_refused_by_name(given, says):
    with pytest.raises(OptionError, match=says.replace("(", "[(]")):
        Corrections(**given)


def test_what_a_correction_makes_impossible_is_refused_by_frame():
    assert "frame a.jpg: expected pitch_deg of -90 to 90, got -229" in refusal(corrected, angles="radians")
    with pytest.raises(TelemetryError, match=r"frame a\.jpg: expected timestamp_ns of .* got 1e\+209"):
        corrected(columns=("timestamp_ns=1e200*timestamp_ns",))
    assert "columns: expected timestamp_ns of itself only" in misuse(corrected, columns=("timestamp_ns=roll_deg",))


@pytest.mark.parametrize("yaw_rad", [-math.pi / 2, -0.1, 0.5, 3.0, 6.2])
def test_a_yaw_in_radians_keeps_its_sign_though_it_was_read_as_a_heading(yaw_rad):
    row = replace(ROW, roll_deg=0.0, pitch_deg=0.0, heading_deg=yaw_rad % 360.0)
    expected = math.degrees(yaw_rad) % 360.0
    assert corrected(row, angles="radians").heading_deg == pytest.approx(expected)
    assert corrected(row, columns=("heading_deg=57.29577951*heading_deg",)).heading_deg == pytest.approx(expected)
