"""How long a thread waited for a processor that others used: time that its own work did not cost."""

from __future__ import annotations

import sys
from dataclasses import dataclass

if sys.platform == "linux":
    from resource import RUSAGE_THREAD, getrusage

_MAX_WAIT_MS = 20.0  # of one preemption


@dataclass(frozen=True, slots=True)
class ThreadUsage:
    """What the calling thread has used so far.

    Attributes:
        processor_ms: time on a processor.
        preemptions: how often it was taken from one while it had work to do.
    """

    processor_ms: float
    preemptions: int


def thread_usage() -> ThreadUsage:
    """Of the calling thread; of systems other than Linux nothing is known, and no thread counts as preempted."""
    if sys.platform != "linux":
        return ThreadUsage(0.0, 0)
    used = getrusage(RUSAGE_THREAD)
    return ThreadUsage((used.ru_utime + used.ru_stime) * 1e3, used.ru_nivcsw)


def waited_ms(before: ThreadUsage, after: ThreadUsage, took_ms: float) -> float:
    """What of the time between two readings the thread waited for a processor.

    A thread that was not preempted waited for none: what it spent off the processor, for a device or a file, is
    part of its work. A wait counts as long as a scheduler lets one be: a machine that stood still tells nothing.
    """
    off_processor_ms = took_ms - (after.processor_ms - before.processor_ms)
    return min(max(0.0, off_processor_ms), _MAX_WAIT_MS * (after.preemptions - before.preemptions))
