"""The scheduler: times the stages of one frame against its deadline, and decides which steps there is time for.

Costs are learned (:mod:`engine.methods.costs`): an upper bound of a step's cost is known before it begins, and a
step that would end too late is not begun. Without a budget every step is affordable.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar

from engine import threads
from engine.budget import Deadline
from engine.device import Device, synchronise
from engine.methods.costs import Costs
from engine.methods.preemption import thread_usage, waited_ms
from engine.values import Fix, Timings

_T = TypeVar("_T")


class OutOfTime(Exception):  # noqa: N818 - no error, and never seen by a caller of the engine
    """The deadline has passed within a step, which is abandoned."""


class Scheduler:
    """Times the stages of one frame, and decides which steps there is time for.

    Args:
        deadline: runs already.
        device: work on it is waited for when a stage ends.
        costs: of the steps, updated by each that runs.
    """

    def __init__(self, deadline: Deadline, device: Device, costs: Costs | None = None) -> None:
        self.deadline = deadline
        self._device = device
        self._costs = costs or Costs()
        self._costs.begin_frame()
        self._stages_ms: dict[str, float] = {}
        self._step: tuple[str, float] | None = None  # that is being done, and its work
        self._has_fix = self._is_under_way = False

    @property
    def has_fix(self) -> bool:
        """Whether there is a fix already, which a step that comes too late would lose."""
        return self._has_fix

    def can_afford(self, step: str, work: float) -> bool:
        """Whether the time that is left suffices for a step of this much work; True for one that never ran."""
        return self.can_afford_all({step: work})

    def can_afford_all(self, works: Mapping[str, float]) -> bool:
        """Whether the time that is left suffices for several steps, by their work, one after the other.

        Beside a fix that would be lost it must suffice as well for one preemption as long as the longest of late.
        """
        needed_ms = sum(self._costs.upper_bound_ms(step, work) for step, work in works.items())
        room_ms = self._costs.preemption_ms if self._has_fix else 0.0
        return needed_ms + room_ms <= self.deadline.remaining_ms

    def first_affordable(self, step: str, works: Mapping[_T, float]) -> _T | None:
        """The first variant of a step, by its work, that there is time for; None where there is none."""
        return next((variant for variant, work in works.items() if self.can_afford(step, work)), None)

    def note_refusal(self, step: str) -> None:
        """Note that a step could not be afforded, see :meth:`engine.methods.costs.Costs.note_refusal`."""
        self._costs.note_refusal(step, has_fix=self._has_fix)

    def note_late(self, step: str) -> None:
        """Note that a frame has no answer because a step could not be afforded."""
        self.note_refusal(step)
        if not self._has_fix:
            self._costs.note_idle()

    @contextmanager
    def costed(self, step: str, work: float) -> Iterator[None]:
        """Learn what a step of this much work costs."""
        taken, outer, self._step = self._stopwatch(), self._step, (step, work)
        self._is_under_way = False
        try:
            yield
        except OutOfTime:
            self._costs.note_abandoned(step, work, *taken()[:2])
            raise
        finally:
            self._step = outer
        self._costs.learn(step, work, *taken()[:2])

    @contextmanager
    def with_fix(self) -> Iterator[None]:
        """Within it there is a fix already: what would make it late is abandoned before the deadline."""
        outer, self._has_fix = self._has_fix, True
        try:
            yield
        finally:
            self._has_fix = outer

    def improved(self, fix: Fix, step: str, work: float, improve: Callable[[Fix], _T]) -> Fix | _T:
        """What a step makes of a fix that is there already; the fix itself where there is no time for the step."""
        with self.with_fix():
            if not self.can_afford(step, work):
                self.note_refusal(step)
                return fix
            try:
                with self.costed(step, work):
                    return improve(fix)
            except OutOfTime:
                return fix

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage; stages of one name add up.

        Raises:
            OutOfTime: it is part of a step, and the deadline has passed before it; or it would pass within it, and
                there is a fix.
        """
        step, work = self._step or ("", 0.0)
        stage = f"{step}: {name}"
        if self._step is not None:
            if not self.deadline.met:
                raise OutOfTime
            # Whether the first stage of a step can be afforded was asked when the step began.
            if self._has_fix and self._is_under_way and not self.can_afford(stage, work):
                self.note_refusal(stage)
                raise OutOfTime
            self._is_under_way = True
        taken = self._stopwatch()
        try:
            yield
        finally:
            synchronise(self._device)
            took_ms, waiting_ms, preemptions = taken()
            self._stages_ms[name] = self._stages_ms.get(name, 0.0) + took_ms
        if self._step is not None:
            self._costs.learn(stage, work, took_ms, waiting_ms)
            if preemptions:
                self._costs.note_preemption(waiting_ms / preemptions)

    def _stopwatch(self) -> Callable[[], tuple[float, float, int]]:
        """Says how many milliseconds have passed since it was made, and how many of them, how often, it waited.

        Where other threads or a device do the work, its own time tells nothing of it, and all counts as work.
        """
        start_ms, works_alone = self.deadline.elapsed_ms, self._device.type == "cpu" and threads.count() == 1
        before = thread_usage() if works_alone else None

        def taken() -> tuple[float, float, int]:
            took_ms = self.deadline.elapsed_ms - start_ms
            if before is None:
                return took_ms, 0.0, 0
            after = thread_usage()
            return took_ms, waited_ms(before, after, took_ms), after.preemptions - before.preemptions

        return taken

    @property
    def timings(self) -> Timings:
        """What was measured so far."""
        return Timings(dict(self._stages_ms))
