"""torch with the chosen number of threads, and copies of arrays to and from a device.

Only this module imports torch; modules that work on tensors import it from here, at the top. Loading torch takes
seconds and 180 MB, and on the CPU NCC and SIFT work on NumPy arrays: their modules import tensor code only if they
have a tensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from engine.runtime import threads

__all__ = ["Tensor", "download", "functional", "nn", "torch", "upload"]

AnyArray = NDArray[Any]
_ALIGNMENT = torch.complex128.itemsize  # no element is larger

threads.limit_torch(torch)


def upload(arrays: Sequence[AnyArray], device: str | torch.device) -> list[Tensor]:
    """Arrays as tensors on a device, in one copy.

    Args:
        arrays: of any shapes and of types that torch has.
        device: of the tensors.

    Returns:
        As many, of the same shapes and types.
    """
    tensors = [torch.from_numpy(np.ascontiguousarray(array)) for array in arrays]
    return _unpacked(_packed(tensors).to(device), tensors)


def download(tensors: Sequence[Tensor]) -> list[AnyArray]:
    """Tensors of one device as arrays, in one copy.

    Args:
        tensors: of any shapes.

    Returns:
        As many, of the same shapes and types.
    """
    return [tensor.numpy() for tensor in _unpacked(_packed(tensors).cpu(), tensors)]


def _packed(tensors: Sequence[Tensor]) -> Tensor:
    """The bytes of tensors, each aligned for the largest element."""
    parts = [tensor.contiguous().view(-1).view(torch.uint8) for tensor in tensors]
    return torch.cat([functional.pad(part, (0, -len(part) % _ALIGNMENT)) for part in parts])


def _unpacked(packed: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    out, begin = [], 0
    for tensor in like:
        size = tensor.numel() * tensor.element_size()
        out.append(packed[begin : begin + size].view(tensor.dtype).view(tensor.shape))
        begin += size + -size % _ALIGNMENT
    return out
