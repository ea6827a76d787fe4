"""The folder that keeps files from one run for the next, and how a file is written there."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/scenematch``, else ``~/.cache/scenematch``; it may not exist yet."""
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(folder) / "scenematch"


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A file to write in place of ``path``: it is renamed once it is complete, and otherwise removed.

    Raises:
        OSError: the folder of ``path`` cannot be written.
    """
    with tempfile.TemporaryDirectory(dir=path.parent, suffix=".part") as folder:
        part = Path(folder) / path.name
        yield part
        os.replace(part, path)
