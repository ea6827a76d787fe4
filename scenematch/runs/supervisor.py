"""A supervisor: loads map and matcher once, and replaces a worker that dies by a forked copy.

The parent loads map and matcher and then only waits. Its children, copies made by ``fork``, have everything from
their first instruction.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress
from typing import Any

from engine.errors import OptionError
from scenematch.runs.output import SILENT, Progress

_PAUSE_S, _MAX_PAUSE_S = 0.05, 5.0  # before a worker is replaced; doubled each time a new one dies at once
_SHORT_S = 5.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def check_supervision(device: Any) -> None:
    """Refuse what cannot be supervised.

    Raises:
        OptionError: the system cannot fork, or the device cannot be shared with a forked process.
    """
    if not hasattr(os, "fork"):
        raise OptionError("supervise: expected a system that forks, as Linux does")
    if device.type != "cpu":
        raise OptionError(
            f"supervise: expected the device cpu, got {device.type}, which a forked process cannot use"
        )


def become_worker(progress: Progress = SILENT) -> None:
    """Fork a worker and return in it; the caller stays behind and forks a new one if it is killed.

    If a worker exits by itself, the supervisor exits with the same code. It passes SIGTERM on and leaves SIGINT,
    which a terminal sends to both, to the worker.
    """
    pause_s = _PAUSE_S
    reading, writing = os.pipe()  # its end is that of this process
    while True:
        begin = time.monotonic()
        waiting = _Waiting()
        worker = os.fork()
        if worker == 0:
            os.close(writing)
            _die_with_the_writer_of(reading)
            waiting.end()
            return
        code = waiting.for_end_of(worker)
        if code >= 0 or waiting.is_told:
            os._exit(max(code, 0))
        pause_s = min(2.0 * pause_s, _MAX_PAUSE_S) if time.monotonic() - begin < _SHORT_S else _PAUSE_S
        progress.message(f"the worker was ended by signal {-code}; another takes over")
        time.sleep(pause_s)


def _die_with_the_writer_of(pipe: int) -> None:
    """End this process when its parent is killed: two bridges on one autopilot would conflict."""

    def watch() -> None:
        os.read(pipe, 1)  # returns when the parent is gone
        os._exit(1)

    threading.Thread(target=watch, name="scenematch-supervised", daemon=True).start()


class _Waiting:
    """Handle signals while waiting for a worker; starts before the fork, so that none is lost.

    Signals stay blocked until the parent knows its worker and the worker has its own handlers back.
    """

    def __init__(self) -> None:
        self.is_told = False  # to end
        self._worker, self._is_passed_on = 0, False
        self._mask = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
        self._handlers = {number: signal.signal(number, self._receive) for number in _SIGNALS}

    def for_end_of(self, worker: int) -> int:
        """Its exit code, below 0 the signal that killed it."""
        self._worker = worker
        self._pass_on()  # another thread may already have taken a signal
        signal.pthread_sigmask(signal.SIG_SETMASK, self._mask)
        code = os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1])
        self._worker = 0  # the process id may be reused
        self.end()
        return code

    def end(self) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, self._mask)

    def _receive(self, number: int, _frame: object) -> None:
        if number == signal.SIGTERM:
            self.is_told = True
            self._pass_on()

    def _pass_on(self) -> None:
        if self.is_told and self._worker and not self._is_passed_on:
            self._is_passed_on = True
            with suppress(ProcessLookupError):  # it ended meanwhile
                os.kill(self._worker, signal.SIGTERM)


def end_on_sigterm() -> None:
    """Let SIGTERM end a run like Ctrl-C does, with its table; call it in the main thread."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
