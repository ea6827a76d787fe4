"""The live view of a run: its target, and the view while the run lasts."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from engine.errors import BackendError, OptionError, require
from engine.matching.matcher import SceneMatcher
from engine.navigation.navigator import Navigator
from engine.options import NavigatorOptions
from engine.values import Prior
from scenematch.runs.output import StrPath

if TYPE_CHECKING:  # rerun is optional
    from scenematch.report.live_view import LiveView, Watcher

_CONNECT_TIMEOUT_S = 2.0


@dataclass(frozen=True, slots=True)
class LiveViewTarget:
    """Where to send the live view; nowhere if neither is given.

    Attributes:
        recording: file to create.
        viewer: HOST:PORT of a rerun viewer.
    """

    recording: StrPath | None = None
    viewer: str | None = None

    def __bool__(self) -> bool:
        return self.recording is not None or self.viewer is not None

    def check(self, *, force: bool = False) -> None:
        """Refuse a target that cannot be used, before any work is done.

        Raises:
            OptionError: the recording exists and ``force`` was not given, has another suffix, or the address is
                invalid.
            MissingExtraError: rerun is not installed.
            BackendError: no viewer listens.
        """
        if self:
            require("rerun", "live", "rerun-sdk")
        file = None if self.recording is None else Path(self.recording)
        if file is not None and file.suffix != ".rrd":
            raise OptionError(f"recording: expected a file that ends in .rrd, got {file}")
        if file is not None and file.exists() and not force:
            raise OptionError(f"recording: {file} exists; choose another file")
        if self.viewer is not None:
            _check_viewer(self.viewer)

    def open(self, matcher: SceneMatcher) -> LiveView:
        """The view.

        Raises:
            BackendError: the recording cannot be written.
        """
        from scenematch.report.live_view import open_live_view

        return open_live_view(matcher, None if self.recording is None else Path(self.recording), self.viewer)


NO_LIVE_VIEW = LiveViewTarget()
"""Nothing is shown."""


def _check_viewer(address: str) -> None:
    """Refuse an address without a viewer: rerun itself would wait long and silently."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise OptionError(f"viewer: expected HOST:PORT, got {address!r}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_TIMEOUT_S).close()
    except OSError:
        start = "start one with: rerun --bind 127.0.0.1"
        raise BackendError(f"viewer: no viewer listens at {address}; {start}") from None


def open_view(matcher: SceneMatcher, target: LiveViewTarget) -> AbstractContextManager[LiveView | None]:
    """The live view of a run, closed when the context ends; None without a target.

    Raises:
        BackendError: the recording cannot be written.
    """
    return closing(target.open(matcher)) if target else nullcontext()


@contextmanager
def open_bridge_view(
    matcher: SceneMatcher, target: LiveViewTarget, options: NavigatorOptions | None = None
) -> Iterator[tuple[Callable[[Prior | None], Navigator], Watcher | None]]:
    """The live view of a bridge, which never delays answers: the factory of its navigators, and the view."""
    make = partial(Navigator, matcher, options=options)
    if not target:
        yield make, None
        return
    from scenematch.report.live_view import Watcher

    with closing(Watcher(target.open(matcher))) as watcher:
        yield lambda prior: watcher.follow(make(prior)), watcher
