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
        self._evict(keep=len(keys))
        return found

    def _evict(self, keep: int) -> None:
        """Evict the least recently used entries until their sizes fit the limit, but not the last ``keep``."""
        with self._lock:
            used = sum(self._size(*entry) for entry in self._entries.items())
            for key in list(self._entries)[: len(self._entries) - keep]:
                if used <= self.limit:
                    break
                freed = self._size(key, self._entries[key])
                if freed:
                    used -= freed
                    del self._entries[key]
