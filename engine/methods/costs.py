"""What each step costs on this machine, learned every time that it runs.

What a step costs by itself, and how long it waits while other processes have the processor, are learned apart. The
second is a share of the first and common to all steps: a short step that was preempted is no dearer than before.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

_MEMORY = 0.93  # weight of a run after the next one: some fourteen runs count
_MAX_SURPRISE = 2.0  # a run counts for at most this factor of the expected cost: one outlier changes little
_SIGMAS = 3.0
_MIN_MS = 0.05
_DEVIATION_DECAY = 0.9  # of the deviation, each time that a step is refused for its cost
_COST_DECAY = 0.99  # of the cost itself, until the step is tried
# The same beside a fix, which a try that comes too late may lose: of a step a third too dear one frame in 400.
_DEVIATION_DECAY_BESIDE_FIX, _COST_DECAY_BESIDE_FIX = 0.995, 0.999
_MOST_WAITING = 10.0  # a step waits at most this many times what all steps of late waited together
# A first run that took longer, and so many times as long as the second, compiled.
_LEAST_COMPILED_MS, _COMPILED = 200.0, 10.0
_IDLE_DECAY = 0.8  # of the waiting, from frame to frame in which no step runs
_PREEMPTION_DECAY = 0.9  # of the longest preemption, from frame to frame
_ABANDONED = 1.25  # by what a step is thought to cost more than the time after which it was abandoned


@dataclass(slots=True)
class _CostModel:
    """Running sums of a line, ms = fixed + rate * work, and of the deviations from it."""

    weight: float = 0.0
    work: float = 0.0
    ms: float = 0.0
    work_work: float = 0.0
    work_ms: float = 0.0
    square: float = 0.0
    trust: float = 1.0  # share of the cost that is still believed after refusals

    def expected_ms(self, work: float) -> float:
        """The line's value, neither of its two parts negative."""
        mean_work, mean_ms = self.work / self.weight, self.ms / self.weight
        spread = self.work_work / self.weight - mean_work**2
        rate = 0.0
        if spread > 1e-3 * mean_work**2:
            rate = (self.work_ms / self.weight - mean_work * mean_ms) / spread
        elif work > mean_work > 0.0:  # only one amount of work was seen: more of it costs in proportion
            rate = mean_ms / mean_work
        rate = min(max(rate, 0.0), mean_ms / mean_work if mean_work > 0.0 else math.inf)
        return mean_ms + rate * (work - mean_work)

    def has_compiled(self, work: float, ms: float) -> bool:
        """Whether the only run so far did far more than this next one, in proportion to its work."""
        share = min(1.0, work / self.work) if self.work > 0.0 else 1.0
        return self.weight == 1.0 and self.ms > _LEAST_COMPILED_MS and share * self.ms > _COMPILED * ms

    def learn(self, work: float, ms: float) -> float:
        """Note a run, and return the milliseconds that count of it."""
        if self.weight > 0.0:
            if ms <= self.trust * self.expected_ms(work):  # it has become cheaper, as was tried
                self.ms *= self.trust
                self.work_ms *= self.trust
            expected = self.expected_ms(work)
            ms = min(ms, _MAX_SURPRISE * expected + _MIN_MS)
            self.square = _MEMORY * self.square + (1.0 - _MEMORY) * (ms - expected) ** 2
        self.trust = 1.0
        self.weight = _MEMORY * self.weight + 1.0
        self.work = _MEMORY * self.work + work
        self.ms = _MEMORY * self.ms + ms
        self.work_work = _MEMORY * self.work_work + work * work
        self.work_ms = _MEMORY * self.work_ms + work * ms
        return ms


class Costs:
    """Costs of steps by name, for any number of threads. A step's work is in units of its own, such as pixels."""

    def __init__(self) -> None:
        self._models: dict[str, _CostModel] = {}
        self._ran_ms = self._waited_ms = 0.0  # running sums over all steps
        self._preemption_ms = 0.0
        self._lock = threading.Lock()  # a model's sums belong together

    def learn(self, step: str, work: float, ms: float, waited_ms: float = 0.0) -> None:
        """Note that a step with this much work took so long, ``waited_ms`` of it waiting for a processor."""
        with self._lock:
            ran_ms, known = max(_MIN_MS, ms - waited_ms), self._models.setdefault(step, _CostModel())
            if known.has_compiled(work, ran_ms):
                known = self._models[step] = _CostModel()
                self._ran_ms = self._waited_ms = 0.0  # nearly all of that run
            self._note_wait(known.learn(work, ran_ms), waited_ms)

    def note_abandoned(self, step: str, work: float, ms: float, waited_ms: float = 0.0) -> None:
        """Note that a step was abandoned after so many milliseconds: it costs more than these."""
        with self._lock:
            ran_ms, known = max(_MIN_MS, ms - waited_ms), self._models.setdefault(step, _CostModel())
            known.trust = 1.0
            expected_ms = known.expected_ms(work) if known.weight > 0.0 else 0.0
            known.learn(work, max(_ABANDONED * ran_ms, expected_ms))
            self._note_wait(ran_ms, waited_ms)

    def note_refusal(self, step: str, *, has_fix: bool = False) -> None:
        """Note that a step was refused for its cost: one that never runs is never seen to have become cheap.

        Its cost decays until it is tried once; if it was not cheaper, that is undone.

        Args:
            step: its name.
            has_fix: there is a fix, which a try may lose: the cost decays slowly.
        """
        with self._lock:
            known = self._models.get(step)
            if known is not None:
                known.square *= (_DEVIATION_DECAY_BESIDE_FIX if has_fix else _DEVIATION_DECAY) ** 2
                known.trust *= _COST_DECAY_BESIDE_FIX if has_fix else _COST_DECAY

    def note_idle(self) -> None:
        """Note that no step ran: none has shown whether it would still have waited."""
        with self._lock:
            self._waited_ms *= _IDLE_DECAY

    def begin_frame(self) -> None:
        """Note that a frame begins."""
        with self._lock:
            self._preemption_ms *= _PREEMPTION_DECAY

    def note_preemption(self, ms: float) -> None:
        """Note that a processor was taken away for so long."""
        with self._lock:
            self._preemption_ms = max(self._preemption_ms, ms)

    def upper_bound_ms(self, step: str, work: float) -> float:
        """Expected time and three deviations of a step, with the waiting that goes with it; 0 if it never ran."""
        with self._lock:
            model = self._models.get(step)
            if model is None:
                return 0.0
            ran_ms = model.trust * model.expected_ms(work) + _SIGMAS * math.sqrt(model.square)
            return ran_ms + self._waited_ms * min(ran_ms / self._ran_ms, _MOST_WAITING)

    @property
    def preemption_ms(self) -> float:
        """The longest preemption of late."""
        with self._lock:
            return self._preemption_ms

    def _note_wait(self, ran_ms: float, waited_ms: float) -> None:
        """Learn the share of waiting."""
        self._ran_ms = _MEMORY * self._ran_ms + ran_ms
        self._waited_ms = _MEMORY * self._waited_ms + waited_ms
