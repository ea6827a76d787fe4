"""Learned matchers: networks with weights from the user's own files. Nothing is downloaded.

LoFTR alone, or DISK, ALIKED or SuperPoint with LightGlue; :func:`load_matcher` recognises by the names of its
tensors what a file holds. A weights file is opened as tensors only: a pickle that would run code is refused.
"""

from engine.learned.keypoints import Extractor, Keypoints
from engine.learned.loading import load_disk_lightglue, load_loftr, load_matcher
from engine.learned.matchers import KeypointMatcher, Loftr, PairMatcher

__all__ = [
    "Extractor",
    "KeypointMatcher",
    "Keypoints",
    "Loftr",
    "PairMatcher",
    "load_disk_lightglue",
    "load_loftr",
    "load_matcher",
]
