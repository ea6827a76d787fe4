"""Executors: many jobs, each in a fresh process, on this machine's cores or on a Ray cluster, with equal results.

An executor is a context that gives a function ``execute(run, jobs)``, which yields each job when it is over, with
what ``run`` returned of it: None, or why it failed. It knows nothing of what a job is.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol, TypeVar

from engine.errors import BackendError, OptionError, require

J = TypeVar("J")
LOCAL = "local"
"""The address that stands for a Ray cluster of this machine alone, made for the campaign."""
_STORE_BYTES = 80_000_000  # jobs and answers are small; Ray would take a third of the memory


class Execute(Protocol):
    """Do each job in a fresh process; yields it with None, or with why it failed, in the order of ending."""

    def __call__(self, run: Callable[[J], str | None], jobs: Sequence[J]) -> Iterator[tuple[J, str | None]]:
        """See the class."""


@contextlib.contextmanager
def in_processes(workers: int) -> Iterator[Execute]:
    """Processes of this machine, so many at a time. They end with the process that started them."""
    spawn = multiprocessing.get_context("spawn")

    def start(run: Callable[[J], str | None], job: J) -> tuple[Any, Connection]:
        receive, send = spawn.Pipe(duplex=False)
        process = spawn.Process(target=_child, args=(run, job, send), daemon=True)
        process.start()
        send.close()  # the child's end is the only one left: when it ends, the pipe does
        return process, receive

    def execute(run: Callable[[J], str | None], jobs: Sequence[J]) -> Iterator[tuple[J, str | None]]:
        waiting, running = deque(jobs), dict[Any, tuple[Any, J]]()  # by the end of the pipe that is listened to
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    job = waiting.popleft()
                    process, receive = start(run, job)
                    running[receive] = process, job
                for ready in wait(list(running)):
                    process, job = running.pop(ready)
                    yield job, _result(process, ready)
        finally:
            for process, _ in running.values():
                process.terminate()
                process.join()

    yield execute


def _child(run: Callable[[J], str | None], job: J, send: Connection) -> None:
    """The process of one job."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is asked, and ends us
    threading.Thread(target=_end_with_parent, daemon=True).start()
    send.send(run(job))


def _end_with_parent() -> None:
    """A parent that was killed leaves no one who waits for this job."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _result(process: Any, receive: Any) -> str | None:
    """What the process returned, or how it ended."""
    try:
        failure: str | None = receive.recv()
    except EOFError:
        process.join()
        code = process.exitcode
        failure = f"its process was ended by signal {-code}" if code < 0 else f"its process ended with code {code}"
    receive.close()
    process.join()
    return failure


@contextlib.contextmanager
def on_ray(address: str, workers: int | None) -> Iterator[Execute]:
    """A Ray cluster, a CPU and a fresh worker process a job.

    Args:
        address: of a cluster, "auto" for the one that this machine belongs to, or :data:`LOCAL`.
        workers: how many jobs a local cluster does at a time; None is one a core. Another has its own number.

    Raises:
        OptionError: a number of workers for a cluster that is not local.
        MissingExtraError: Ray is not installed.
        BackendError: there is no cluster at the address.
    """
    if workers is not None and address != LOCAL:
        raise OptionError(f"workers: expected none with a cluster that has its own number, got {workers}")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no usage statistics leave this machine
    ray = require("ray", "ray")
    local: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False, "object_store_memory": _STORE_BYTES}
    where = {"address": LOCAL, **local} if address == LOCAL else {"address": address}
    try:
        ray.init(**where, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray's own start raises no narrower one
        reason = str(error).strip().partition("\n")[0]
        raise BackendError(f"ray: expected a cluster at {address!r}, got none: {reason}") from None

    def execute(run: Callable[[J], str | None], jobs: Sequence[J]) -> Iterator[tuple[J, str | None]]:
        task = ray.remote(num_cpus=1, max_calls=1, max_retries=0)(run)
        running = {task.remote(job): job for job in jobs}
        while running:
            done, _ = ray.wait(list(running), num_returns=1)
            job = running.pop(done[0])
            try:
                failure = ray.get(done[0])
            except ray.exceptions.RayError as error:
                failure = f"its process ended: {str(error).strip().partition(chr(10))[0]}"
            yield job, failure

    try:
        yield execute
    finally:
        ray.shutdown()
