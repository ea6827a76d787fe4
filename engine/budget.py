"""How long an answer may take: Budget is the wish, Deadline the running clock."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from engine.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Milliseconds that one frame may take from call to answer; infinite where nobody waits.

    Raises:
        OptionError: ``total_ms`` is not above 0.
    """

    total_ms: float = math.inf

    def __post_init__(self) -> None:
        if not self.total_ms > 0:
            raise OptionError(f"total_ms: expected more than 0 ms, got {self.total_ms}")


class Deadline:
    """A budget that started to run. The clock is monotonic; tests hand in their own."""

    __slots__ = ("_budget_ms", "_clock_ns", "_start_ns")

    def __init__(self, budget: Budget, clock_ns: Callable[[], int] = time.perf_counter_ns) -> None:
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        self._budget_ms = budget.total_ms

    @property
    def elapsed_ms(self) -> float:
        """Milliseconds since the start."""
        return (self._clock_ns() - self._start_ns) * 1e-6

    @property
    def remaining_ms(self) -> float:
        """Milliseconds that are left; negative once the deadline is past."""
        return self._budget_ms - self.elapsed_ms

    @property
    def met(self) -> bool:
        """Whether there is time left."""
        return self.remaining_ms >= 0
