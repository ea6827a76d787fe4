"""Time budgets: Budget is the limit, Deadline the running clock."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from engine.values import check


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Milliseconds that one frame may take, from call to answer; unlimited by default.

    Attributes:
        total_ms: of a frame with a prior.
        search_ms: of a frame that searches the whole map, because it has no prior; None is ``total_ms``.

    Raises:
        OptionError: one is not above 0.
    """

    total_ms: float = math.inf
    search_ms: float | None = None

    def __post_init__(self) -> None:
        for name in ("total_ms", "search_ms"):
            check(self, name, "more than 0 ms", lambda ms: ms is None or ms > 0)

    def after(self, elapsed_ms: float) -> Budget:
        """The budget left after so many milliseconds; once spent, too little for any answer."""
        spent_ms = math.ulp(0.0)
        search_ms = None if self.search_ms is None else max(self.search_ms - elapsed_ms, spent_ms)
        return Budget(total_ms=max(self.total_ms - elapsed_ms, spent_ms), search_ms=search_ms)


class Deadline:
    """A budget that is running.

    Args:
        budget: limits.
        clock_ns: monotonic nanoseconds; tests pass their own.
        searches: whether the frame searches the whole map.
    """

    __slots__ = ("_budget_ms", "_clock_ns", "_start_ns")

    def __init__(
        self, budget: Budget, clock_ns: Callable[[], int] = time.perf_counter_ns, *, searches: bool = False
    ) -> None:
        self._clock_ns = clock_ns
        self._start_ns = clock_ns()
        search_ms = budget.total_ms if budget.search_ms is None else budget.search_ms
        self._budget_ms = search_ms if searches else budget.total_ms

    @property
    def elapsed_ms(self) -> float:
        """Milliseconds since the start."""
        return (self._clock_ns() - self._start_ns) * 1e-6

    @property
    def remaining_ms(self) -> float:
        """Milliseconds until the deadline; negative once it has passed."""
        return self._budget_ms - self.elapsed_ms

    @property
    def met(self) -> bool:
        """Whether there is time left."""
        return self.remaining_ms >= 0
