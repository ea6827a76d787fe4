"""The ladder: the one loop that makes one effort on a frame after another, cheap ones first, while time allows."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeGuard

from engine.matching.query import Query
from engine.runtime.scheduler import OutOfTime, Scheduler
from engine.values import Fix, NoFix, Reason, Result

SHARES = (1.0, 0.5)
"""Of the scale at which features are matched, a level of the map apart; the smaller if time is short."""
Works = Mapping[Hashable, float]
"""Steps, as the scheduler knows them, by their work."""


@dataclass(frozen=True, slots=True)
class Rung:
    """One way to look at a frame, or to improve the answer so far.

    Attributes:
        offers: the variants of its step, the best first, that may change the answer so far (None if there is none
            yet); empty if it cannot.
        look: gets the answer so far and a variant, and gives the new answer; None leaves the old one.
    """

    offers: Callable[[Result | None], Works]
    look: Callable[[Result | None, Hashable], Result | None]


def climb(query: Query, method: str, rungs: Sequence[Rung]) -> Result:
    """The answer after every rung that can change it and that time allows.

    With a fix, work ends before a deadline that would make it late; no fix is lost to a lack of time.

    Args:
        query: the frame.
        method: named in the refusal of a frame for which there was no time.
        rungs: in their order, cheap ones first.
    """
    answer: Result | None = None
    for rung in rungs:
        if not query.scheduler.deadline.met:
            break  # no step is refused for its cost
        works = rung.offers(answer)
        with query.scheduler.with_fix(isinstance(answer, Fix)), suppress(OutOfTime):
            step = _affordable(query.scheduler, works)
            if step is not None:
                with query.scheduler.costed(step, works[step]):
                    looked = rung.look(answer, step)
                if looked is not None and not (isinstance(answer, Fix) and is_late(looked)):
                    answer = looked
    return answer or query.refuse_late(method)


def rehearse(query: Query, rung: Rung, answer: Result | None) -> list[Result | None]:
    """What each variant of a rung makes of an answer; the scheduler learns their costs."""
    answers = []
    for step, work in rung.offers(answer).items():
        with query.scheduler.costed(step, work):
            answers.append(rung.look(answer, step))
    return answers


def is_coarse(answer: Result | None) -> TypeGuard[Fix]:
    """Whether the answer is a fix at reduced resolution."""
    return isinstance(answer, Fix) and answer.stage == "coarse"


def is_late(answer: Result | None) -> bool:
    """Whether the answer is a refusal for lack of time."""
    return isinstance(answer, NoFix) and answer.reason is Reason.LATE


def _affordable(scheduler: Scheduler, works: Works) -> Hashable | None:
    """The first variant that time allows, else the last one unless that is hopeless; then it counts as refused."""
    for step, work in works.items():
        if scheduler.can_afford({step: work}):
            return step
    if not works:
        return None
    if not scheduler.is_hopeless(step, work):
        return step
    scheduler.note_refusal(step)
    return None
