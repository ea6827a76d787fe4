"""Figures that others published of data sets, to stand beside ours. None of them was run here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Published:
    """One published result.

    Attributes:
        what: the method, on which part of the data set.
        frames: how many pictures it was tried on.
        answered: how many of them it placed, or in how many it was right.
        error: of those, as published.
        source: where it was published.
    """

    what: str
    frames: str
    answered: str
    error: str
    source: str


COLUMNS = ("published, not run here", "pictures", "answered", "error", "source")
PUBLISHED: dict[str, tuple[Published, ...]] = {
    "wildnav": (
        Published(
            "SuperGlue, data set 1",
            "124",
            "77 (62 %)",
            "15.82 m mean absolute",
            "https://github.com/TIERS/wildnav",
        ),
        Published(
            "SuperGlue, data set 2", "78", "44 (56 %)", "26.58 m mean absolute", "https://github.com/TIERS/wildnav"
        ),
    ),
    "AnyVisLoc": (
        Published("the authors' baseline", "all", "74.1 % within 5 m", "-", "https://arxiv.org/abs/2503.10692"),
    ),
}
"""By data set, as its reader names it. What has no line here has no such figure, or none that was found."""


def published_cells(one: Published) -> tuple[str, ...]:
    """The figures of :data:`COLUMNS`."""
    return one.what, one.frames, one.answered, one.error, one.source
