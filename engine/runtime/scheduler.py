"""The scheduler: times the stages of one frame and decides which steps time allows, by what they have cost so far.

If a frame's last resort does not fit into the time left, it is started nevertheless unless even its quickest
recent run would be too long.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager

from engine.budget import Deadline
from engine.runtime import threads
from engine.runtime.device import Device, synchronise
from engine.runtime.step_costs import Costs

ANSWER = "answer"
"""What follows the last step, as a step."""

Stopwatch = Callable[[], tuple[float, float]]


class OutOfTime(Exception):  # noqa: N818 - no error, and never seen by a caller of the engine
    """The deadline passed within a step, which is abandoned."""


class Scheduler:
    """Times the stages of one frame against its deadline and decides which steps time allows."""

    def __init__(self, deadline: Deadline, device: Device, costs: Costs | None = None) -> None:
        self.deadline, self._device, self.costs = deadline, device, costs or Costs()
        self.stages_ms: dict[str, float] = {}
        self._step: tuple[Hashable, float] | None = None  # the running step and its work
        self._begun: list[tuple[Hashable, Stopwatch]] = []  # its stages so far
        self._since_step: Stopwatch | None = None  # the last one ended
        self._refused: set[Hashable] = set()
        self.has_fix = self._has_run = False

    def can_afford(self, works: Mapping[Hashable, float]) -> bool:
        """Whether time allows successive steps of this work; with a fix, also the answer and one wait."""
        needed_ms = sum(self.costs.needed_ms(step, work, has_fix=self.has_fix) for step, work in works.items())
        if self.has_fix:
            needed_ms += self.costs.needed_ms(ANSWER, 1.0) + self.costs.wait_ms()
        return needed_ms <= self.deadline.remaining_ms

    def is_hopeless(self, step: Hashable, work: float) -> bool:
        """Whether no recent run of a step was quick enough for the time left, or a fix would be at stake."""
        return self.has_fix or self.costs.least_ms(step, work) > self.deadline.remaining_ms

    def note_refusal(self, step: Hashable) -> None:
        """Record that a step was refused for its cost, once a frame."""
        if step not in self._refused:
            self.costs.note_refusal(step, is_idle=not (self._has_run or self._refused))
            self._refused.add(step)

    @contextmanager
    def with_fix(self, has_fix: bool = True) -> Iterator[None]:
        """Protect a fix, if there is one: abandon work before the deadline that would make it late."""
        outer, self.has_fix = self.has_fix, self.has_fix or has_fix
        try:
            yield
        finally:
            self.has_fix = outer

    @contextmanager
    def costed(self, step: Hashable, work: float) -> Iterator[None]:
        """Learn a step's cost for this work, and that of its rest from each stage on.

        An abandoned step costs more than the time it had.
        """
        outer, self._step, self._begun, self._has_run = (self._step, self._begun), (step, work), [], True
        spent, had_ms = self._stopwatch(), self.deadline.remaining_ms
        try:
            yield
        except OutOfTime:
            self.costs.learn(step, work, had_ms / self.costs.load(), had_ms)
            raise
        else:
            for key, since in [(step, spent), *self._begun]:
                self.costs.learn(key, work, *since())
        finally:
            self._step, self._begun = outer
            self._since_step = self._stopwatch()

    def note_answer(self) -> None:
        """Learn how long the answer takes after the last step."""
        if self._since_step is not None:
            self.costs.learn(ANSWER, 1.0, *self._since_step())

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage; OutOfTime within a step if the deadline has passed, or its rest would lose a fix."""
        start_ms, spent = self.deadline.elapsed_ms, self._stopwatch()
        if self._step is not None:
            (step, work), count = self._step, len(self._begun)
            rest = (step, name, count)
            if not self.deadline.met:
                raise OutOfTime
            if count and self.has_fix and not self.can_afford({rest: work}):  # the step's start checked all of it
                self.note_refusal(rest)
                raise OutOfTime
            self._begun.append((rest, spent))
        try:
            yield
        finally:
            synchronise(self._device)
            self.stages_ms[name] = self.stages_ms.get(name, 0.0) + self.deadline.elapsed_ms - start_ms
        self.costs.note_stage(*spent())

    def _stopwatch(self) -> Stopwatch:
        """A function that gives the milliseconds used and taken since."""
        start_ms, start_ns = self.deadline.elapsed_ms, time.thread_time_ns()

        def spent() -> tuple[float, float]:
            took_ms, used_ms = self.deadline.elapsed_ms - start_ms, (time.thread_time_ns() - start_ns) * 1e-6
            if self._device.type != "cpu" or threads.count() > 1:  # other threads worked while this one waited
                used_ms = took_ms
            return used_ms, took_ms

        return spent
