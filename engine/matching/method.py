"""The interface of all methods: match frames with one map; keep no state between frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from engine.matching.candidates import Candidate
from engine.matching.for_reports import Explanation
from engine.matching.query import Query
from engine.options import MatcherOptions
from engine.orthomap import OrthoMap
from engine.runtime.device import Device
from engine.values import Result, Window


class Method(ABC):
    """A method. One without caches, costs or parts only needs ``name``, ``locate`` and ``explain``.

    Args:
        site: the map.
        device: where tensors live.
        options: settings of all methods.
    """

    def __init__(self, site: OrthoMap, device: Device, options: MatcherOptions) -> None:  # noqa: B027
        """Store nothing; a method that prepares the map overrides this."""

    name: ClassVar[str]
    """As its fixes and refusals call it."""

    @property
    def parts(self) -> Mapping[str, Method]:
        """The methods that it consists of, by name."""
        return {}

    warmup_rounds: ClassVar[int] = 3
    """How often each warm-up frame is matched to measure step costs."""

    loops: ClassVar[tuple[str, ...]] = ()
    """Modules of :mod:`engine.kernels` whose compiled loops it calls."""

    @property
    def cache_counters(self) -> dict[str, int]:
        """How many entries of each cache were created so far."""
        return {}

    def prepare(self) -> None:  # noqa: B027
        """Prepare the map's look-up data, before take-off."""

    def warmup(self, query: Query) -> None:  # noqa: B027
        """Run every variant of every step of a frame with a prior, so that it is compiled and its cost known."""

    def warmup_search(self, query: Query) -> None:  # noqa: B027
        """Run a search once; it is slow, and few frames need one.

        Args:
            query: without a prior, searches the whole map; with one, headings and heights if the method can.
        """

    @abstractmethod
    def locate(self, query: Query) -> Candidate | Result:
        """What one frame shows: a candidate, judged by its evidence, or a fix or refusal that is final."""

    @abstractmethod
    def explain(self, query: Query, window: Window) -> Explanation:
        """The surface or the matches of a frame in a window, for reports."""
