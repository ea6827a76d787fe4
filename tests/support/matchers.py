"""A matcher for navigators that answers from a list, over a map that is none, and flights of frames by it."""

import itertools
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from engine import Fix, Frame, Navigator, NavigatorOptions, NoFix, Prior, Reason

_NUMBERS = itertools.count()


def at(
    seconds: float | None,
    velocity: tuple[float | None, float | None] = (None, None),
    height_agl_m: float | None = 100.0,
) -> Frame:
    """A frame with a picture like no other: one that repeats is refused."""
    image = np.full((8, 8), next(_NUMBERS) % 256, np.uint8)
    stamp = None if seconds is None else round(seconds * 1_000_000_000)
    east, north = velocity
    return Frame(image, stamp, height_agl_m, 0.0, east_velocity_mps=east, north_velocity_mps=north)


def a_site(**known: Any) -> SimpleNamespace:
    """What a navigator asks of a map: a small, exact one with a surface, but for what is known."""
    exact = {"georeference_sigma_m": 1e-9, "slope_sigma_deg": None}
    usual = {"is_searchable": True, "has_surface": True, "gsd_m_per_px": 1.0}
    return SimpleNamespace(**(usual | exact | known))


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


def flown(
    matcher: ScriptedMatcher, start: Prior | None = None, *, every_s: float = 1.0, seconds: Any = None,
    velocity: Any = (None, None), given: list[Prior | None] | None = None, options: NavigatorOptions | None = None,
) -> SimpleNamespace:  # fmt: skip
    """A frame for each of a matcher's answers.

    Args:
        matcher: which keeps what it was asked.
        start: where the flight begins.
        every_s: between frames.
        seconds: of each frame, in place of an interval.
        velocity: of all frames, or a list of each one's.
        given: priors of the frames.
        options: of the navigator.

    Returns:
        SimpleNamespace: ``results`` and their ``ends``, the indices of those ``fixed``, what the navigator said
        after each (``states``, ``healthy``, ``ages_s``), ``priors`` that it asked, and itself.
    """
    navigator = Navigator(matcher, start, options=options)
    run = SimpleNamespace(results=[], states=[], healthy=[], ages_s=[])
    for k, at_s in enumerate(seconds or [every_s * k for k in range(len(matcher.answers))]):
        frame = at(at_s, velocity[k] if isinstance(velocity, list) else velocity)
        run.results.append(navigator.update(frame, given and given[k]))
        run.states.append(navigator.state.name)
        run.healthy.append(navigator.healthy)
        run.ages_s.append(navigator.anchor_age_s)
    run.ends = ["fix" if isinstance(result, Fix) else result.reason.value for result in run.results]
    run.fixed = [k for k, end in enumerate(run.ends) if end == "fix"]
    run.priors, run.navigator = matcher.priors, navigator
    return run
