"""The one device switch: where tensors live, how many threads work, when work is done."""

from __future__ import annotations

import torch

from engine.errors import DeviceError, OptionError


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
