"""The scheduler: times the stages of one frame and decides which steps time allows.

A step's cost is the median processor time of its last runs plus some deviations. Multiplied by the machine's load,
it must fit into the time left. No single run decides: a step with fewer than two runs is always started. If a
frame's last resort does not fit, it is started nevertheless unless even its quickest recent run would be too long.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from statistics import median_low

from engine.budget import Deadline
from engine.runtime import threads
from engine.runtime.device import Device, synchronise

RUNS, STAGES, WAITS = 15, 48, 240  # of a step, of all stages (some six frames), and of their waits, that count
DEVIATIONS, SEVERAL = (2.0, 5.0), 10.0  # median absolute deviations, before and beside a fix; medians at most
FADE, FORGOTTEN = 0.99, 4  # per refusal: share of the cost that is left, and stages; so a step is tried again
MAX_WAIT_MS = 20.0  # longest wait for the processor that a fix is protected from
ANSWER = "answer"
"""What follows the last step, as a step."""

Stopwatch = Callable[[], tuple[float, float] | None]


def loops_compiled() -> int:
    """How often numba compiled a loop, or loaded one from its cache, so far; numba need not be imported."""
    jit = sys.modules.get("engine.runtime.jit")
    return 0 if jit is None else jit.count()


class OutOfTime(Exception):  # noqa: N818 - no error, and never seen by a caller of the engine
    """The deadline passed within a step, which is abandoned."""


class Costs:
    """Costs of steps, and of their rest from each stage on, per unit of work; and the machine's load.

    Threads share them, so a deque is read by list(): within tuple() the garbage collector may let another in.
    """

    def __init__(self) -> None:
        self._runs: dict[Hashable, deque[tuple[float, float]]] = {}  # milliseconds on the processor, and taken
        self._refusals: dict[Hashable, int] = {}  # since the last run
        self._stages_ms: deque[tuple[float, float]] = deque(maxlen=STAGES)  # used and waited, of all steps
        self._waits_ms: deque[float] = deque(maxlen=WAITS)

    def learn(self, step: Hashable, work: float, used_ms: float, took_ms: float) -> None:
        """Record a run of a step or of its rest.

        If it was tried again after refusals, and took no more than it then seemed to need, it replaces an earlier
        run for each of them.
        """
        runs, work = self._runs.setdefault(step, deque(maxlen=RUNS)), max(work, 1.0)
        refusals = self._refusals.get(step, 0)
        if refusals and took_ms <= self.needed_ms(step, work):
            for _ in range(min(refusals, len(runs) - 1)):
                runs.popleft()
        self._refusals.pop(step, None)
        runs.append((used_ms / work, took_ms / work))

    def note_stage(self, used_ms: float, took_ms: float) -> None:
        """Record how long a stage used the processor and waited for it."""
        self._waits_ms.append(max(took_ms - used_ms, 0.0))
        self._stages_ms.append((used_ms, self._waits_ms[-1]))

    def note_refusal(self, step: Hashable, *, is_idle: bool) -> None:
        """Record that a step was refused for its cost; in a frame that ran none, the load may be over."""
        self._refusals[step] = self._refusals.get(step, 0) + 1
        for _ in range(min(FORGOTTEN, len(self._stages_ms)) if is_idle else 0):
            self._stages_ms.popleft(), self._waits_ms.popleft()

    def needed_ms(self, step: Hashable, work: float, *, has_fix: bool = True) -> float:
        """Time that a step needs; 0 with fewer than two runs."""
        runs = list(self._runs.get(step, ()))
        if len(runs) < 2:
            return 0.0
        usual = median_low([used for used, _ in runs])
        bound = self.load() * (usual + DEVIATIONS[has_fix] * median_low([abs(used - usual) for used, _ in runs]))
        bound = min(bound, SEVERAL * median_low([took for _, took in runs]))
        return bound * self._faded(step, work)

    def least_ms(self, step: Hashable, work: float) -> float:
        """Processor time that a step needs by its quickest recent run; 0 with fewer than two."""
        runs = list(self._runs.get(step, ()))
        return min(used for used, _ in runs) * self._faded(step, work) if len(runs) > 1 else 0.0

    def _faded(self, step: Hashable, work: float) -> float:
        return max(work, 1.0) * FADE ** self._refusals.get(step, 0)

    def load(self) -> float:
        """Elapsed over processor time of recent stages, without the longest wait; 1 on an idle machine."""
        stages = list(self._stages_ms)
        return 1.0 + sum(sorted(waited for _, waited in stages)[:-1]) / max(sum(used for used, _ in stages), 1e-3)

    def wait_ms(self) -> float:
        """How long a step may wait for the processor: the second longest recent wait."""
        return min(sorted([0.0, 0.0, *list(self._waits_ms)])[-2], MAX_WAIT_MS)


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
                if (used_and_took := since()) is not None:
                    self.costs.learn(key, work, *used_and_took)
        finally:
            self._step, self._begun = outer
            self._since_step = self._stopwatch()

    def note_answer(self) -> None:
        """Learn how long the answer takes after the last step."""
        if self._since_step is not None and (spent := self._since_step()) is not None:
            self.costs.learn(ANSWER, 1.0, *spent)

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
        if (used_and_took := spent()) is not None:
            self.costs.note_stage(*used_and_took)

    def _stopwatch(self) -> Stopwatch:
        """A function that gives the milliseconds used and taken since; None if loops were compiled."""
        start_ms, start_ns, compiled = self.deadline.elapsed_ms, time.thread_time_ns(), loops_compiled()

        def spent() -> tuple[float, float] | None:
            took_ms, used_ms = self.deadline.elapsed_ms - start_ms, (time.thread_time_ns() - start_ns) * 1e-6
            if self._device.type != "cpu" or threads.count() > 1:  # other threads worked while this one waited
                used_ms = took_ms
            return (used_ms, took_ms) if loops_compiled() == compiled else None

        return spent
