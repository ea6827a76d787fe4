"""The scheduler: times the stages of one frame, and decides which of its steps there is time for.

A step costs the median of its last runs in processor time, and some deviations; times how busy the machine is it
must fit into the time left. No single run decides: a step that never ran, or once, is begun.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from statistics import median_low
from typing import TypeVar

from engine.budget import Deadline
from engine.runtime import threads
from engine.runtime.device import Device, synchronise
from engine.runtime.loops import loops_compiled

_T = TypeVar("_T")
RUNS, STAGES = 15, 48  # that count: the last of a step, and of all stages, which are some six frames
DEVIATIONS = 5.0  # median absolute ones above the median
SEVERAL = 10.0  # medians of what its runs took: a step never seems dearer
FADE, FORGOTTEN = (
    0.99,
    4,
)  # by a refusal: the share of the cost that is left, and stages, so that a step is tried again
MAX_WAIT_MS = 20.0  # for the processor, that a fix is protected from


class OutOfTime(Exception):  # noqa: N818 - no error, and never seen by a caller of the engine
    """The deadline has passed within a step, which is abandoned."""


class Costs:
    """What steps cost on this machine, per unit of their work, whatever that is; and how busy the machine is."""

    def __init__(self) -> None:
        self._runs: dict[Hashable, deque[tuple[float, float]]] = {}  # milliseconds on the processor, and taken
        self._refusals: dict[Hashable, int] = {}  # since the last run
        self.stages_ms: deque[tuple[float, float]] = deque(maxlen=STAGES)  # used and waited, of all steps

    def learn(self, step: Hashable, work: float, used_ms: float, took_ms: float) -> None:
        """Note a run of a step, which outdates one before it for each refusal in between."""
        runs, work = self._runs.setdefault(step, deque(maxlen=RUNS)), max(work, 1.0)
        for _ in range(min(self._refusals.pop(step, 0), len(runs) - 1)):
            runs.popleft()
        runs.append((used_ms / work, took_ms / work))

    def note_refusal(self, step: Hashable) -> None:
        """Note that a step was refused for its cost."""
        self._refusals[step] = self._refusals.get(step, 0) + 1
        for _ in range(min(FORGOTTEN, len(self.stages_ms))):
            self.stages_ms.popleft()

    def needed_ms(self, step: Hashable, work: float) -> float:
        """Time that a step needs; 0 if there are no two runs to judge by."""
        runs = tuple(self._runs.get(step, ()))
        if len(runs) < 2:
            return 0.0
        usual = median_low([used for used, _ in runs])
        bound = self.load() * (usual + DEVIATIONS * median_low([abs(used - usual) for used, _ in runs]))
        bound = min(bound, SEVERAL * median_low([took for _, took in runs]))
        return bound * max(work, 1.0) * FADE ** self._refusals.get(step, 0)

    def load(self) -> float:
        """Time taken over time used by the stages of late, the longest wait left out; 1 on an idle machine."""
        stages = tuple(self.stages_ms)
        return 1.0 + sum(sorted(waited for _, waited in stages)[:-1]) / max(sum(used for used, _ in stages), 1e-3)

    def wait_ms(self) -> float:
        """How long a step may have to wait for the processor: the second longest wait of late."""
        return min(sorted([0.0, 0.0, *(waited for _, waited in tuple(self.stages_ms))])[-2], MAX_WAIT_MS)


class Scheduler:
    """Times the stages of one frame by a deadline that runs, and decides which steps there is time for."""

    def __init__(self, deadline: Deadline, device: Device, costs: Costs | None = None) -> None:
        self.deadline, self._device, self.costs = deadline, device, costs or Costs()
        self.stages_ms: dict[str, float] = {}
        self._step: tuple[Hashable, float] | None = None  # that is being done, and its work
        self.has_fix = self._is_under_way = False

    def can_afford(self, works: Mapping[Hashable, float]) -> bool:
        """Whether there is time for steps of so much work, one after the other; a fix must survive a wait too."""
        needed_ms = sum(self.costs.needed_ms(step, work) for step, work in works.items())
        return needed_ms + (self.costs.wait_ms() if self.has_fix else 0.0) <= self.deadline.remaining_ms

    def first_affordable(self, step: str, works: Mapping[_T, float]) -> _T | None:
        """The first variant of a step, by its work, that there is time for; None if there is none."""
        return next((variant for variant, work in works.items() if self.can_afford({(step, variant): work})), None)

    @contextmanager
    def with_fix(self) -> Iterator[None]:
        """Within it there is a fix already: what would make it late is abandoned before the deadline."""
        outer, self.has_fix = self.has_fix, True
        try:
            yield
        finally:
            self.has_fix = outer

    @contextmanager
    def costed(self, step: Hashable, work: float) -> Iterator[None]:
        """Learn what a step of so much work costs: one that is abandoned, more than the time that it had."""
        outer, self._step, self._is_under_way = self._step, (step, work), False
        learn, had_ms = self._stopwatch(), self.deadline.remaining_ms
        try:
            yield
        except OutOfTime:
            self.costs.learn(step, work, had_ms / self.costs.load(), had_ms)
            raise
        finally:
            self._step = outer
        learn(step, work)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time one stage; OutOfTime if it is a step's and the deadline has passed, or would beside a fix."""
        key, work = ((self._step[0], name), self._step[1]) if self._step else (None, 0.0)
        if key and not self.deadline.met:
            raise OutOfTime
        # Whether the first stage of a step can be afforded was asked when the step began.
        if key and self.has_fix and self._is_under_way and not self.can_afford({key: work}):
            self.costs.note_refusal(key)
            raise OutOfTime
        start_ms, learn, self._is_under_way = self.deadline.elapsed_ms, self._stopwatch(), True
        try:
            yield
        finally:
            synchronise(self._device)
            self.stages_ms[name] = self.stages_ms.get(name, 0.0) + self.deadline.elapsed_ms - start_ms
        self.costs.stages_ms.extend(learn(key, work))

    def _stopwatch(self) -> Callable[[Hashable, float], list[tuple[float, float]]]:
        """A function that learns what was done since, unless that compiled; milliseconds used, and waited."""
        start_ms, start_ns, compiled = self.deadline.elapsed_ms, time.thread_time_ns(), loops_compiled()

        def learn(step: Hashable, work: float) -> list[tuple[float, float]]:
            took_ms, used_ms = self.deadline.elapsed_ms - start_ms, (time.thread_time_ns() - start_ns) * 1e-6
            if loops_compiled() != compiled:
                return []
            if self._device.type != "cpu" or threads.count() > 1:  # others worked while this thread waited
                used_ms = took_ms
            self.costs.learn(step, work, used_ms, took_ms)
            return [(used_ms, max(took_ms - used_ms, 0.0))]

        return learn
