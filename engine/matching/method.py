"""What every method is: one map that frames are matched with; of a frame it keeps nothing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from engine.matching.explanation import Explanation
from engine.matching.query import Query
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.values import Result, Window


class Method(ABC):
    """A method. One without caches, costs or parts has only to locate and to explain.

    Args:
        site: the map.
        device: where tensors live.
        options: settings of all methods.
    """

    def __init__(self, site: OrthoMap, device: Device, options: MatcherOptions) -> None:  # noqa: B027
        """Keep nothing; a method that prepares something of the map has a constructor of its own."""

    @property
    def parts(self) -> Mapping[str, Method]:
        """The methods that it is made of, by name."""
        return {}

    warmup_rounds: ClassVar[int] = 3
    """How often each frame of the warm-up is matched to learn what the steps cost."""

    loops: ClassVar[tuple[str, ...]] = ()
    """Modules of :mod:`engine.kernels` whose compiled loops it calls."""

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {}

    def prepare(self) -> None:  # noqa: B027
        """Prepare what is looked up of the map, before take-off."""

    def warmup(self, query: Query) -> None:  # noqa: B027
        """Run every variant of every step of a frame with a prior, so that it is compiled and its cost known."""

    def warmup_search(self, query: Query) -> None:  # noqa: B027
        """Run a search once; it takes long, and few frames need one.

        Args:
            query: without a prior, of the whole map; with one, of headings and heights where the method has that.
        """

    @abstractmethod
    def locate(self, query: Query) -> Result:
        """The fix of one frame, or its refusal."""

    @abstractmethod
    def explain(self, query: Query, window: Window) -> Explanation:
        """What the match of a frame in a window looks like, for reports."""
