"""Forked workers: copies of this process that share its memory and divide independent tasks.

Threads do not help here: half of a frame's time is spent under Python's global lock, in hundreds of short calls
that each wait for it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from engine.errors import BackendError

T = TypeVar("T")

_WORTH_S = 0.5  # of remaining work; less is done before workers would start
_work: list[Callable[[int], Any]] = []  # in a worker, the task, which came by the fork: it need not be pickled


def can_fork() -> bool:
    """Whether this process may fork: only on Linux, whose libraries survive it, and not if daemonic."""
    return sys.platform == "linux" and not multiprocessing.current_process().daemon


def safe_count() -> int:
    """One worker per core if forking is safe, else 1.

    It is unsafe while other Python threads run: a lock that one of them holds is never released in the copy.
    """
    if not can_fork() or threading.active_count() > 1:
        return 1
    return len(os.sched_getaffinity(0))


def in_order(work: Callable[[int], T], count: int, workers: int) -> Iterator[T]:
    """Yield ``work(0)`` to ``work(count - 1)``, computed by workers if that is faster.

    This process does the first task: all workers share what it caches.

    Args:
        work: the task; its results and exceptions pass through a pipe.
        count: number of tasks.
        workers: most workers; with 1 this process does everything.

    Raises:
        BackendError: a worker ended.
    """
    start_s = time.perf_counter()
    for number in range(count):
        left_s = (time.perf_counter() - start_s) / max(number, 1) * (count - number)
        if workers > 1 and number and left_s > _WORTH_S:
            yield from _by_workers(work, range(number, count), workers)
            return
        yield work(number)


def start_helper(work: Callable[[], None]) -> BaseProcess | None:
    """Start work in a fork of this process, which the caller must end; None if forking is not safe."""
    if safe_count() < 2:
        return None
    with _forkable():
        helper = multiprocessing.get_context("fork").Process(target=work, daemon=True)
        helper.start()
    return helper


def _by_workers(work: Callable[[int], T], tasks: range, workers: int) -> Iterator[T]:
    """The results of tasks in order; a task's exception is raised in its turn."""
    fork = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(min(workers, len(tasks)), fork, _begin, (work,))
    try:
        with _forkable():
            results = pool.map(_run, tasks)
        yield from results
    except BrokenProcessPool:
        raise BackendError("workers: a process ended") from None
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(work: Callable[[int], Any]) -> None:
    """Make this process a worker, which ends with its parent, however that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles it and ends us
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _work[:] = [work]
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _run(task: int) -> Any:
    return _work[0](task)


@contextmanager
def _forkable() -> Iterator[None]:
    """One thread of torch and OpenCV while copies are made: a copy has no pool's threads, but waits for them."""
    import cv2

    torch = sys.modules.get("torch")
    threads = cv2.getNumThreads(), 0 if torch is None else torch.get_num_threads()
    cv2.setNumThreads(1)
    if torch is not None:
        torch.set_num_threads(1)
    try:
        with warnings.catch_warnings():  # from Python 3.12 on about any thread, also BLAS's, which expect a fork
            warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
            yield
    finally:
        cv2.setNumThreads(threads[0])
        if torch is not None:
            torch.set_num_threads(threads[1])
