"""Log-odds, log(p / (1 - p)): the currency in which a flight's evidence adds up."""

from __future__ import annotations

import math

from engine.matching.evidence import RELIABILITY, nats_of
from engine.values import Fix

MAX_PROBABILITY = 0.9999
"""Highest probability that one match gives a place: matches were tested on only some ten thousand frames."""
UNSTATED_PROBABILITY = 0.999
"""Of a match that states none, as the paper's: enough for a navigator by default if nothing contradicts it."""

MIN_FRAMES = 3
"""Frames that must show the same before it counts: one or two of them may be wrong."""


def stated_nats(fix: Fix) -> float:
    """Log-odds of a match by itself, if every second frame shows a place in its window."""
    return nats_of(UNSTATED_PROBABILITY if fix.confidence is None else fix.confidence)


CERTAIN = nats_of(MAX_PROBABILITY)
"""Most that one match adds for a place; most that the two motions of an account may differ by."""
RELIABLE = nats_of(RELIABILITY)
"""Of another source's position."""
MISS = math.log(2.0)
"""What a frame without a match of a place speaks against it: every second frame shows nothing that matches."""
