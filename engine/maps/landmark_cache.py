"""Cache of named arrays on disk, one file per key; the key is a hash of the arrays' inputs.

Files are validated: one that cannot be read, has another key, or holds other arrays than requested counts as
missing. A folder that cannot be written is not an error; the arrays are then computed again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.runtime.cache_folder import cache_folder

NamedArrays = dict[str, NDArray[Any]]
Kinds = Mapping[str, tuple[type[Any], tuple[int, ...]]]
"""Element type of each array, and the shape of one of its N elements."""


def cache_key(settings: object, content: Iterable[NDArray[Any]]) -> str:
    """SHA-256 of settings and arrays.

    Args:
        settings: hashed by their ``repr``.
        content: arrays of any shape, hashed with their shapes and element types.

    Returns:
        str: 64 hexadecimal digits.
    """
    digest = hashlib.sha256(repr(settings).encode())
    for array in content:
        digest.update(f"{array.shape} {array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def cache_path(key: str) -> Path:
    """The cache file of a key, in ``$XDG_CACHE_HOME/scenematch``, else ``~/.cache/scenematch``."""
    return cache_folder() / f"{key}.npz"


def load_arrays(key: str, kinds: Kinds) -> NamedArrays | None:
    """The cached arrays of a key.

    Args:
        key: from :func:`cache_key`.
        kinds: expected names, element types and shapes.

    Returns:
        Arrays (N, ...) with a common N and finite values; None if the file is missing or not valid.
    """
    try:
        with cache_path(key).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            if str(file["key"]) != key:
                return None
            arrays = {name: file[name] for name in kinds}
    except (OSError, EOFError, KeyError, ValueError, TypeError, MemoryError, zipfile.BadZipFile, zlib.error):
        return None
    count = len(arrays[next(iter(kinds))]) if all(array.ndim for array in arrays.values()) else -1
    for name, (dtype, shape) in kinds.items():
        array = arrays[name]
        if array.dtype != dtype or array.shape != (count, *shape) or not np.isfinite(array).all():
            return None
    return arrays


def save_arrays(key: str, arrays: NamedArrays) -> None:
    """Cache arrays; the file is written under a temporary name and renamed. A failure to write is ignored.

    Args:
        key: from :func:`cache_key`.
        arrays: (N, ...) each, by name.
    """
    path = cache_path(key)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            written = Path(folder) / path.name
            np.savez(written, allow_pickle=False, key=np.array(key), **arrays)
            os.replace(written, path)
