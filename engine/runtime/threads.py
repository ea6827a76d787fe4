"""The number of threads of OpenCV, NumPy's BLAS, torch and the engine's own loops, and work divided among them.

torch is configured now if loaded, else when it is loaded (:mod:`engine.runtime.tensors`).
"""

from __future__ import annotations

import math
import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from engine.errors import OptionError

T = TypeVar("T")
R = TypeVar("R")
_WORKER = "scenematch-worker"
_chosen: list[int] = []  # empty, or the number that was chosen, for the whole process as torch's is


def set_threads(count: int) -> None:
    """Set the number of threads of torch, OpenCV and NumPy's BLAS, before or after a matcher is made.

    Without it, and without ``OMP_NUM_THREADS``, the first matcher sets one: if other work shares the processor,
    several threads wait for each other, and frames come late.

    Raises:
        OptionError: ``count`` is below 1.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    if count < 1:
        raise OptionError(f"threads: expected 1 or more, got {count}")
    _chosen[:] = [count]
    cv2.setNumThreads(count)
    threadpool_limits(count, "blas")
    if "torch" in sys.modules:
        limit_torch(sys.modules["torch"])


def limit_torch(torch: Any) -> None:
    """Give torch the chosen number of threads, if any."""
    if _chosen:
        torch.set_num_threads(_chosen[0])


def default_threads() -> None:
    """One thread, unless :func:`set_threads` or ``OMP_NUM_THREADS`` chose otherwise."""
    if not _chosen and "OMP_NUM_THREADS" not in os.environ:
        set_threads(1)


def count() -> int:
    """The number of threads: as chosen, else torch's if loaded, else one per core."""
    if _chosen:
        return _chosen[0]
    if "torch" in sys.modules:
        return int(sys.modules["torch"].get_num_threads())
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return int(asked) if asked.isdecimal() and int(asked) else os.cpu_count() or 1


def parts(size: int, max_count: int) -> list[tuple[int, int]]:
    """Divide a range of ``size`` into at most ``max_count`` parts (begin, end), and at most one per thread."""
    number = max(1, min(max_count, count()))
    return [(size * i // number, size * (i + 1) // number) for i in range(number)]


def in_parallel(work: Callable[[T], R], pieces: Sequence[T]) -> list[R]:
    """Return the results of a function on each piece, computed by as many threads as :func:`count` says.

    It is faster only if the function releases Python's global lock. A call inside a worker runs in that worker,
    so that no worker waits for another.
    """
    helpers = min(count(), len(pieces)) - 1
    if helpers < 1 or threading.current_thread().name.startswith(_WORKER):
        return [work(piece) for piece in pieces]
    left = iter(range(len(pieces)))

    def take() -> dict[int, R]:
        try:
            return {number: work(pieces[number]) for number in left}
        except BaseException:
            for _ in left:  # start nothing more
                pass
            raise

    waiting = [_workers(count()).submit(take) for _ in range(helpers)]
    try:  # the calling thread works, too, and waits for no worker that has not woken before all is taken
        done = take()
    finally:  # no thread still writes when the caller continues
        begun = [worker for worker in waiting if not worker.cancel()]
        wait(begun)
    for worker in begun:
        done |= worker.result()
    return [done[number] for number in range(len(pieces))]


def own_array(use: str, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Memory that the thread keeps from call to call: fresh pages cost as much as a transform.

    Args:
        use: what it is for.
        shape: of the array.
        dtype: of its elements.

    Returns:
        The array, which the thread's next call for this use and type overwrites.
    """
    size, name = math.prod(shape), f"{use} {np.dtype(dtype).char}"
    memory: NDArray[Any] | None = getattr(_own, name, None)
    if memory is None or memory.size < size:
        memory = np.empty(size, dtype)
        setattr(_own, name, memory)
    return memory[:size].reshape(shape)


_own = threading.local()


@lru_cache(maxsize=1)
def _workers(number: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(number, thread_name_prefix=_WORKER)
