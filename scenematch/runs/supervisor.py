"""A supervisor: what is slow to load is loaded once, and a worker that dies is replaced by a copy of it.

The parent has loaded map and matcher and does nothing but wait. Its children, copies made by ``fork``, have all of
it from their first instruction on.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from typing import Any

from engine.errors import OptionError
from scenematch.runs.progress import SILENT, Progress

_PAUSE_S, _MAX_PAUSE_S = 0.05, 5.0  # before a worker is replaced; doubled where one after the other dies at once
_SHORT_S = 5.0


def check_supervision(device: Any) -> None:
    """Refuse what cannot be supervised.

    Raises:
        OptionError: the system cannot fork, or the device belongs to the process that has opened it.
    """
    if not hasattr(os, "fork"):
        raise OptionError("supervise: expected a system that forks, as Linux does")
    if device.type != "cpu":
        raise OptionError(f"supervise: expected the device cpu, got {device.type}, which no copy of a process has")


def become_worker(progress: Progress = SILENT) -> None:
    """Return in a worker, again and again: the caller stays behind to replace those that are killed.

    A worker that ends by itself, well or with an error, ends the supervisor, too, with its exit code. SIGTERM is
    passed on; SIGINT, which a terminal sends to both, is left to the worker.
    """
    pause_s = _PAUSE_S
    reading, writing = os.pipe()  # its end is that of this process
    while True:
        begin = time.monotonic()
        worker = os.fork()
        if worker == 0:
            os.close(writing)
            _die_with_the_writer_of(reading)
            return
        code, is_told = _wait(worker)
        if code >= 0 or is_told:
            os._exit(max(code, 0))
        pause_s = min(2.0 * pause_s, _MAX_PAUSE_S) if time.monotonic() - begin < _SHORT_S else _PAUSE_S
        progress.message(f"the worker was ended by signal {-code}; another takes over")
        time.sleep(pause_s)


def _die_with_the_writer_of(pipe: int) -> None:
    """End this process when its parent is killed: two bridges at one autopilot would push each other out."""

    def watch() -> None:
        os.read(pipe, 1)  # returns when nobody is left who could write
        os._exit(1)

    threading.Thread(target=watch, name="scenematch-supervised", daemon=True).start()


def _wait(worker: int) -> tuple[int, bool]:
    """The exit code of a worker, below 0 the signal that killed it, and whether it was asked to end."""
    asked = []

    def pass_on(number: int, _frame: object) -> None:
        asked.append(number)
        os.kill(worker, number)

    before = signal.signal(signal.SIGINT, signal.SIG_IGN), signal.signal(signal.SIGTERM, pass_on)
    try:
        return os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1]), bool(asked)
    finally:
        signal.signal(signal.SIGINT, before[0])
        signal.signal(signal.SIGTERM, before[1])


def end_on_sigterm() -> None:
    """Let SIGTERM end a run as Ctrl-C does, with its table; in the main thread, where signals can be handled."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
