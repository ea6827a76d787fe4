"""What systemd hears of a bridge, over a socket like its own, and what it says of the unit."""

import configparser
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import pytest

from engine.adapters.camera_stream import _IDLE_S, _REOPEN_S, _TIMEOUTS
from engine.errors import OptionError
from engine.realtime import _FIFO_CURE, _MEMORY_CURE
from engine.runs import mavlink_bridge
from engine.runs.bridge_files import BridgeFiles
from engine.runs.mavlink_bridge import BridgeSettings, MavlinkSettings, run_mavlink_bridge
from engine.runs.service import _BEATS, running_service, tell_status
from engine.runs.simulation import write_flight
from engine.sim import plan_flight
from tests.support.paths import ROOT
from tests.support.towns import drawn_town

UNIT = ROOT / "deploy" / "scenematch-bridge.service"
HANGING = """
import time
from engine.runs.service import running_service
with running_service() as beat:
    until = time.monotonic() + 0.5
    while time.monotonic() < until:
        beat()
        time.sleep(0.005)
    time.sleep(60.0)
"""


@pytest.fixture
def manager(tmp_path, monkeypatch):
    """The socket that a manager reads; the watchdog waits for 0.2 s."""
    path = str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(path)
        ear.settimeout(5.0)
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


def test_a_service_is_ready_lives_and_stops(manager):
    with running_service() as beat:
        assert manager.recv(100) == b"READY=1"
        beat()
    assert heard(manager) == ["WATCHDOG=1", "STOPPING=1"]


def test_the_end_is_told_where_an_error_brings_it(manager):
    with pytest.raises(ZeroDivisionError), running_service():
        raise ZeroDivisionError
    assert heard(manager) == ["READY=1", "STOPPING=1"]


def test_the_watchdog_is_fed_some_times_while_it_waits_however_fast_the_loop(manager):
    begin_s = time.monotonic()
    with running_service() as beat:
        while time.monotonic() < begin_s + 0.4:
            beat()
    count = heard(manager).count("WATCHDOG=1")
    assert 4 <= count <= 9  # eight where nothing else takes the processor


def test_a_loop_that_hangs_is_heard_no_more(manager):
    with subprocess.Popen([sys.executable, "-c", HANGING], env=os.environ | {"PYTHONPATH": str(ROOT)}) as process:
        assert manager.recv(100) == b"READY=1"
        assert manager.recv(100) == b"WATCHDOG=1"
        time.sleep(1.0)
        assert "WATCHDOG=1" in heard(manager)
        time.sleep(0.5)
        assert heard(manager) == []
        process.send_signal(signal.SIGKILL)


def test_an_abstract_socket_is_found(monkeypatch):
    name = f"scenematch-test-{os.getpid()}"
    monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
    monkeypatch.delenv("WATCHDOG_USEC", raising=False)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(f"\0{name}")
        with running_service() as beat:
            beat()  # nobody watches
        assert heard(ear) == ["READY=1", "STOPPING=1"]


def test_a_status_is_told_as_one_line(manager):
    tell_status("autopilot heard; sent 5")
    assert heard(manager) == ["STATUS=autopilot heard; sent 5"]


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
    assert time.monotonic() - begin_s < 5.0


def test_a_bridge_is_ready_when_its_link_is_open_and_its_loop_feeds_the_watchdog(manager, tmp_path, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "800000")  # no more beats than the socket's queue holds
    monkeypatch.setattr(mavlink_bridge, "end_on_sigterm", lambda: None)
    monkeypatch.setattr(mavlink_bridge, "_AUTOPILOT_TIMEOUT_S", 0.5)
    monkeypatch.setattr(mavlink_bridge, "_MESSAGE_PERIOD_S", 0.0)
    flight = write_flight(tmp_path / "flight", plan_flight(town=drawn_town(), frames=2))
    files = BridgeFiles(map=flight.map, camera=flight.camera, frames=flight.frames, rate_hz=10.0)
    link, settings = MavlinkSettings(connect="udpout:127.0.0.1:9"), BridgeSettings(method="ncc")
    with pytest.raises(OptionError, match="start"):
        run_mavlink_bridge(files, link, replace(settings, start="0,0"))
    assert heard(manager) == []  # one that cannot begin is never ready
    run_mavlink_bridge(files, link, settings)
    told = heard(manager)
    assert (told[0], told[-1]) == ("READY=1", "STOPPING=1")
    beats = [line for line in told[1:-1] if not line.startswith("STATUS=")]
    assert beats == ["WATCHDOG=1"] * len(beats)
    assert len(beats) >= 2  # while it waits for the autopilot, too
    assert "STATUS=no autopilot; sent 0" in "".join(told)


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
    assert "--realtime" in unit["ExecStart"]


def test_the_unit_hears_the_worker_of_a_supervisor_and_has_a_watchdog(unit):
    assert "--supervise" in unit["ExecStart"]
    assert (unit["Type"], unit["NotifyAccess"], unit["Restart"]) == ("notify", "all", "on-failure")
    # The longest between two beats: one that just was not due, and a silent network camera that is opened again.
    longest_s = _IDLE_S + _TIMEOUTS[_TIMEOUTS.index(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC) + 1] / 1e3 + _REOPEN_S
    assert float(unit["WatchdogSec"]) * (1.0 - 1.0 / _BEATS) > longest_s
    # A bridge that such a camera holds hears SIGTERM when it is open again: it is not killed before.
    assert longest_s < float(unit["TimeoutStopSec"]) <= float(unit["WatchdogSec"])


def test_the_units_command_is_one_of_the_command_line(unit):
    from engine.cli.app import run

    program, *words = unit["ExecStart"].split()
    assert program.endswith("/scenematch")
    assert run([*words, "--help"]) == 0
    asked = [word.replace("/srv/scenematch", "/nowhere") for word in words if word != "--realtime"]
    assert run(asked) == 1  # every option is known: what is wrong is the map, which is not there


def test_systemd_takes_the_unit(tmp_path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text(encoding="utf-8").replace("/opt/scenematch/bin/scenematch", sys.executable))
    done = subprocess.run(["systemd-analyze", "verify", str(copy)], capture_output=True, text=True)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
