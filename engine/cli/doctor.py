"""``doctor``: what this installation is made of, and what is missing."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from typing import Any

import torch

_NEEDED = (
    "torch",
    "kornia",
    "numpy",
    "opencv-python-headless",
    "rasterio",
    "pyproj",
    "pyyaml",
    "pillow",
    "typer",
    "rich",
    "matplotlib",
)


def examine() -> tuple[dict[str, Any], bool]:
    """Facts by name, and whether nothing is missing."""
    facts: dict[str, Any] = {
        "scenematch": _version("scenematch"),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }
    facts |= {name: _version(name) for name in _NEEDED}
    missing = [name for name in _NEEDED if facts[name] is None]
    facts["threads"] = torch.get_num_threads()
    facts["FFT on the CPU"] = "MKL" if torch.backends.mkl.is_available() else "PocketFFT"
    cuda = torch.cuda.is_available()
    build = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "CPU build of torch"
    devices = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    facts["CUDA"] = devices if cuda else f"none ({build})"
    facts["device auto"] = "cuda" if cuda else "cpu"
    facts["missing"] = missing or "nothing"
    return facts, not missing


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
