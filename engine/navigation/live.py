"""Live matching: answer frames by a deadline as they are captured. The queue holds one frame, the newest.

A worker thread matches. A watchdog answers in its place if the deadline comes first, and replaces it if it hangs
or dies. A worker's result is discarded if its frame was already answered.
"""

from __future__ import annotations

import logging
import math
import operator
import threading
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from functools import partial

from engine.budget import Budget
from engine.errors import EngineError, StateError
from engine.navigation.navigator import Navigator
from engine.runtime.realtime import Realtime, check_realtime, start_thread
from engine.values import Fix, Frame, NoFix, Prior, Reason, Result, check, check_positive

_log = logging.getLogger("scenematch")

_JOIN_S = 5.0  # closing waits this long for abandoned workers, then leaves them behind
_MAX_MS = 60_000.0  # of any wait in flight
_LOOK_S = 0.02  # longest wait while something is due, since a simulator's clock may be faster


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """How long to wait for a frame and for a worker.

    Attributes:
        deadline_ms: age since capture by which a frame is answered.
        patience_ms: time beyond the deadline after which a worker counts as hanging and is replaced; also the
            pause after a navigator could not be created.
        realtime: how to schedule the worker and the watchdog; None leaves scheduling unchanged.

    Raises:
        OptionError: a wait is not positive, or is longer than a minute.
    """

    deadline_ms: float = 121.0
    patience_ms: float = 1000.0
    realtime: Realtime | None = None

    def __post_init__(self) -> None:
        check_positive(self, "deadline_ms", "patience_ms")
        for name in ("deadline_ms", "patience_ms"):
            check(self, name, f"at most {_MAX_MS:g}", lambda wait_ms: wait_ms <= _MAX_MS)


@dataclass(frozen=True, slots=True)
class Answer:
    """The outcome of one frame.

    Attributes:
        frame: as it was submitted.
        result: its fix, or why there is none.
        age_ms: from capture to output.
    """

    frame: Frame
    result: Result
    age_ms: float


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts of frames: submitted = answered + dropped + at most one waiting and one in work."""

    submitted: int
    dropped: int
    answered: int
    late: int
    workers_replaced: int

    def __add__(self, other: Counts) -> Counts:
        """Those of two pipelines together."""
        return Counts(*map(operator.add, astuple(self), astuple(other)))


@dataclass(slots=True, eq=False)
class _Job:
    frame: Frame
    prior: Prior | None
    captured_ns: int
    submitted_ns: int  # on the machine's clock, by which a hanging worker is detected
    answered: bool = False


class Live:
    """Answers a stream of frames.

    Args:
        make_navigator: creates a navigator that starts at a prior, or anywhere if that is None; called once by the
            constructor, and in a worker's thread after the last one died or hung.
        deliver: called with each answer, one at a time, from one of the engine's threads.
        start: where the flight begins.
        options: settings.
        clock_ns: clock of the frames' capture and age, such as a simulator's; None is ``time.monotonic_ns``.

    Raises:
        OptionError, BackendError: real time was requested, and the system is not Linux or does not permit it.

    Convention:
        Python cannot stop a thread: a hanging one is abandoned and its results are ignored. A hang that holds
        Python's global lock stops the whole process.
    """

    def __init__(
        self,
        make_navigator: Callable[[Prior | None], Navigator],
        deliver: Callable[[Answer], None],
        start: Prior | None = None,
        options: LiveOptions | None = None,
        clock_ns: Callable[[], int] | None = None,
    ) -> None:
        self._make_navigator, self._deliver = make_navigator, deliver
        self._options, self._clock_ns = options or LiveOptions(), clock_ns or time.monotonic_ns
        self._last: tuple[Fix | Prior, int, Navigator] | None = None  # where, when, and whose
        self._anew: Prior | None = None  # where a new navigator was asked to start
        self._changed = threading.Condition()
        self._delivering = threading.Lock()
        self._waiting: _Job | None = None
        self._working: _Job | None = None
        self._number = 0  # of the current worker
        self._counts = dict.fromkeys(Counts.__dataclass_fields__, 0)
        self._closed = False
        self._threads: list[threading.Thread] = []
        check_realtime(self._options.realtime)
        navigator = make_navigator(start)
        if start is not None:
            self._last = (start, self._clock_ns(), navigator)
        self._start_thread(self._work, navigator, 0)
        self._start_thread(self._watch, above=1)  # a computing worker must not keep it from answering

    @property
    def counts(self) -> Counts:
        """The counts so far."""
        with self._changed:
            return Counts(**self._counts)

    def submit(self, frame: Frame, *, prior: Prior | None = None, captured_ns: int | None = None) -> None:
        """Submit the newest frame, and return at once; one that still waits is dropped.

        Args:
            frame: newer than every frame before it.
            prior: of its position by another source.
            captured_ns: time of capture on this pipeline's clock; None is now.

        Raises:
            StateError: the pipeline was closed.
        """
        job = _Job(frame, prior, self._clock_ns() if captured_ns is None else captured_ns, time.monotonic_ns())
        with self._changed:
            if self._closed:
                raise StateError("submit: expected an open pipeline, got one that was closed")
            self._counts["submitted"] += 1
            self._counts["dropped"] += self._waiting is not None
            self._waiting = job
            self._changed.notify_all()

    def restart(self, start: Prior) -> None:
        """Match the next frame with a new navigator, since the present one follows a wrong track.

        Args:
            start: where the new one starts.
        """
        with self._changed:
            self._anew = start
            self._changed.notify_all()

    def close(self) -> None:
        """Take no more frames; the one in work is still answered, one that waits is dropped.

        Also waits for workers whose frames were answered without them: a process that ends while one of its
        threads runs compiled code is aborted.
        """
        with self._changed:
            self._closed = True
            self._counts["dropped"] += self._waiting is not None
            self._waiting = None
            self._changed.notify_all()
            job, due_s = self._working, (self._options.deadline_ms + self._options.patience_ms) * 1e-3
            self._changed.wait_for(lambda: self._working is None and (job is None or job.answered), timeout=due_s)
        until = time.monotonic() + _JOIN_S
        for thread in self._threads:
            if thread is not threading.current_thread():  # the receiver may also call close
                thread.join(max(0.0, until - time.monotonic()))

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _work(self, navigator: Navigator | None, number: int) -> None:
        """The worker: takes the newest frame, matches it, and delivers the result if it is not too late."""
        start: Prior | None = None
        while True:
            navigator, start = navigator or self._create_navigator(start), None
            with self._changed:
                self._changed.wait_for(
                    lambda: self._waiting or self._anew or self._closed or self._number != number
                )
                if self._number != number:
                    return  # replaced meanwhile
                if self._anew is not None:
                    navigator, start, self._anew = None, self._anew, None
                    continue
                if self._waiting is None or navigator is None:
                    return
                job, self._working, self._waiting = self._waiting, self._waiting, None
                self._changed.notify_all()
            result, alive = self._match(navigator, job)
            with self._changed:
                if self._number != number:
                    return  # replaced meanwhile
                self._working = None
                self._changed.notify_all()
                if isinstance(result, Fix):
                    self._last = (result, job.captured_ns, navigator)
            self._answer(job, result)
            if not alive:
                navigator = None
                with self._changed:
                    self._counts["workers_replaced"] += 1

    def _create_navigator(self, start: Prior | None) -> Navigator | None:
        """A navigator that starts there, else where the last one was; tried again until closing if it fails."""
        while not self._closed:
            try:
                return self._make_navigator(start or self._resume())
            except Exception:
                _log.exception("make_navigator failed; tried again after %g ms", self._options.patience_ms)
            with self._changed:
                self._changed.wait_for(lambda: self._closed, timeout=self._options.patience_ms * 1e-3)
        return None

    def _match(self, navigator: Navigator, job: _Job) -> tuple[Result, bool]:
        """The result of one frame, and whether the navigator is still usable."""
        left_ms = self._options.deadline_ms - self._age_ms(job)
        if left_ms <= 0:
            return _refusal(job, Reason.LATE, "the frame waited until its deadline"), True
        try:
            # A search of the whole map may outlast its frame's deadline: the next frame profits from it.
            budget = Budget(total_ms=left_ms, search_ms=left_ms + self._options.patience_ms)
            return navigator.update(job.frame, job.prior, budget), True
        except EngineError as error:  # this frame is unusable; the next may be usable
            return _refusal(job, Reason.FAILED, str(error)), True
        except Exception as error:
            return _refusal(job, Reason.FAILED, f"{type(error).__name__}: {error}"), False

    def _watch(self) -> None:
        """The watchdog: answers frames that are due and replaces a worker that hangs."""
        while True:
            with self._changed:
                if self._closed and self._working is None:
                    return
                jobs = [job for job in (self._working, self._waiting) if job is not None and not job.answered]
                due = [job for job in jobs if self._age_ms(job) >= self._options.deadline_ms]
                hangs_in_ms = self._hangs_in_ms()
                replaces = hangs_in_ms <= 0 and not self._closed
                if self._waiting in due:
                    self._waiting = None
                if hangs_in_ms <= 0:  # it is abandoned: its results are ignored
                    self._working = None
                    self._number += replaces
                    self._counts["workers_replaced"] += replaces
                    self._changed.notify_all()
                elif not due:
                    left_ms = min([hangs_in_ms, *(self._options.deadline_ms - self._age_ms(job) for job in jobs)])
                    wait_s = min(max(left_ms, 0.0) * 1e-3, _LOOK_S)
                    self._changed.wait(wait_s if math.isfinite(left_ms) else None)
                    continue
            for job in due:
                self._answer(job, _refusal(job, Reason.LATE, "no answer by the deadline"))
            if replaces:
                self._start_thread(self._work, None, self._number)

    def _hangs_in_ms(self) -> float:
        """Time until the worker counts as hanging on a frame that was answered without it."""
        if self._working is None or not self._working.answered:
            return math.inf
        since_ns = time.monotonic_ns() - self._working.submitted_ns
        return self._options.deadline_ms + self._options.patience_ms - since_ns * 1e-6

    def _answer(self, job: _Job, result: Result) -> None:
        """Deliver one answer per frame; a late fix becomes a refusal."""
        with self._delivering:
            age_ms = self._age_ms(job)
            late = age_ms > self._options.deadline_ms
            with self._changed:
                if job.answered:
                    return
                job.answered = True
                self._counts["answered"] += 1
                self._counts["late"] += late
                self._changed.notify_all()
            if late and isinstance(result, Fix):
                result = _refusal(job, Reason.LATE, f"the fix came {age_ms:.0f} ms after capture")
            try:
                self._deliver(Answer(job.frame, result, age_ms))
            except Exception:  # an error in the receiver must not stop the answers
                _log.exception("deliver failed")

    def _resume(self) -> Prior | None:
        """Where a new worker starts: at the last fix, else the start, as far as the vehicle may have moved."""
        with self._changed:
            last = self._last
        if last is None:
            return None
        place, captured_ns, navigator = last
        moved_m = navigator.options.max_speed_mps * max(self._clock_ns() - captured_ns, 0) * 1e-9
        if isinstance(place, Prior):
            return replace(place, sigma_m=place.sigma_m + moved_m)
        return Prior(east_m=place.east_m, north_m=place.north_m, sigma_m=place.sigma_m + moved_m)

    def _start_thread(self, target: Callable[..., None], *args: object, above: int = 0) -> None:
        name = f"scenematch-{target.__name__}"
        thread = start_thread(partial(target, *args), name, self._options.realtime, above=above)
        with self._changed:
            self._threads = [*(other for other in self._threads if other.is_alive()), thread]

    def _age_ms(self, job: _Job) -> float:
        return max(self._clock_ns() - job.captured_ns, 0) * 1e-6


def _refusal(job: _Job, reason: Reason, detail: str) -> NoFix:
    return NoFix(reason=reason, detail=detail, timestamp_ns=job.frame.timestamp_ns)
