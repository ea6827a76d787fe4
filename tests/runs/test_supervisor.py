"""The supervisor: a worker that is killed is replaced at once, one that ends is not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from engine.errors import OptionError
from scenematch.runs.supervisor import check_supervision
from tests.support.paths import ROOT

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


def replaced(supervisor):
    """Seconds from the end of a worker to the beginning of the next."""
    pid, position, _ = supervisor.stdout.readline().split()
    assert position == "none"
    killed_s = time.monotonic()
    os.kill(int(pid), signal.SIGKILL)
    other, position, begun_s = supervisor.stdout.readline().split()
    assert other != pid
    assert position == "48"
    supervisor.kill()
    return float(begun_s) - killed_s


def test_a_worker_that_is_killed_is_replaced_and_starts_at_the_last_fix(supervisor):
    replaced(supervisor)


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced_at_once(supervisor):
    assert replaced(supervisor) < 1.0


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


def is_running(pid):
    """Not gone, nor dead and not yet reaped."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"


def test_a_worker_does_not_outlive_its_supervisor(supervisor):
    pid = int(supervisor.stdout.readline().split()[0])
    assert is_running(pid)
    supervisor.kill()
    until = time.monotonic() + 60.0
    while is_running(pid) and time.monotonic() < until:
        time.sleep(0.02)
    assert not is_running(pid)


def test_a_gpu_cannot_be_supervised():
    check_supervision(SimpleNamespace(type="cpu"))
    with pytest.raises(OptionError, match="supervise: expected the device cpu, got cuda"):
        check_supervision(SimpleNamespace(type="cuda"))
