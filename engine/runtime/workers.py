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
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar, cast

from engine.errors import BackendError, EngineError

T = TypeVar("T")

_ALONE_S = 0.05  # of work in this process first
_WORTH_S = 0.5  # of remaining work; less is done before workers would start
_AHEAD = 2  # tasks per worker: while one result travels, it works on the next
_Workers = dict[Connection, BaseProcess]


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

    This process does the first tasks: all workers share what they cache.

    Args:
        work: the task; its results and exceptions pass through a pipe.
        count: number of tasks.
        workers: most workers; with 1 this process does everything.

    Raises:
        BackendError: a worker ended.
    """
    start_s, done = time.perf_counter(), 0
    while done < count:
        spent_s = time.perf_counter() - start_s
        left_s = spent_s / done * (count - done) if done else 0.0
        if workers > 1 and spent_s > _ALONE_S and left_s > _WORTH_S:
            break
        yield work(done)
        done += 1
    if done < count:
        yield from _by_workers(work, range(done, count), workers)


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
    started: _Workers = {}
    try:
        with _forkable():
            for _ in range(min(workers, len(tasks))):
                _start(work, started)
        waiting, results = iter(tasks), dict[int, tuple[T | None, Exception | None]]()
        for pipe in [*started] * _AHEAD:
            _hand_out(waiting, pipe)
        for task in tasks:
            while task not in results:
                for pipe in cast("list[Connection]", wait([*started])):
                    number, *result = _received(pipe, started)
                    results[number] = (result[0], result[1])
                    _hand_out(waiting, pipe)
            value, error = results.pop(task)
            if error is not None:
                raise error
            yield value  # type: ignore[misc]  # None only if that is the result
    finally:
        for pipe, process in started.items():
            process.kill()  # it may have inherited a handler of gentler signals
            process.join()
            pipe.close()


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


def _start(work: Callable[[int], Any], started: _Workers) -> None:
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    # A copy holds our ends of the pipes, too; closed there, a pipe ends when this process does.
    process = context.Process(target=_serve, args=(work, theirs, [*started, ours]), daemon=True)
    process.start()
    theirs.close()
    started[ours] = process


def _serve(work: Callable[[int], Any], pipe: Connection, inherited: list[Connection]) -> None:
    """The worker's process: tasks in, results out, until its parent ends it or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles it and ends us
    for end in inherited:
        end.close()
    try:
        while True:
            pipe.send(_result(work, pipe.recv()))
    except (EOFError, ConnectionError):
        return


def _result(work: Callable[[int], T], task: int) -> tuple[int, T | None, Exception | None]:
    try:
        return task, work(task), None
    except Exception as error:  # raised again by the parent
        if not isinstance(error, EngineError):  # one line says it all
            error.add_note(traceback.format_exc())
        return task, None, error


def _received(pipe: Connection, started: _Workers) -> tuple[int, Any, Exception | None]:
    try:
        received: tuple[int, Any, Exception | None] = pipe.recv()
    except (EOFError, ConnectionError):
        started[pipe].join()
        raise BackendError(f"workers: a process ended with code {started[pipe].exitcode}") from None
    return received


def _hand_out(waiting: Iterator[int], pipe: Connection) -> None:
    """Send the next task, if there is one; a worker that has ended shows when its result is awaited."""
    task = next(waiting, None)
    if task is not None:
        try:
            pipe.send(task)
        except ConnectionError:
            return
