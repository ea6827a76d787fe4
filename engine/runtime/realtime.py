"""Real-time scheduling on Linux for matching threads, so that other work does not delay them.

Convention:
    Threads and processes started by such a thread are scheduled normally, so that a camera command or a simulator
    does not delay frames.
"""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from engine.errors import BackendError, OptionError
from engine.values import check

_log = logging.getLogger("scenematch")

_MLOCK = 1 | 2 | 4  # of mlockall(2): current and future pages, but only those that are used
_CAP_IPC_LOCK = 14  # of capabilities(7)
_FIFO_CURE = "CAP_SYS_NICE, `ulimit -r 20`, or in a unit of systemd LimitRTPRIO=20"
_NICE_CURE = "CAP_SYS_NICE, `ulimit -e 40`, or in a unit of systemd LimitNICE=40"
_MEMORY_CURE = "CAP_IPC_LOCK, `ulimit -l unlimited`, or in a unit of systemd LimitMEMLOCK=infinity"


@dataclass(frozen=True, slots=True, kw_only=True)
class Realtime:
    """Scheduling of the threads that match frames.

    Attributes:
        priority: of SCHED_FIFO, 1 to 98: such a thread runs before all normal ones. The watchdog of
            :class:`engine.Live` has one more.
        nice: -20 to -1, a greater processor share instead of SCHED_FIFO; None takes SCHED_FIFO.
        cores: the threads' cores; () keeps those of the process.
        lock_memory: whether to keep the process's used pages in memory.

    Raises:
        OptionError: a number is out of its range, or this machine has no such core.
    """

    priority: int = 10
    nice: int | None = None
    cores: tuple[int, ...] = ()
    lock_memory: bool = True

    def __post_init__(self) -> None:
        check(self, "priority", "1 to 98", lambda priority: 1 <= priority <= 98)
        check(self, "nice", "-20 to -1", lambda nice: nice is None or -20 <= nice <= -1)
        last = (os.cpu_count() or 1) - 1
        if any(not 0 <= core <= last for core in self.cores):
            raise OptionError(f"cores: expected numbers from 0 to {last}, got {_listed(self.cores)}")


def set_realtime(realtime: Realtime | None = None) -> None:
    """Schedule the calling thread in real time, and lock the memory of its process.

    The kernel takes the processor from threads of SCHED_FIFO that compute without a pause, by default for 50 ms of
    each second (``kernel.sched_rt_runtime_us``): leave a tenth of the time.

    Args:
        realtime: settings; None is the defaults.

    Raises:
        OptionError: this system is not Linux.
        BackendError: the system does not permit it; the message says which right is missing.
    """
    realtime = realtime or Realtime()
    if sys.platform != "linux":
        raise OptionError(f"realtime: expected Linux, got {sys.platform}")
    if realtime.cores:
        _pin(realtime.cores)
    if realtime.nice is None:
        _use_fifo(realtime.priority)
    else:
        _use_nice(realtime.nice)
    if realtime.lock_memory:
        _check_lockable()
        _lock_memory()


def check_realtime(realtime: Realtime | None) -> None:
    """Refuse settings that are not permitted before anything depends on them, by a trial in a thread of its own.

    Raises:
        OptionError, BackendError: as of :func:`set_realtime`.
    """
    if realtime is None:
        return

    def attempt() -> None:
        set_realtime(replace(realtime, lock_memory=False))
        if realtime.lock_memory:
            _check_lockable()

    with ThreadPoolExecutor(1) as trial:
        trial.submit(attempt).result()


def start_thread(
    target: Callable[[], None], name: str, realtime: Realtime | None, *, above: int = 0
) -> threading.Thread:
    """Start a daemon thread, in real time if wanted.

    Args:
        target: what it runs.
        name: of the thread.
        realtime: its scheduling; None is normal. Settings that are no longer permitted are logged.
        above: added to the priority.
    """

    def run() -> None:
        if realtime is not None:
            try:
                set_realtime(realtime)
                if realtime.nice is None and above:
                    _use_fifo(realtime.priority + above)
            except (OptionError, BackendError):
                _log.exception("%s is scheduled as usual", name)
        target()

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    return thread


# ------------------------------------------------------------------------------------------------- system calls


def _pin(cores: tuple[int, ...]) -> None:
    try:
        os.sched_setaffinity(0, cores)
    except OSError as error:
        raise BackendError(f"cores: {_listed(cores)} are not available: {error.strerror}") from None
    if (had := os.sched_getaffinity(0)) != set(cores):
        raise BackendError(f"cores: expected {_listed(cores)}, got {_listed(tuple(sorted(had)))} only")


def _use_fifo(priority: int) -> None:
    # Root lacks the right where the kernel has RT_GROUP_SCHED.
    where = "; root may if its control group has real-time budget (cpu.rt_runtime_us)" if os.geteuid() == 0 else ""
    with _permission("SCHED_FIFO", _FIFO_CURE + where):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))


def _use_nice(nice: int) -> None:
    with _permission(f"a nice value of {nice}", _NICE_CURE):
        # What the thread starts has a nice value of 0 again.
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
        os.setpriority(os.PRIO_PROCESS, 0, nice)  # on Linux of the calling thread


@contextmanager
def _permission(what: str, cure: str) -> Iterator[None]:
    try:
        yield
    except PermissionError:
        raise BackendError(f"realtime: {what} is not permitted; it needs {cure}") from None
    except OSError as error:
        raise BackendError(f"realtime: {what} cannot be set: {error.strerror}") from None


def _check_lockable() -> None:
    import resource  # not available on other systems

    # With a limit the lock might succeed now, and memory run out in flight.
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY and not _has_capability(_CAP_IPC_LOCK):
        allowed = f"{limit >> 10} KiB may be"
        raise BackendError(f"realtime: memory cannot be locked, {allowed}; it needs {_MEMORY_CURE}")


def _lock_memory() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MLOCK) != 0:
        cause = os.strerror(ctypes.get_errno())
        raise BackendError(f"realtime: memory cannot be locked ({cause}); it needs {_MEMORY_CURE}")


def _has_capability(number: int) -> bool:
    status = Path("/proc/thread-self/status").read_text()
    effective = next(line.split()[1] for line in status.splitlines() if line.startswith("CapEff:"))
    return bool(int(effective, 16) >> number & 1)


def _listed(cores: tuple[int, ...]) -> str:
    return ",".join(map(str, cores))
