"""Cache of named arrays on disk, one file per key; the key is a hash of the arrays' inputs.

A file that cannot be read counts as missing: the archive has a checksum of each array. A folder that cannot be
written is not an error; the arrays are then computed again.
"""

from __future__ import annotations

import contextlib
import hashlib
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.runtime.cache_folder import cache_folder, replaced

NamedArrays = dict[str, NDArray[Any]]


def cache_path(settings: object, content: Iterable[NDArray[Any]]) -> Path:
    """The cache file for settings and arrays; its name is their SHA-256.

    Args:
        settings: hashed by their ``repr``.
        content: arrays of any shape, hashed with their shapes and element types.

    Returns:
        In ``$XDG_CACHE_HOME/scenematch``, else ``~/.cache/scenematch``.
    """
    digest = hashlib.sha256(repr(settings).encode())
    for array in content:
        digest.update(f"{array.shape} {array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return cache_folder() / f"{digest.hexdigest()}.npz"


def load_arrays(path: Path) -> NamedArrays | None:
    """The arrays of a cache file.

    Args:
        path: from :func:`cache_path`.

    Returns:
        As they were saved; None if the file is missing or damaged.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return dict(file)
    except (OSError, EOFError, KeyError, ValueError, TypeError, MemoryError, zipfile.BadZipFile, zlib.error):
        return None


def save_arrays(path: Path, arrays: NamedArrays) -> None:
    """Cache arrays. A failure to write is ignored.

    Args:
        path: from :func:`cache_path`.
        arrays: of any shape, by name.
    """
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as part:
            np.savez(part, allow_pickle=False, **arrays)
