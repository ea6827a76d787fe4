"""How a frame is matched: one file a method, and the steps that the methods share.

A method is a class with the members of :class:`Method`. A new one is a file and a line in :data:`BY_PROFILE`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch

from engine.errors import OptionError
from engine.methods.auto import Auto
from engine.methods.explanation import Explanation
from engine.methods.ncc import Ncc
from engine.methods.options import MatcherOptions
from engine.methods.paper import PaperNcc, PaperSift
from engine.methods.query import Query
from engine.methods.sift import Sift
from engine.orthomap import OrthoMap
from engine.values import Result, Window


class Method(Protocol):
    """What a method does with one map; of a frame it keeps nothing."""

    def __init__(self, site: OrthoMap, device: torch.device, options: MatcherOptions) -> None: ...

    @property
    def parts(self) -> Mapping[str, Method]:
        """The methods that it is made of, by name; empty for most."""

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""

    def prepare(self) -> None:
        """Prepare what is looked up of the map, before take-off."""

    def warmup(self, query: Query) -> None:
        """Run every variant of every step, so that it is compiled and its cost known.

        A query without a prior runs the search of the whole map.
        """

    def locate(self, query: Query) -> Result:
        """The fix of one frame, or its refusal."""

    def explain(self, query: Query, window: Window) -> Explanation:
        """What the match of a frame in a window looks like, for reports."""


BY_PROFILE: Mapping[str, Mapping[str, type[Method]]] = {
    "engine": {"ncc": Ncc, "sift": Sift, "auto": Auto},
    "paper": {"ncc": PaperNcc, "sift": PaperSift},
}
METHODS = tuple(BY_PROFILE["engine"])


def method_type(name: str, profile: str) -> type[Method]:
    """The class of a method.

    Raises:
        OptionError: there is none of this name, or not in this profile.
    """
    if name not in METHODS:
        raise OptionError(f"method: expected one of {', '.join(METHODS)}, got {name!r}")
    methods = BY_PROFILE[profile]
    if name not in methods:
        raise OptionError(f"method: the {profile}'s profile has {' and '.join(methods)}, got {name!r}")
    return methods[name]
