"""Learned matchers: networks with weights from the user's own files. Nothing is downloaded.

LoFTR alone, or DISK or ALIKED with LightGlue; :func:`load_matcher` recognises a file by the names of its tensors.
A weights file is opened as tensors only: a pickle that would run code is refused.
"""

from typing import TYPE_CHECKING

from engine.learned.pairs import PairMatcher
from engine.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from engine.learned.loading import load_matcher

__all__ = ["PairMatcher", "load_matcher"]

if not TYPE_CHECKING:  # type checkers see the name above and reject others; networks need torch
    __getattr__ = imported_on_use(__name__, {"engine.learned.loading": "load_matcher"})
