"""What a thread waited for a processor: nothing unless it was preempted, and never what it slept."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from engine.methods.preemption import ThreadUsage, thread_usage, waited_ms

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts what a thread uses")


def test_what_a_preempted_thread_did_not_run_it_waited():
    assert waited_ms(ThreadUsage(100.0, 3), ThreadUsage(101.5, 4), 5.5) == pytest.approx(4.0)


def test_a_thread_that_was_not_preempted_waited_for_no_processor():
    assert waited_ms(ThreadUsage(100.0, 3), ThreadUsage(101.5, 3), 5.5) == 0.0


def test_clocks_that_disagree_by_a_little_give_no_negative_wait():
    assert waited_ms(ThreadUsage(100.0, 3), ThreadUsage(105.6, 4), 5.5) == 0.0


def test_a_wait_counts_as_long_as_so_many_preemptions_take():
    assert waited_ms(ThreadUsage(100.0, 3), ThreadUsage(102.0, 4), 502.0) == 20.0
    assert waited_ms(ThreadUsage(100.0, 3), ThreadUsage(300.0, 33), 500.0) == pytest.approx(300.0)


@linux
def test_work_is_counted_and_sleep_is_not():
    before = thread_usage()
    time.sleep(0.05)
    slept = thread_usage()
    while thread_usage().processor_ms - slept.processor_ms < 20.0:
        pass
    assert slept.processor_ms - before.processor_ms < 20.0


@linux
def test_beside_a_busy_process_on_its_core_a_thread_waits_about_half_of_the_time():
    """In a process of its own, whose core the test chooses."""
    code = (
        "import os, time\n"
        "from engine.methods.preemption import thread_usage, waited_ms\n"
        "before, start = thread_usage(), time.perf_counter()\n"
        "while time.perf_counter() - start < 0.4: pass\n"
        "print(waited_ms(before, thread_usage(), 400.0))\n"
    )
    core = min(os.sched_getaffinity(0))

    def pinned(source, **named):
        chosen = f"import os; os.sched_setaffinity(0, {{{core}}})\n"
        return subprocess.Popen([sys.executable, "-c", chosen + source], **named)

    hog = pinned("while True: pass")
    try:
        waits = float(pinned(code, stdout=subprocess.PIPE).communicate(timeout=60)[0])
    finally:
        hog.kill()
        hog.wait()
    assert 80.0 < waits < 395.0
