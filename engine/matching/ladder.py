"""The ladder: the one loop that makes one effort on a frame after another, cheap ones first, while time allows.

Efforts give candidates, of one method or of two. The last one's evidence decides whether its fix is handed out.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeAlias, TypeGuard

from engine.matching import refusals
from engine.matching.candidates import Candidate
from engine.matching.evidence import is_beyond_doubt
from engine.matching.query import Query
from engine.runtime.scheduler import OutOfTime, Scheduler
from engine.values import Look, NoFix, Reason, Result

SHARES = (1.0, 0.5)
"""Of the scale at which features are matched, a level of the map apart; the smaller if time is short."""
Works = Mapping[Hashable, float]
"""The work of each step that may be taken, as the scheduler knows it."""
Answer: TypeAlias = Candidate | NoFix
"""What is known of a frame's place, accepted or not, or why nothing is."""


def is_accepted(answer: Answer | None, query: Query) -> TypeGuard[Candidate]:
    """Whether the answer is a candidate whose fix may be handed out."""
    return isinstance(answer, Candidate) and answer.suffices(query.risk)


def is_settled(answer: Answer, query: Query) -> bool:
    """Whether the picture confirmed the whole pose, and its place is beyond doubt."""
    is_refined = isinstance(answer, Candidate) and answer.fix.stage == "refined"
    return is_refined and is_accepted(answer, query) and is_beyond_doubt(answer.evidence.nats, query.risk)


@dataclass(frozen=True, slots=True)
class Rung:
    """One way to look at a frame, or to improve the answer so far.

    Attributes:
        method: whose answer it gives or improves.
        name: of the look, for :attr:`.Fix.looks`.
        offers: the variants of its step, the best first, that may change the method's answer so far (None if there
            is none yet); empty if it cannot.
        run: gets the method's answer so far and a variant, and gives the new answer; None leaves the old one.
        is_needless: whether another method's answer leaves nothing to look for.
    """

    method: str
    name: str
    offers: Callable[[Answer | None], Works]
    run: Callable[[Answer | None, Hashable], Answer | None]
    is_needless: Callable[[Answer, Query], bool] = is_settled


def climb(query: Query, rungs: Sequence[Rung]) -> dict[str, Answer]:
    """Each method's answer after every rung that can change it and that time allows.

    With a fix, work ends before a deadline that would make it late; a refusal for lack of time replaces no fix.
    Any other answer of a later rung replaces an earlier one of its method.

    Args:
        query: the frame.
        rungs: in their order, cheap ones first; the last one's method is named if there was no time for any.
    """
    answers: dict[str, Answer] = {}
    for rung in rungs:
        own, others = answers.get(rung.method), [each for name, each in answers.items() if name != rung.method]
        if not query.scheduler.deadline.met:
            break  # no step is refused for its cost
        if any(rung.is_needless(each, query) for each in others):
            continue
        has_fix = any(is_accepted(each, query) for each in answers.values())
        with query.scheduler.with_fix(has_fix), suppress(OutOfTime):
            works = rung.offers(own)
            step = _affordable(query.scheduler, works)
            if step is not None:
                with query.scheduler.costed(step, works[step]):
                    looked = rung.run(own, step)
                nats = looked.evidence.nats if isinstance(looked, Candidate) else None
                query.looks.append(Look(rung.method, rung.name, nats))
                if looked is not None and not (is_accepted(own, query) and is_late(looked)):
                    answers[rung.method] = looked
    return answers or {rungs[-1].method: refusals.late(query, rungs[-1].method)}


def settled(query: Query, answer: Candidate | Result) -> Result:
    """The fix of an accepted candidate, else the refusal that says why it is not accepted."""
    if not isinstance(answer, Candidate):
        return answer
    if answer.suffices(query.risk):
        return answer.fix
    return answer.fix.refused(*refusals.of_candidate(answer, query.risk))


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
