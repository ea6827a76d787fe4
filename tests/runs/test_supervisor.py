"""The supervisor replaces a worker that is killed; the last fix is found by who takes over, and by no other."""

import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from engine.errors import OptionError
from scenematch.runs import last_fix
from scenematch.runs.last_fix import LastFix, last_fix_file
from scenematch.runs.supervisor import check_supervision
from tests.support.paths import ROOT
from tests.support.waiting import is_running, wait_until

SCRIPT = """
import os, sys, time
from types import SimpleNamespace
from scenematch.runs.last_fix import LastFix
from scenematch.runs.supervisor import become_worker, end_on_sigterm
shared = LastFix()
end_on_sigterm()
try:
    become_worker()
    prior, begun_s = shared.prior(15.0), time.monotonic()
    shared.keep(SimpleNamespace(lat_deg=48.0, lon_deg=16.0, sigma_m=0.5))
    print(os.getpid(), "none" if prior is None else round(prior.lat_deg), begun_s, flush=True)
    time.sleep(300.0)
except KeyboardInterrupt:
    print("table", flush=True)
    sys.exit(3)
"""


@pytest.fixture
def supervisor():
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        yield process
        process.kill()


@pytest.mark.parametrize("within_s", [60.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_worker_that_is_killed_is_replaced_and_starts_at_the_last_fix(supervisor, within_s):
    pid, position, _ = supervisor.stdout.readline().split()
    assert position == "none"
    killed_s = time.monotonic()
    os.kill(int(pid), signal.SIGKILL)
    other, position, begun_s = supervisor.stdout.readline().split()
    assert other != pid
    assert position == "48"
    assert float(begun_s) - killed_s < within_s


def test_sigterm_ends_both_with_the_workers_exit_code(supervisor):
    supervisor.stdout.readline()
    supervisor.send_signal(signal.SIGTERM)
    assert supervisor.stdout.readline() == "table\n"
    assert supervisor.wait(60.0) == 3


@pytest.mark.parametrize("by", ["os.getpid()", "pid"])
def test_sigterm_between_the_fork_and_the_wait_is_not_lost(by):
    """To the supervisor, which does not know its worker yet, or to the worker, which has not its handlers yet."""
    early = "import os, signal\nfork = os.fork\ndef early():\n    pid = fork()\n"
    early += f"    if pid:\n        os.kill({by}, signal.SIGTERM)\n    return pid\nos.fork = early\n"
    command = [sys.executable, "-c", early + SCRIPT]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert ended.stdout.endswith("table\n")
    assert ended.returncode == 3


def test_a_worker_does_not_outlive_its_supervisor(supervisor):
    pid = int(supervisor.stdout.readline().split()[0])
    assert is_running(pid)
    supervisor.kill()
    wait_until(lambda: not is_running(pid))


def test_a_gpu_cannot_be_supervised():
    check_supervision(SimpleNamespace(type="cpu"))
    with pytest.raises(OptionError, match="supervise: expected the device cpu, got cuda"):
        check_supervision(SimpleNamespace(type="cuda"))


# ---------------------------------------------------------------------------------------------------- the last fix


FIX = SimpleNamespace(lat_deg=48.2, lon_deg=16.37, sigma_m=0.5)


def test_it_grows_uncertain_while_nobody_watches(monkeypatch):
    memory, clock = LastFix(), SimpleNamespace(now_s=time.monotonic())
    monkeypatch.setattr(last_fix.time, "monotonic", lambda: clock.now_s)
    assert memory.prior(15.0) is None
    memory.keep(FIX)
    clock.now_s += 0.1
    prior = memory.prior(15.0)
    assert (prior.lat_deg, prior.lon_deg, prior.sigma_m) == (48.2, 16.37, pytest.approx(0.5 + 15.0 * 0.1))


def test_another_finds_it_though_the_first_closed_nothing_as_one_that_is_killed(tmp_path):
    LastFix(tmp_path / "cache" / "last-fix").keep(FIX)
    prior = LastFix(tmp_path / "cache" / "last-fix").prior(15.0)
    assert (prior.lat_deg, prior.lon_deg) == (48.2, 16.37)


def test_it_is_forgotten_after_a_minute_and_when_the_computer_starts_again(tmp_path, monkeypatch):
    memory = LastFix(tmp_path / "last-fix")
    memory.keep(FIX)
    for now_s in (time.monotonic() + 61.0, 1.0):  # a clock that began anew
        with monkeypatch.context() as patch:
            patch.setattr(last_fix.time, "monotonic", lambda now_s=now_s: now_s)
            assert memory.prior(15.0) is None
    boot = tmp_path / "boot_id"
    boot.write_text("0f0e0d0c-0b0a-0908-0706-050403020100\n", encoding="ascii")
    monkeypatch.setattr(last_fix, "_BOOT_ID", boot)
    assert LastFix(tmp_path / "last-fix").prior(15.0) is None


@pytest.mark.parametrize("cut", [1, 20, 50])
def test_one_that_was_half_written_is_none(tmp_path, cut):
    path = tmp_path / "last-fix"
    LastFix(path).keep(FIX)
    whole = path.read_bytes()
    path.write_bytes(whole[:cut] + bytes(len(whole) - cut))
    assert LastFix(path).prior(15.0) is None


def test_a_folder_that_cannot_be_written_keeps_it_in_the_process(tmp_path):
    (tmp_path / "file").write_text("")
    memory = LastFix(tmp_path / "file" / "last-fix")
    memory.keep(FIX)
    assert memory.prior(15.0) is not None


def test_each_link_and_map_has_its_own():
    names = {last_fix_file(link, site) for link in ("serial:/dev/ttyAMA0:921600", "tcp:1") for site in ("a", "b")}
    assert len(names) == 4
