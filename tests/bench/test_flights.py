"""The score of a flight with faults."""

from types import SimpleNamespace

import numpy as np
import pytest

from engine.geo import LocalFrame

pytest.importorskip("pymavlink", reason="pymavlink is not installed")
from bench.live.flights.camera import shown_picture
from bench.live.flights.faults import FAULTS
from bench.live.flights.fly import report
from bench.live.flights.recorded import captured_s, off_m
from bench.live.standin import State


def test_a_fault_is_scored_by_the_first_fix_after_its_end():
    scored = [(1.0, 0.1, 10.0), (17.0, 9.0, 10.0), (20.5, 0.3, 10.0), (36.0, 0.4, 20.0)]
    lines = report(scored, "begun", FAULTS).splitlines()
    assert "| 4 | 4.51 | 0.35 | 9.00 | 1 | 10, 20 |" in lines
    assert "| bridge killed 3 s | 2.50 | 0.30 | 14.5 |" in lines
    assert "| worker killed | 1.00 | 0.40 | 9.0 |" in lines
    assert "| camera covered 10 s | none | | 20.0 |" in lines


def test_a_flight_without_faults_has_no_table_of_them_and_one_without_fixes_says_so():
    assert "fault" not in report([(1.0, 0.1, 10.0)], "begun")
    assert report([], "begun", FAULTS) == "begun\n\nno fixes"


def test_a_global_position_is_stamped_when_it_is_sent_and_says_how_long_it_took():
    sensor = SimpleNamespace(
        get_type=lambda: "GLOBAL_POSITION_SENSOR", time_usec=5_300_000, processing_time=300_000
    )
    assert captured_s(sensor) == pytest.approx(5.0)
    estimate = SimpleNamespace(get_type=lambda: "VISION_POSITION_ESTIMATE", usec=5_000_000)
    assert captured_s(estimate) == pytest.approx(5.0)


def test_a_fault_covers_the_camera_or_freezes_its_picture():
    frames = [bytes([number]) for number in range(100)]
    shown = [shown_picture(frames, b"black", second, 1.0) for second in (44, 45, 54, 55, 64, 66, 70, 71)]
    assert shown == [frames[44], b"black", b"black", frames[55], frames[64], frames[65], frames[65], frames[71]]


def test_a_fix_is_scored_about_the_origin_that_the_autopilot_has():
    place, state = LocalFrame(48.25, 16.45), State(10.0, 20.0, 100.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    lat_deg, lon_deg = place.geodetic_from_enu(4.0, 5.0)
    pilot = SimpleNamespace(place=place, origin=(round(float(lat_deg) * 1e7), round(float(lon_deg) * 1e7), 0))
    fix = SimpleNamespace(get_type=lambda: "VISION_POSITION_ESTIMATE", usec=0, x=15.0, y=6.0)
    assert off_m(fix, lambda _: state, pilot) == pytest.approx(0.0, abs=0.02)
    pilot.origin = None
    assert off_m(fix, lambda _: state, pilot) == pytest.approx(np.hypot(4.0, 5.0), abs=0.02)
