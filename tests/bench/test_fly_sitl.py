"""The pilot of a simulated vehicle compares the estimate with the simulator's own truth."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

from bench.live.fly_sitl import Pilot, fly_course, report
from bench.live.standin import State
from engine.geo import LocalFrame

PLACE = LocalFrame(33.64, 72.99)
COURSE = np.array([[float(k), 0.0] for k in range(101)])  # due east


def message(kind, **fields):
    return SimpleNamespace(get_type=lambda: kind, **fields)


def degrees_1e7(east_m, north_m):
    lat_deg, lon_deg = PLACE.geodetic_from_enu(east_m, north_m)
    return round(float(lat_deg) * 1e7), round(float(lon_deg) * 1e7)


def test_the_estimate_is_held_against_the_true_state_and_the_course():
    pilot = Pilot(None, PLACE, COURSE)
    lat, lon = degrees_1e7(0.0, 0.0)
    pilot.take(message("GLOBAL_POSITION_INT", lat=0, lon=0, relative_alt=0))  # no position yet
    pilot.take(message("SIM_STATE", lat_int=lat, lon_int=lon))
    assert pilot.errors_m == {}
    pilot.part = "course"
    lat, lon = degrees_1e7(53.0, 1.0)
    pilot.take(message("GLOBAL_POSITION_INT", lat=lat, lon=lon, relative_alt=170_000))
    lat, lon = degrees_1e7(50.0, 5.0)
    pilot.take(message("SIM_STATE", lat_int=lat, lon_int=lon))
    assert pilot.height_m == pytest.approx(170.0)
    assert pilot.errors_m["course"] == [pytest.approx(5.0, abs=0.02)]
    assert pilot.off_course_m["course"] == [pytest.approx(5.0, abs=0.02)]
    assert "course: 1 states, EKF to truth median 5.00" in report(pilot)


def test_targets_have_the_heading_and_the_velocity_of_the_course():
    sent = []
    mav = SimpleNamespace(set_position_target_global_int_send=lambda *fields: sent.append(fields))
    link = SimpleNamespace(mav=mav, recv_match=lambda **_: None)
    state = State(10.0, 20.0, 170.0, 0.0, 0.0, 90.0, 3.0, 4.0)
    fly_course(Pilot(link, PLACE, COURSE), lambda _: state, 0.05)
    fly_course(Pilot(link, PLACE, COURSE), lambda _: state, 0.05, still=True)
    (moving, still) = (fields[5:] for fields in sent)
    assert moving[:2] == degrees_1e7(10.0, 20.0)
    assert (moving[3], moving[4]) == (4.0, 3.0)  # north, east
    assert (still[3], still[4]) == (0.0, 0.0)
    assert moving[9] == pytest.approx(np.pi / 2.0)
