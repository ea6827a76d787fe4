"""The ladder: the one loop that makes one effort on a frame after another, cheap ones first, while time allows.

Efforts give candidates. The last one's evidence decides whether its fix is handed out.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeAlias, TypeGuard

from engine.matching import refusals
from engine.matching.candidates import Candidate
from engine.matching.query import Query
from engine.runtime.scheduler import OutOfTime, Scheduler
from engine.values import NoFix, Reason, Result

SHARES = (1.0, 0.5)
"""Of the scale at which features are matched, a level of the map apart; the smaller if time is short."""
Works = Mapping[Hashable, float]
"""The work of each step that may be taken, as the scheduler knows it."""
Answer: TypeAlias = Candidate | NoFix
"""What is known of a frame's place, accepted or not, or why nothing is."""


@dataclass(frozen=True, slots=True)
class Rung:
    """One way to look at a frame, or to improve the answer so far.

    Attributes:
        offers: the variants of its step, the best first, that may change the answer so far (None if there is none
            yet); empty if it cannot.
        run: gets the answer so far and a variant, and gives the new answer; None leaves the old one.
    """

    offers: Callable[[Answer | None], Works]
    run: Callable[[Answer | None, Hashable], Answer | None]


def climb(query: Query, method: str, rungs: Sequence[Rung], answer: Answer | None = None) -> Answer:
    """The answer after every rung that can change it and that time allows.

    With a fix, work ends before a deadline that would make it late; a refusal for lack of time replaces no fix.
    Any other answer of a later rung replaces an earlier one.

    Args:
        query: the frame.
        method: named in the refusal of a frame for which there was no time.
        rungs: in their order, cheap ones first.
        answer: to go on from; None begins.
    """
    for rung in rungs:
        if not query.scheduler.deadline.met:
            break  # no step is refused for its cost
        works, has_fix = rung.offers(answer), is_accepted(answer, query)
        with query.scheduler.with_fix(has_fix), suppress(OutOfTime):
            step = _affordable(query.scheduler, works)
            if step is not None:
                with query.scheduler.costed(step, works[step]):
                    looked = rung.run(answer, step)
                if looked is not None and not (has_fix and is_late(looked)):
                    answer = looked
    return answer or refusals.late(query, method)


def settled(query: Query, answer: Candidate | Result) -> Result:
    """The fix of an accepted candidate, else the refusal that says why it is not accepted."""
    if not isinstance(answer, Candidate):
        return answer
    if answer.suffices(query.risk):
        return answer.fix
    return answer.fix.refused(*refusals.of_candidate(answer, query.risk))


def is_accepted(answer: Answer | None, query: Query) -> TypeGuard[Candidate]:
    """Whether the answer is a candidate whose fix may be handed out."""
    return isinstance(answer, Candidate) and answer.suffices(query.risk)


def rehearse(query: Query, rung: Rung, answer: Answer | None) -> list[Answer | None]:
    """What each variant of a rung makes of an answer; the scheduler learns their costs."""
    answers = []
    for step, work in rung.offers(answer).items():
        with query.scheduler.costed(step, work):
            answers.append(rung.run(answer, step))
    return answers


def is_late(answer: Answer | Result | None) -> bool:
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
