"""The pilot of a simulated vehicle compares the estimate with the simulator's own truth."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="pymavlink is not installed")

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from bench.live.flights import sitl
from bench.live.flights.sitl import Pilot, follow, report
from bench.live.standin import State
from engine.geo import LocalFrame

PLACE = LocalFrame(33.64, 72.99)


def message(kind, **fields):
    return SimpleNamespace(get_type=lambda: kind, **fields)


def degrees_1e7(east_m, north_m):
    lat_deg, lon_deg = PLACE.geodetic_from_enu(east_m, north_m)
    return round(float(lat_deg) * 1e7), round(float(lon_deg) * 1e7)


def test_the_estimate_is_held_against_the_true_state():
    pilot = Pilot(None, PLACE)
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
    assert "| course | 1 | 5.00 | 5.00 |" in report(pilot)


def test_targets_have_the_heading_and_the_velocity_of_the_course():
    sent = []
    mav = SimpleNamespace(set_position_target_global_int_send=lambda *fields: sent.append(fields))
    link = SimpleNamespace(mav=mav, recv_match=lambda **_: None)
    state = State(10.0, 20.0, 170.0, 0.0, 0.0, 90.0, 3.0, 4.0)
    assert follow(Pilot(link, PLACE), lambda _: state, 0.05)
    ((ignored, *target),) = (fields[4:] for fields in sent)
    assert target[:2] == [*degrees_1e7(10.0, 20.0)]
    assert (target[3], target[4]) == (4.0, 3.0)  # north, east
    assert target[9] == pytest.approx(np.pi / 2.0)
    accelerations = (mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE, mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE)
    accelerations += (mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE,)
    assert ignored == sum(accelerations) + mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE


ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def heartbeat(mode, *, armed=True):
    """Of an ArduCopter, in the mode by ArduPilot's number: 4 is GUIDED, 6 RTL, 9 LAND."""
    return message(
        "HEARTBEAT", type=mavlink.MAV_TYPE_QUADROTOR, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        base_mode=ARMED if armed else mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, custom_mode=mode,
        get_srcSystem=lambda: 1, get_srcComponent=lambda: 1,
    )  # fmt: skip


@pytest.mark.parametrize(("mode", "name"), [(9, "LAND"), (6, "RTL")])
def test_a_vehicle_that_lands_by_itself_is_steered_no_more_and_ends_the_flight(monkeypatch, mode, name):
    """A link that plays a failsafe early on, and a landing that takes a while."""
    monkeypatch.setattr(sitl, "take_off", lambda pilot, height_m: None)
    left = [heartbeat(4)] * 3 + [heartbeat(mode)] * 40 + [heartbeat(mode, armed=False)]
    waiting, commands, settings = [], [], []

    def heard(**_):
        time.sleep(0.01)
        return left.pop(0) if left else None

    mav = SimpleNamespace(
        set_position_target_global_int_send=lambda *_: waiting.append(len(left)),
        command_long_send=lambda *fields: commands.append(fields[2]),
    )
    link = SimpleNamespace(mav=mav, recv_match=heard, param_set_send=lambda *fields: settings.append(fields))
    pilot = Pilot(link, PLACE)
    pilot.texts.append("Scenematch: fixes begin")
    sitl.fly(pilot, lambda _: State(0.0, 0.0, 170.0, 0.0, 0.0, 0.0, 0.0, 0.0), 60.0, 30.0)
    assert (pilot.part, pilot.mode, pilot.armed, left) == (f"{name} by itself", name, False, [])
    assert len(waiting) == 1  # one target, before the failsafe was heard of
    assert mavlink.MAV_CMD_SET_EKF_SOURCE_SET not in commands
    assert settings == []  # the receiver stays on
