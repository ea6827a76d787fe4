"""What the steps of a frame cost on this machine, learned from their last runs.

A step's cost is the median processor time of its last runs plus some deviations. Multiplied by the machine's load,
it must fit into the time left. No single run decides: a step with fewer than two runs is always started.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from statistics import median_low

RUNS, STAGES, WAITS = 15, 48, 240  # of a step, of all stages (some six frames), and of their waits, that count
DEVIATIONS, SEVERAL = (2.0, 5.0), 10.0  # median absolute deviations, before and beside a fix; medians at most
FADE, FORGOTTEN = 0.99, 4  # per refusal: share of the cost that is left, and stages; so a step is tried again
MAX_WAIT_MS = 20.0  # longest wait for the processor that a fix is protected from


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
