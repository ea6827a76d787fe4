"""Who watches a run: where the live view goes, and the view while the run goes on."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from engine.errors import BackendError, OptionError
from engine.matcher import SceneMatcher
from engine.navigator import Navigator
from engine.values import Prior

if TYPE_CHECKING:  # rerun is optional
    from engine.report.live_view import LiveView, Watcher

_PATIENCE_S = 2.0


@dataclass(frozen=True, slots=True)
class Watching:
    """Where the live view goes, as the command line has it; nowhere without either.

    Attributes:
        recording: a file that is made.
        address: HOST:PORT on which a viewer of rerun listens.
    """

    recording: Path | None = None
    address: str | None = None

    def __bool__(self) -> bool:
        return self.recording is not None or self.address is not None

    def check(self, *, force: bool = False) -> None:
        """Refuse what cannot be done, before any work is done for it.

        Raises:
            OptionError: the recording is there and ``force`` was not given, has another ending, or the address is
                none.
            BackendError: rerun is not installed, or no viewer listens.
        """
        if self and find_spec("rerun") is None:
            raise BackendError("--rerun: expected rerun to be installed, the extra [live]: pip install rerun-sdk")
        file = self.recording
        if file is not None and file.suffix != ".rrd":
            raise OptionError(f"--rerun: expected a file that ends in .rrd, got {file}")
        if file is not None and file.exists() and not force:
            raise OptionError(f"--rerun: {file} exists; choose another file")
        if self.address is not None:
            _check_viewer(self.address)


def _check_viewer(address: str) -> None:
    """Refuse an address on which nobody listens: rerun itself would wait for long and say nothing."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise OptionError(f"--rerun-connect: expected HOST:PORT, got {address!r}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE_S).close()
    except OSError:
        start = "start one with: rerun --bind 127.0.0.1"
        raise BackendError(f"--rerun-connect: no viewer listens at {address}; {start}") from None


@contextmanager
def watched(matcher: SceneMatcher, watching: Watching) -> Iterator[LiveView | None]:
    """The live view of a run, closed with it; None where nobody watches.

    Raises:
        BackendError: the recording cannot be written.
    """
    if not watching:
        yield None
        return
    from engine.report.live_view import open_live_view

    view = open_live_view(matcher, watching.recording, watching.address)
    try:
        yield view
    finally:
        view.close()


@contextmanager
def watched_beside(
    matcher: SceneMatcher, watching: Watching
) -> Iterator[tuple[Callable[[Prior | None], Navigator], Watcher | None]]:
    """The same for a bridge, whose answers do not wait for the view: what makes its navigators, and the view."""
    if not watching:
        yield partial(Navigator, matcher), None
        return
    from engine.report.live_view import Watcher, open_live_view

    watcher = Watcher(open_live_view(matcher, watching.recording, watching.address))
    try:
        yield lambda prior: watcher.follow(Navigator(matcher, prior)), watcher
    finally:
        watcher.close()
