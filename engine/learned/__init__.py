"""Learned matchers: networks with weights from the user's own files. Nothing is downloaded.

LoFTR alone, or DISK or ALIKED with LightGlue; :func:`load_matcher` recognises a file by the names of its tensors.
A weights file is opened as tensors only: a pickle that would run code is refused.
"""

from typing import TYPE_CHECKING

from engine.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from engine.learned.loading import load_matcher
    from engine.learned.pairs import PairMatcher

__all__ = ["PairMatcher", "load_matcher"]

_NAMES = {"engine.learned.loading": "load_matcher", "engine.learned.pairs": "PairMatcher"}
"""The public names by module. A module is imported when one of its names is used: networks need torch."""

if not TYPE_CHECKING:  # type checkers see the names above and reject others
    __getattr__ = imported_on_use(__name__, _NAMES)
