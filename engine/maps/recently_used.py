"""A cache that evicts the least recently used entries; safe for any number of threads."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

V = TypeVar("V")
Key = tuple[Any, ...]


class RecentlyUsed(Generic[V]):
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
        self._make, self._size, self.limit = make, size, limit
        self._entries: OrderedDict[Key, V] = OrderedDict()
        self._lock = threading.Lock()
        self.created = 0

    def __contains__(self, key: Key) -> bool:
        return key in self._entries

    def __iter__(self) -> Iterator[Key]:
        """The keys, that of the least recently used entry first."""
        with self._lock:
            return iter(list(self._entries))

    def __setitem__(self, key: Key, entry: V) -> None:
        """Add an existing entry, or replace one."""
        with self._lock:
            self._entries[key] = entry
            self._entries.move_to_end(key)

    def values(self) -> list[V]:
        """The entries, the least recently used first."""
        return list(self._entries.values())

    def get(self, *keys: Key) -> list[V]:
        """Get entries, which become the most recently used; make those that are missing, and evict others."""
        found = []
        for key in keys:
            entry = self._entries.get(key)
            if entry is None:
                entry = self._make(*key)
                with self._lock:
                    self.created += 1
            self[key] = entry
            found.append(entry)
        with self._lock:
            sizes = {key: self._size(key, entry) for key, entry in self._entries.items()}
            used = sum(sizes.values())
            for key, size in list(sizes.items())[: len(sizes) - len(keys)]:  # not what was just asked for
                if used > self.limit and size:
                    used -= size
                    del self._entries[key]
        return found
