"""Executors: many jobs, each in a fresh process, on this machine's cores or on a Ray cluster, with equal results.

An executor is a context that gives a function ``execute(do, jobs)``, which yields each job when it is over, with
what ``do`` said of it: None, or why it failed. It knows nothing of what a job is.
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

from engine.errors import BackendError, OptionError

J = TypeVar("J")
LOCAL = "local"
"""The address that stands for a Ray cluster of this machine alone, made for the campaign."""
_STORE_BYTES = 80_000_000  # jobs and answers are small; Ray would take a third of the memory


class Execute(Protocol):
    """Do each job in a fresh process; yields it with None, or with why it failed, in the order of ending."""

    def __call__(self, do: Callable[[J], str | None], jobs: Sequence[J]) -> Iterator[tuple[J, str | None]]:
        """See the class."""


@contextlib.contextmanager
def in_processes(workers: int) -> Iterator[Execute]:
    """Processes of this machine, so many at a time. They end with the process that started them."""
    spawn = multiprocessing.get_context("spawn")

    def start(do: Callable[[J], str | None], job: J) -> tuple[Any, Connection]:
        receive, send = spawn.Pipe(duplex=False)
        process = spawn.Process(target=_child, args=(do, job, send), daemon=True)
        process.start()
        send.close()  # the child's end is the only one left: when it ends, the pipe does
        return process, receive

    def execute(do: Callable[[J], str | None], jobs: Sequence[J]) -> Iterator[tuple[J, str | None]]:
        waiting, running = deque(jobs), dict[Any, tuple[Any, J]]()  # by the end of the pipe that is listened to
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    job = waiting.popleft()
                    process, receive = start(do, job)
                    running[receive] = process, job
                for spoken in wait(list(running)):
                    process, job = running.pop(spoken)
                    yield job, _answer(process, spoken)
        finally:
            for process, _ in running.values():
                process.terminate()
                process.join()

    yield execute


def _child(do: Callable[[J], str | None], job: J, send: Connection) -> None:
    """The process of one job."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is asked, and ends us
    threading.Thread(target=_end_with_parent, daemon=True).start()
    send.send(do(job))


def _end_with_parent() -> None:
    """A parent that was killed leaves no one who waits for this job."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _answer(process: Any, receive: Any) -> str | None:
    """What the process said, or how it ended."""
    try:
        said: str | None = receive.recv()
    except EOFError:
        process.join()
        code = process.exitcode
        said = f"its process was ended by signal {-code}" if code < 0 else f"its process ended with code {code}"
    receive.close()
    process.join()
    return said


@contextlib.contextmanager
def on_ray(address: str, workers: int | None) -> Iterator[Execute]:
    """A Ray cluster, a CPU and a fresh worker process a job.

    Args:
        address: of a cluster, "auto" for the one that this machine belongs to, or :data:`LOCAL`.
        workers: how many jobs a local cluster does at a time; None is one a core. Another has its own number.

    Raises:
        OptionError: a number of workers for a cluster that is not local.
        BackendError: Ray is not installed, or there is no cluster at the address.
    """
    if workers is not None and address != LOCAL:
        raise OptionError(f"--workers: expected none with a cluster that has its own number, got {workers}")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anybody
    try:
        import ray
    except ImportError:
        raise BackendError("--ray: expected Ray, got none; the extra [ray]: pip install ray") from None

    local: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False, "object_store_memory": _STORE_BYTES}
    where = {"address": LOCAL, **local} if address == LOCAL else {"address": address}
    try:
        ray.init(**where, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray's own start raises no narrower one
        reason = str(error).strip().partition("\n")[0]
        raise BackendError(f"--ray: expected a cluster at {address!r}, got none: {reason}") from None

    def execute(do: Callable[[J], str | None], jobs: Sequence[J]) -> Iterator[tuple[J, str | None]]:
        task = ray.remote(num_cpus=1, max_calls=1, max_retries=0)(do)
        running = {task.remote(job): job for job in jobs}
        while running:
            done, _ = ray.wait(list(running), num_returns=1)
            job = running.pop(done[0])
            try:
                said = ray.get(done[0])
            except ray.exceptions.RayError as error:
                said = f"its process ended: {str(error).strip().partition(chr(10))[0]}"
            yield job, said

    try:
        yield execute
    finally:
        ray.shutdown()
