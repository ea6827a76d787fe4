"""A matcher for navigators that answers from a list, over a map that is none."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from engine import Fix, NoFix, Reason


def a_site(**known: Any) -> SimpleNamespace:
    """What a navigator asks of a map: a small one with a surface and without an error, but for what is known."""
    usual = {"is_searchable": True, "has_surface": True, "gsd_m_per_px": 1.0, "georeference_sigma_m": 0.0}
    return SimpleNamespace(**(usual | known))


class ScriptedMatcher:
    """Answers with the next of its fixes, or refuses for the next reason or a low score; keeps what is asked."""

    def __init__(self, *answers: Fix | Reason | None, site: Any = None) -> None:
        self.answers, self.site = list(answers), site or a_site()
        self.frames: list[Any] = []
        self.priors: list[Any] = []
        self.budgets: list[Any] = []

    def locate(self, frame: Any, prior: Any = None, budget: Any = None) -> Fix | NoFix:
        self.frames.append(frame)
        self.priors.append(prior)
        self.budgets.append(budget)
        answer = self.answers.pop(0)
        if isinstance(answer, Fix):
            return replace(answer, timestamp_ns=frame.timestamp_ns)
        return NoFix(reason=answer or Reason.LOW_SCORE, timestamp_ns=frame.timestamp_ns)
