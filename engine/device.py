"""The one device switch: where tensors live, how many threads work, when work is done."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

import torch

from engine.errors import DeviceError, OptionError

T = TypeVar("T")
R = TypeVar("R")
_WORKER = "scenematch-worker"


def resolve(device: str | torch.device = "auto") -> torch.device:
    """Turn the user's wish into a device that is really there.

    Args:
        device: "cpu", "cuda", "cuda:N", a torch.device, or "auto" (CUDA where there is one, else the CPU).

    Raises:
        DeviceError: the device was asked for by name and is missing; only "auto" falls back.
        OptionError: the name is not a device.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        wanted = torch.device(device)
    except RuntimeError:
        raise OptionError(f"device: expected cpu, cuda or auto, got {device!r}") from None
    if wanted.type not in ("cpu", "cuda"):
        raise OptionError(f"device: expected cpu, cuda or auto, got {device!r}")
    if wanted.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (wanted.index or 0) >= count:
            raise DeviceError(f"device: {wanted} was asked for, but this machine offers {count} CUDA devices")
    return wanted


def synchronise(device: torch.device) -> None:
    """Wait until all work queued on ``device`` is done, so that a clock read means something."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def set_threads(count: int) -> None:
    """Let torch and OpenCV use ``count`` threads each.

    Raises:
        OptionError: ``count`` is below 1.
    """
    import cv2

    if count < 1:
        raise OptionError(f"threads: expected 1 or more, got {count}")
    torch.set_num_threads(count)
    cv2.setNumThreads(count)


def parts(size: int, wanted: int) -> list[tuple[int, int]]:
    """Cut a range of ``size`` into at most ``wanted`` parts (begin, end), not more than there are threads."""
    count = max(1, min(wanted, torch.get_num_threads()))
    return [(size * i // count, size * (i + 1) // count) for i in range(count)]


def in_parallel(work: Callable[[T], R], pieces: Sequence[T]) -> list[R]:
    """Return the work done on each piece, by as many threads as torch has.

    It pays where the work lets go of Python's lock. A piece of a piece is worked on where it is met, so that no
    worker waits for another.
    """
    threads = torch.get_num_threads()
    if len(pieces) == 1 or threads == 1 or threading.current_thread().name.startswith(_WORKER):
        return [work(piece) for piece in pieces]
    return list(_workers(threads).map(work, pieces))


@lru_cache(maxsize=1)
def _workers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix=_WORKER)
