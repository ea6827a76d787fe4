"""Results published by others on the data sets, for comparison. None of them was reproduced here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PublishedResult:
    """One published result.

    Attributes:
        what: method, and part of the data set.
        frames: number of frames that were tried.
        answered: number of frames that were located, or located correctly.
        error: position error of those, as published.
        source: URL of the publication.
    """

    what: str
    frames: str
    answered: str
    error: str
    source: str


COLUMNS = ("published, not run here", "pictures", "answered", "error", "source")
PUBLISHED: dict[str, tuple[PublishedResult, ...]] = {
    "wildnav": (
        PublishedResult(
            "SuperGlue, data set 1",
            "124",
            "77 (62 %)",
            "15.82 m mean absolute",
            "https://github.com/TIERS/wildnav",
        ),
        PublishedResult(
            "SuperGlue, data set 2", "78", "44 (56 %)", "26.58 m mean absolute", "https://github.com/TIERS/wildnav"
        ),
    ),
    "AnyVisLoc": (
        PublishedResult(
            "the authors' baseline", "all", "74.1 % within 5 m", "-", "https://arxiv.org/abs/2503.10692"
        ),
    ),
    "OrthoLoC": (
        PublishedResult(
            "Mast3R on a demonstration sample",
            "1",
            "1 (100 %)",
            "1.36 m, of the pose in the README",
            "https://github.com/deepscenario/OrthoLoC",
        ),
    ),
}
"""Published results by data set, as its reader names it."""


def published_cells(result: PublishedResult) -> tuple[str, ...]:
    """The cells of :data:`COLUMNS`."""
    return result.what, result.frames, result.answered, result.error, result.source
