"""Devices: images are NumPy arrays on the CPU and torch tensors on a GPU; only a GPU loads torch."""

from __future__ import annotations

import ctypes
import re
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from engine.errors import DeviceError, OptionError

if TYPE_CHECKING:
    from engine.runtime.tensors import torch

AnyArray = NDArray[Any]
Picture: TypeAlias = Any
"""An array on the CPU, a tensor on a GPU; code for what both support, such as slices, is shared."""

_NAME = re.compile(r"(cpu|cuda)(:[0-9]+)?")


class Device(str):
    """The name of a device, as torch takes it: "cpu", "cuda" or "cuda:N"."""

    __slots__ = ()

    @property
    def type(self) -> str:
        """The name without the number."""
        return self.partition(":")[0]


CPU = Device("cpu")


def resolve(device: str | torch.device = "auto") -> Device:
    """The device of a name, if it is available.

    Args:
        device: "cpu", "cuda", "cuda:N", a torch.device, or "auto" (CUDA if available, else the CPU).

    Raises:
        DeviceError: the device was requested by name and is missing; only "auto" falls back.
        OptionError: the name is not a device.
    """
    if device == "auto":
        return Device("cuda") if _cuda_devices() else CPU
    match = _NAME.fullmatch(str(device))
    if match is None:
        raise OptionError(f"device: expected cpu, cuda or auto, got {device!r}")
    if match[1] == "cuda" and int((match[2] or ":0")[1:]) >= _cuda_devices():
        raise DeviceError(f"device: {device} was requested, but this machine has {_cuda_devices()} CUDA devices")
    return Device(match[0])


def _cuda_devices() -> int:
    """Number of torch's devices; 0 without loading torch if there is no driver."""
    if not _may_have_cuda():
        return 0
    from engine.runtime.tensors import torch

    return torch.cuda.device_count() if torch.cuda.is_available() else 0


@cache
def _may_have_cuda() -> bool:
    """Whether there is a CUDA or ROCm driver; without one torch need not be loaded."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return Path("/dev/kfd").exists()
    return True


def device_of(picture: Picture) -> Device | torch.device:
    """The device that an array or a tensor is on."""
    return CPU if isinstance(picture, np.ndarray) else picture.device


def synchronise(device: Device | torch.device) -> None:
    """Wait until all work queued on ``device`` is done, for instance before reading a clock."""
    if device.type == "cuda":
        from engine.runtime.tensors import torch

        torch.cuda.synchronize(device)


def to_device(array: AnyArray, device: Device | torch.device) -> Picture:
    """An array on the device.

    Args:
        array: of any shape.
        device: the device.

    Returns:
        The array itself on the CPU, elsewhere a tensor of its shape and type.
    """
    if device.type == "cpu":
        return array
    from engine.runtime.tensors import torch

    return torch.from_numpy(array).to(device)


def on_host(picture: Picture) -> AnyArray:
    """A picture as an array.

    Args:
        picture: of any shape.

    Returns:
        The picture itself, or a copy from its device.
    """
    return picture if isinstance(picture, np.ndarray) else np.asarray(picture.detach().cpu())


def element_type(picture: Picture) -> str:
    """The name of the element type, such as "float32"."""
    return str(picture.dtype).removeprefix("torch.")


def as_float(picture: Picture, name: str) -> Picture:
    """The picture in float32 or float64."""
    if isinstance(picture, np.ndarray):
        return picture.astype(name, copy=False)
    return picture.double() if name == "float64" else picture.float()


def as_arrays(*pictures: Picture) -> list[Picture]:
    """CPU tensors as arrays in the same memory; tensors on a GPU or with gradients unchanged."""
    if any(not isinstance(v, np.ndarray) and (v.device.type != "cpu" or v.requires_grad) for v in pictures):
        return list(pictures)
    return [v if isinstance(v, np.ndarray) else v.numpy() for v in pictures]


def as_tensor(picture: Picture) -> Picture:
    """A tensor unchanged; an array as a tensor in the same memory."""
    if not isinstance(picture, np.ndarray):
        return picture
    from engine.runtime.tensors import torch

    return torch.from_numpy(np.ascontiguousarray(picture))


def same_kind_as(given: Picture, found: Picture) -> Picture:
    """The result as an array or a tensor, whichever the input was."""
    return on_host(found) if isinstance(given, np.ndarray) else as_tensor(found)
