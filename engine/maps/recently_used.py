"""A cache that evicts the least recently used entries; safe for any number of threads."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeVar

V = TypeVar("V")
Key = tuple[Any, ...]


class RecentlyUsed(OrderedDict[Key, V]):
    """Entries by key, the most recently used last. The lock guards them, not how they are made.

    Args:
        make: an entry from the values of its key.
        size: of an entry; one of size 0 is not evicted.
        limit: of all sizes together.

    Attributes:
        created: entries made so far.
        limit: may be raised.
    """

    def __init__(self, make: Callable[..., V], size: Callable[[Key, V], int], limit: float) -> None:
        super().__init__()
        self._make, self._size, self.limit = make, size, limit
        self._lock = threading.Lock()
        self.created = 0

    def __setitem__(self, key: Key, entry: V) -> None:
        """Add an existing entry, or replace one; it becomes the most recently used."""
        with self._lock:
            super().__setitem__(key, entry)
            self.move_to_end(key)

    def obtain(self, *keys: Key) -> list[V]:
        """Get entries, which become the most recently used; make those that are missing, and evict others."""
        found = []
        for key in keys:
            entry = self.get(key)
            if entry is None:
                entry = self._make(*key)
                with self._lock:
                    self.created += 1
            self[key] = entry
            found.append(entry)
        with self._lock:
            sizes = {key: self._size(key, entry) for key, entry in self.items()}
            used = sum(sizes.values())
            for key, size in list(sizes.items())[: len(sizes) - len(keys)]:  # not what was just asked for
                if used > self.limit and size:
                    used -= size
                    del self[key]
        return found
