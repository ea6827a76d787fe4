"""A cache that evicts the least recently used entries; safe for any number of threads."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class RecentlyUsed(Generic[K, V]):
    """Entries by key, the most recently used last. The lock guards them, not how they are made."""

    def __init__(self) -> None:
        self._entries: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()
        self.created = 0
        """Entries made so far."""

    def __contains__(self, key: K) -> bool:
        return key in self._entries

    def __iter__(self) -> Iterator[K]:
        """The keys, that of the least recently used entry first."""
        with self._lock:
            return iter(list(self._entries))

    def __setitem__(self, key: K, entry: V) -> None:
        """Add an existing entry, or replace one."""
        with self._lock:
            self._entries[key] = entry
            self._entries.move_to_end(key)

    def values(self) -> list[V]:
        """The entries, the least recently used first."""
        return list(self._entries.values())

    def get(self, key: K, make: Callable[[], V]) -> V:
        """Get an entry, which becomes the most recently used; create it if missing."""
        with self._lock:
            found = self._entries.get(key)
            if found is not None:
                self._entries.move_to_end(key)
                return found
        made = make()
        with self._lock:
            self.created += 1
            self._entries[key] = made
            self._entries.move_to_end(key)
        return made

    def evict(self, size: Callable[[K, V], int], limit: int, keep: int) -> None:
        """Evict the least recently used entries until their sizes fit a limit, but not the last ``keep``.

        Entries of size 0 stay.
        """
        with self._lock:
            used = sum(size(*entry) for entry in self._entries.items())
            for key in list(self._entries)[: len(self._entries) - keep]:
                if used <= limit:
                    break
                freed = size(key, self._entries[key])
                if freed:
                    used -= freed
                    del self._entries[key]
