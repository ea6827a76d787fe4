"""What systemd hears of a bridge, over a socket like its own, and what it says of the unit."""

import configparser
import gc
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from engine import OptionError, SceneMatcher
from engine.navigation.live import Counts
from engine.runtime.realtime import _FIFO_CURE, _MEMORY_CURE
from scenematch import BridgeFiles, FlightFiles, Progress, RosSettings, run_ros_bridge
from scenematch.bridges.camera_stream import _IDLE_S, _REOPEN_S, _TIMEOUTS
from scenematch.bridges.ros import RosStatus, RosTopics
from scenematch.runs import mavlink_bridge, service
from scenematch.runs.last_fix import LastFix, last_fix_file
from scenematch.runs.mavlink_bridge import BridgeSettings, MavlinkSettings, run_mavlink_bridge
from scenematch.runs.service import _BEATS, running_service, status_reporter
from tests.support.paths import ROOT
from tests.support.ros import StandInNode, maker_of

UNIT = ROOT / "deploy" / "scenematch-bridge.service"


@pytest.fixture
def manager(tmp_path, monkeypatch):
    """The socket that a manager reads; the watchdog waits for 0.2 s."""
    path = str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(path)
        ear.settimeout(60.0)
        yield ear


def heard(ear):
    """Every message that waits."""
    ear.setblocking(False)
    messages = []
    try:
        while True:
            messages.append(ear.recv(100).decode())
    except BlockingIOError:
        return messages


def test_the_end_is_told_where_an_error_brings_it(manager):
    with pytest.raises(ZeroDivisionError), running_service():
        raise ZeroDivisionError
    assert heard(manager) == ["READY=1", "STOPPING=1"]


def test_the_watchdog_is_fed_some_times_while_it_waits_however_fast_the_loop(manager, monkeypatch):
    """Four times in the 0.2 s of each wait."""
    clock = SimpleNamespace(now_s=0.0)
    monkeypatch.setattr(service.time, "monotonic", lambda: clock.now_s)
    with running_service() as beat:
        for ms in range(401):
            clock.now_s = 0.001 * ms
            beat()
    assert heard(manager).count("WATCHDOG=1") in (8, 9)


def test_a_loop_that_hangs_is_heard_no_more(manager):
    with running_service() as beat:
        beat()
        time.sleep(0.1)
        beat()
        assert "WATCHDOG=1" in heard(manager)
        time.sleep(0.5)
        assert heard(manager) == []


def test_an_abstract_socket_is_found(monkeypatch):
    name = f"scenematch-test-{os.getpid()}"
    monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
    monkeypatch.delenv("WATCHDOG_USEC", raising=False)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(f"\0{name}")
        with running_service() as beat:
            beat()  # nobody watches
        assert heard(ear) == ["READY=1", "STOPPING=1"]


@pytest.fixture
def progress():
    """Keeps what is shown as its lines."""
    shown = Progress()
    shown.lines = []
    shown.message = shown.lines.append
    return shown


def test_a_status_is_told_as_one_line_now_and_then(manager, progress, monkeypatch):
    clock = iter([0.0, 4.9, 5.0, 5.1, 10.0])
    monkeypatch.setattr(service.time, "monotonic", lambda: next(clock))
    report = status_reporter(lambda: "autopilot heard; sent 5", progress)
    for _ in range(4):
        report()
    assert progress.lines == ["autopilot heard; sent 5"] * 2
    assert heard(manager) == ["STATUS=autopilot heard; sent 5"] * 2


@pytest.mark.parametrize("address", ["", "/nowhere/at/all", "@nobody-listens"])
def test_a_bridge_goes_on_where_nobody_listens(address, monkeypatch):
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    monkeypatch.setenv("WATCHDOG_USEC", "1")
    with running_service() as beat:
        beat()


def test_a_manager_that_does_not_read_stops_nobody(manager):
    begin_s = time.monotonic()
    for _ in range(1000):  # more than a queue holds
        with running_service() as beat:
            beat()
    assert time.monotonic() - begin_s < 60.0


def test_a_bridge_with_an_open_link_is_ready_and_feeds_the_watchdog(manager, flight_in, tmp_path, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "800000")  # no more beats than the socket's queue holds
    monkeypatch.setattr(mavlink_bridge, "end_on_sigterm", lambda: None)
    monkeypatch.setattr(mavlink_bridge, "_AUTOPILOT_TIMEOUT_S", 0.5)
    monkeypatch.setattr(service, "_STATUS_PERIOD_S", 0.0)
    monkeypatch.setattr(SceneMatcher, "warmup", lambda *_, **__: None)
    flown = flight_in(tmp_path / "flight", frames=2)
    files = BridgeFiles(map=flown.map, camera=flown.camera, frames=flown.frames, rate_hz=10.0)
    link, settings = MavlinkSettings(connect="udpout:127.0.0.1:9"), BridgeSettings(method="ncc")
    with pytest.raises(OptionError, match="start"):
        run_mavlink_bridge(files, link, replace(settings, start="0,0"))
    assert heard(manager) == []  # one that cannot begin is never ready
    run_mavlink_bridge(files, link, settings)
    stated = heard(manager)
    assert (stated[0], stated[-1]) == ("READY=1", "STOPPING=1")
    beats = [line for line in stated[1:-1] if not line.startswith("STATUS=")]
    assert beats == ["WATCHDOG=1"] * len(beats)
    assert len(beats) >= 2  # while it waits for the autopilot, too
    assert "STATUS=no autopilot; sent 0" in "".join(stated)


def test_a_bridge_that_starts_again_in_the_air_warms_up_briefly(flight, tmp_path, monkeypatch):
    class WarmError(Exception):
        pass

    def warmup(_, report, *, brief):
        briefly.append((brief, gc.isenabled()))
        raise WarmError

    briefly = []
    monkeypatch.setattr(mavlink_bridge.SceneMatcher, "warmup", warmup)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    flown = FlightFiles.in_folder(flight)
    link = MavlinkSettings(connect="udpout:127.0.0.1:9")
    last = SimpleNamespace(lat_deg=48.0, lon_deg=16.0, sigma_m=1.0)
    for frames, source in ((None, "0"), (None, "0"), (flown.frames, None)):
        files = BridgeFiles(map=flown.map, camera=flown.camera, frames=frames, camera_source=source)
        with pytest.raises(WarmError):
            run_mavlink_bridge(files, link, BridgeSettings(method="ncc"))
        assert gc.isenabled()
        LastFix(last_fix_file(link.connect, link.system_id, flown.map.map.absolute())).keep(last)
    assert briefly == [(False, False), (True, False), (False, False)]  # a recorded flight starts on the ground


def test_a_ros_bridge_reports_as_the_other_does(manager, flight, progress, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "1000")
    monkeypatch.setattr(SceneMatcher, "warmup", lambda *_, **__: None)
    monkeypatch.setattr(service, "_STATUS_PERIOD_S", 0.0)
    maker = maker_of("ros1")
    node, flown, black = StandInNode(maker), FlightFiles.in_folder(flight), np.zeros((300, 300), np.uint8)

    def spin(handlers, every_second, seconds):
        handlers["/down"][1](maker.image(10**9, "", black))
        handlers["/down"][1](maker.image(9 * 10**8, "", black))  # out of order
        node.wait_for("diagnostics", 1)
        every_second()

    node.spin, node.time_ns = spin, 10**9
    ros = RosSettings(map=flown.map, camera=flown.camera, topics=RosTopics(image="/down"))
    run_ros_bridge(ros, BridgeSettings(method="ncc"), node=node, progress=progress)
    line = "1 pictures; published 0; not published: no_height 1, unusable 1"
    assert progress.lines[-1] == line
    assert heard(manager) == ["READY=1", "WATCHDOG=1", f"STATUS={line}", "STOPPING=1"]


def test_the_line_of_a_ros_bridge_names_what_was_not_published():
    counts = Counts(submitted=9, dropped=1, answered=8, late=0, workers_replaced=0)
    status = RosStatus(counts, fixes=5, refused={"late": 2, "low_score": 1}, unusable=4, restarts=1)
    stated = "9 pictures; published 5; not published: late 2, low_score 1, unusable 4, dropped 1; 1 restarts"
    assert status.line() == stated


# ----------------------------------------------------------------------------------------------------- the unit


@pytest.fixture(scope="module")
def unit():
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str
    parser.read_string(UNIT.read_text(encoding="utf-8").replace("\\\n", ""))
    return parser["Service"]


def test_the_unit_grants_what_real_time_asks_for(unit):
    for cure in (_FIFO_CURE, _MEMORY_CURE):
        name, value = re.search(r"(Limit\w+)=(\w+)", cure).groups()
        assert unit[name] == value
    assert "bridge.realtime=true" in unit["ExecStart"]


def test_the_unit_hears_the_worker_of_a_supervisor_and_replaces_either_that_want_of_memory_ends(unit):
    assert "--supervise" in unit["ExecStart"]  # replaces the worker, systemd the main process
    assert (unit["Type"], unit["NotifyAccess"]) == ("notify", "all")
    assert (unit["OOMPolicy"], unit["Restart"]) == ("continue", "on-failure")


def test_the_watchdog_and_the_stop_wait_longer_than_any_camera(unit):
    # The longest between two beats: one that just was not due, and a silent network camera that is opened again.
    longest_s = _IDLE_S + _TIMEOUTS[_TIMEOUTS.index(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC) + 1] / 1e3 + _REOPEN_S
    assert float(unit["WatchdogSec"]) * (1.0 - 1.0 / _BEATS) > longest_s
    # A bridge that such a camera holds hears SIGTERM when it is open again: it is not killed before.
    assert longest_s < float(unit["TimeoutStopSec"]) <= float(unit["WatchdogSec"])


def test_the_units_command_is_one_of_the_command_line(unit):
    from scenematch.cli.app import run

    program, *words = unit["ExecStart"].split()
    assert program.endswith("/scenematch")
    assert run([*words, "--help"]) == 0
    elsewhere = " ".join(words).replace("/srv/scenematch", "/nowhere")
    asked = elsewhere.replace("realtime=true", "realtime=false").split()
    assert run(asked) == 1  # every option is known: what is wrong is the map, which is not there


def test_systemd_takes_the_unit(tmp_path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text(encoding="utf-8").replace("/opt/scenematch/bin/scenematch", sys.executable))
    done = subprocess.run(["systemd-analyze", "verify", str(copy)], capture_output=True, text=True)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
