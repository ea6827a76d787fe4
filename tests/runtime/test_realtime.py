"""Real time: what the kernel says of a thread that asked for it, and what a refusal says."""

import json
import os
import sys
import threading

import pytest

from engine import BackendError, Live, LiveOptions, OptionError
from engine.runtime import realtime as module
from engine.runtime.realtime import Realtime, check_realtime, set_realtime, start_thread
from scenematch.runs.mavlink_bridge import BridgeSettings
from tests.support.interpreters import done_by
from tests.support.refusals import misuse

linux = pytest.mark.skipif(sys.platform != "linux", reason="real time is Linux's")
PLAIN = Realtime(lock_memory=False)


def permitted(realtime: Realtime) -> bool:
    try:
        check_realtime(realtime)
    except (BackendError, OptionError):
        return False
    return True


@linux
@pytest.mark.skipif(not permitted(Realtime()), reason="real time is not permitted here")
def test_policy_cores_and_memory_are_set_and_not_inherited():
    core = min(os.sched_getaffinity(0))
    done = done_by(  # memory that is locked stays so
        "import json, os, subprocess, sys, threading\n"
        "from engine import Realtime, set_realtime\n"
        f"set_realtime(Realtime(priority=7, cores=({core},)))\n"
        "own = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, list(os.sched_getaffinity(0))\n"
        "other = []\n"
        "thread = threading.Thread(target=lambda: other.append(os.sched_getscheduler(0)))\n"
        "thread.start(); thread.join()\n"
        "asks = [sys.executable, '-c', 'import os; print(os.sched_getscheduler(0))']\n"
        "child = subprocess.run(asks, capture_output=True, text=True)\n"
        "locked = open('/proc/self/status').read().split('VmLck:')[1].split()[0]\n"
        "print(json.dumps([own, other, int(child.stdout), int(locked)]))"
    )
    (policy, priority, cores), (thread,), child, locked_kib = json.loads(done.stdout)
    assert policy == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    assert (priority, cores) == (7, [core])
    assert (thread, child) == (os.SCHED_OTHER, os.SCHED_OTHER)
    assert locked_kib > 1000


@linux
@pytest.mark.skipif(not permitted(Realtime(nice=-5, lock_memory=False)), reason="not permitted here")
def test_a_nice_value_in_place_of_a_real_time_policy():
    seen: list[int] = []

    def look() -> None:
        seen.extend((os.getpriority(os.PRIO_PROCESS, 0), os.sched_getscheduler(0)))

    start_thread(look, "looks", Realtime(nice=-5, lock_memory=False)).join()
    assert seen == [-5, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK]  # what it starts is scheduled as usual
    assert os.getpriority(os.PRIO_PROCESS, 0) > -5  # of this thread


@linux
@pytest.mark.skipif(not permitted(PLAIN), reason="real time is not permitted here")
def test_live_schedules_its_worker_and_above_it_the_watchdog():
    with Live(lambda _: None, print, options=LiveOptions(realtime=PLAIN)):  # type: ignore[arg-type,return-value]
        named = {thread.name: thread.native_id for thread in threading.enumerate()}
        for name, priority in (("scenematch-_work", PLAIN.priority), ("scenematch-_watch", PLAIN.priority + 1)):
            for _ in range(2000):  # until the thread has begun
                if os.sched_getparam(named[name]).sched_priority == priority:
                    break
                threading.Event().wait(0.001)
            assert os.sched_getparam(named[name]).sched_priority == priority
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


@linux
@pytest.mark.parametrize(
    ("call", "asked", "words"),
    [
        ("sched_setscheduler", PLAIN, ("SCHED_FIFO is not permitted", "CAP_SYS_NICE", "ulimit -r", "systemd")),
        ("setpriority", Realtime(nice=-3, lock_memory=False), ("nice value of -3", "CAP_SYS_NICE", "LimitNICE")),
        ("sched_setaffinity", Realtime(cores=(0,), lock_memory=False), ("cores: 0 are not available",)),
    ],
)
def test_what_is_not_permitted_is_told_with_its_cure(monkeypatch, call, asked, words):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, call, refuse)
    with pytest.raises(BackendError) as stated:
        set_realtime(asked)
    assert all(word in str(stated.value) for word in words)
    with pytest.raises(BackendError):  # before a pipeline depends on it
        Live(lambda _: None, print, options=LiveOptions(realtime=asked))  # type: ignore[arg-type,return-value]


@linux
@pytest.mark.skipif(not permitted(PLAIN), reason="real time is not permitted here")
def test_memory_that_could_run_out_in_flight_is_not_locked(monkeypatch):
    import resource

    monkeypatch.setattr(resource, "getrlimit", lambda _: (8 << 20, 8 << 20))
    monkeypatch.setattr(module, "_has_capability", lambda _: False)
    with pytest.raises(BackendError, match=r"8192 KiB may be.*ulimit -l unlimited.*LimitMEMLOCK=infinity"):
        check_realtime(Realtime())


def test_another_system_is_refused(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert "realtime: expected Linux, got darwin" in misuse(set_realtime)


@pytest.mark.parametrize("priority", [0, 99])
def test_priorities_out_of_range_are_refused(priority):
    assert misuse(Realtime, priority=priority).startswith("priority: expected")


def test_a_bridge_is_scheduled_as_usual_unless_told():
    assert BridgeSettings(nice=None, cores=()).scheduling() is None
