"""Arrays kept in a file for the next time, under a name that stands for what they were made of.

They are never believed unseen: a file that cannot be read, was made of something else, or holds other arrays than
are asked for counts as missing. A folder that cannot be written is no error; everything is then made anew.
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

Arrays = dict[str, NDArray[Any]]
Kinds = Mapping[str, tuple[type[Any], tuple[int, ...]]]
"""Element type of each array, and the shape of one of its N elements."""


def cache_key(settings: object, content: Iterable[NDArray[Any]]) -> str:
    """SHA-256 of settings (by their ``repr``) and of arrays with their shapes and element types."""
    digest = hashlib.sha256(repr(settings).encode())
    for array in content:
        digest.update(f"{array.shape} {array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def cache_path(key: str) -> Path:
    """Where arrays of this key are kept: ``$XDG_CACHE_HOME/scenematch``, else ``~/.cache/scenematch``."""
    folder = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(folder) / "scenematch" / f"{key}.npz"


def load_arrays(key: str, kinds: Kinds) -> Arrays | None:
    """The arrays of a key, each (N, ...) with one N and finite, or None where there are none to be believed."""
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


def save_arrays(key: str, arrays: Arrays) -> None:
    """Keep arrays: written beside their place and moved there in one step. Where that fails, nothing is kept."""
    path = cache_path(key)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(suffix=".npz", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as stream:
                np.savez(stream, allow_pickle=False, key=np.array(key), **arrays)
            os.replace(name, path)
        finally:
            Path(name).unlink(missing_ok=True)
