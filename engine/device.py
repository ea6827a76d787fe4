"""Selection of the device, copies to it and from it, number of threads, and synchronisation.

torch is imported by what uses it: arguments are checked, and live frames queued, without.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from engine.errors import DeviceError, OptionError

if TYPE_CHECKING:
    import torch

T = TypeVar("T")
R = TypeVar("R")
AnyArray = NDArray[Any]
_ALIGNMENT = 16  # bytes; no element is larger
_WORKER = "scenematch-worker"
_chosen = threading.Event()  # whether the number of threads was chosen, for the whole process as torch's is


def resolve(device: str | torch.device = "auto") -> torch.device:
    """The device of a name, if it is available.

    Args:
        device: "cpu", "cuda", "cuda:N", a torch.device, or "auto" (CUDA where there is one, else the CPU).

    Raises:
        DeviceError: the device was requested by name and is missing; only "auto" falls back.
        OptionError: the name is not a device.
    """
    import torch

    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        requested = torch.device(device)
    except RuntimeError:
        raise OptionError(f"device: expected cpu, cuda or auto, got {device!r}") from None
    if requested.type not in ("cpu", "cuda"):
        raise OptionError(f"device: expected cpu, cuda or auto, got {device!r}")
    if requested.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (requested.index or 0) >= count:
            raise DeviceError(f"device: {requested} was asked for, but this machine offers {count} CUDA devices")
    return requested


def synchronise(device: torch.device) -> None:
    """Wait until all work queued on ``device`` is done, for instance before reading a clock."""
    if device.type == "cuda":
        import torch

        torch.cuda.synchronize(device)


def upload(arrays: Sequence[AnyArray], device: torch.device) -> list[torch.Tensor]:
    """Arrays as tensors on a device, in one copy; on the CPU they share memory with the arrays.

    Args:
        arrays: of any shapes and of types that torch has.
        device: of the tensors.

    Returns:
        As many, of the same shapes and types.
    """
    import torch

    tensors = [torch.from_numpy(np.ascontiguousarray(array)) for array in arrays]
    if device.type == "cpu":
        return tensors
    return _unpacked(_packed(tensors).to(device), tensors)


def download(tensors: Sequence[torch.Tensor]) -> list[AnyArray]:
    """Tensors of one device as arrays, in one copy; those of the CPU share memory with the arrays.

    Args:
        tensors: of any shapes.

    Returns:
        As many, of the same shapes and types.
    """
    if all(tensor.device.type == "cpu" for tensor in tensors):
        return [tensor.numpy() for tensor in tensors]
    return [tensor.numpy() for tensor in _unpacked(_packed(tensors).cpu(), tensors)]


def _packed(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
    """The bytes of tensors, each beginning on a multiple of what the largest element needs."""
    import torch

    parts = [tensor.contiguous().view(-1).view(torch.uint8) for tensor in tensors]
    return torch.cat([torch.nn.functional.pad(part, (0, -len(part) % _ALIGNMENT)) for part in parts])


def _unpacked(packed: torch.Tensor, like: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    out, begin = [], 0
    for tensor in like:
        size = tensor.numel() * tensor.element_size()
        out.append(packed[begin : begin + size].view(tensor.dtype).view(tensor.shape))
        begin += size + -size % _ALIGNMENT
    return out


def set_threads(count: int) -> None:
    """Set the number of threads of torch and of OpenCV, before or after a matcher is made.

    Without it, and without ``OMP_NUM_THREADS``, the first matcher sets one: where other work shares the processor,
    several threads wait for each other, and frames come late.

    Raises:
        OptionError: ``count`` is below 1.
    """
    import cv2
    import torch

    if count < 1:
        raise OptionError(f"threads: expected 1 or more, got {count}")
    _chosen.set()
    torch.set_num_threads(count)
    cv2.setNumThreads(count)


def default_threads() -> None:
    """One thread, unless :func:`set_threads` or ``OMP_NUM_THREADS`` chose otherwise."""
    if not _chosen.is_set() and "OMP_NUM_THREADS" not in os.environ:
        set_threads(1)


def parts(size: int, max_count: int) -> list[tuple[int, int]]:
    """Divide a range of ``size`` into at most ``max_count`` parts (begin, end), and at most one per thread."""
    import torch

    count = max(1, min(max_count, torch.get_num_threads()))
    return [(size * i // count, size * (i + 1) // count) for i in range(count)]


def in_parallel(work: Callable[[T], R], pieces: Sequence[T]) -> list[R]:
    """Return the results of a function on each piece, computed by as many threads as torch has.

    It is faster only where the function releases Python's global lock. A call inside a worker runs in that worker,
    so that no worker waits for another.
    """
    import torch

    threads = torch.get_num_threads()
    if len(pieces) == 1 or threads == 1 or threading.current_thread().name.startswith(_WORKER):
        return [work(piece) for piece in pieces]
    return list(_workers(threads).map(work, pieces))


@lru_cache(maxsize=1)
def _workers(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix=_WORKER)
