"""The command `doctor`."""

from __future__ import annotations

import os
import platform
import re
from typing import Annotated, Any

import typer

from scenematch.cli import console
from scenematch.cli.options import OUTPUT, flag, with_options

_DISTRIBUTION = "scenematch-engine"  # "scenematch" on PyPI is another project
_DEVELOPERS = ("test", "bench", "docs", "dev")
"""Extras that add nothing to the engine."""
_INSTALL = f"pip install {_DISTRIBUTION}"
_NAME = re.compile(r"[A-Za-z0-9._-]+")
_EXTRA = re.compile(r"""extra == ["']([^"']+)["']""")


_HEAD = """\
# All settings of scenematch with their defaults. To change one, remove the # before its key; a key that stays
# commented follows the default. Use the file as --settings FILE, or a single setting as --settings NAME=VALUE,
# such as --settings input.every=5. Options of a command take precedence.

"""


@with_options
def doctor(settings: Annotated[bool, flag("--settings", OUTPUT)] = False) -> None:
    """Show versions, devices and missing packages.

    --settings prints the file that other commands take as --settings FILE: every setting with unit and default.

    Options:
        settings: Print a settings file with every setting.
    """
    if settings:
        from scenematch.runs.settings import documented_settings

        text = _HEAD + documented_settings()
        if not console.answered_as_json({"settings": text}):
            print(text, end="")
        console.next_step("track --settings FILE --map MAP --frames FRAMES --out out")
        return
    facts, healthy = examine()
    console.facts(facts, title="scenematch doctor")
    console.next_step("demo" if healthy else "doctor", hint="" if healthy else _INSTALL)
    raise typer.Exit(0 if healthy else 1)


def examine() -> tuple[dict[str, Any], bool]:
    """Facts by name, and whether all needed packages are installed."""
    from engine.runtime.tensors import torch

    facts: dict[str, Any] = {
        "scenematch": _version(_DISTRIBUTION),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }
    needed, extras = requirements()
    facts |= {name: _version(name) for name in needed}
    missing = [name for name in needed if facts[name] is None]
    for extra, names in extras.items():
        facts[f"extra [{extra}]"] = ", ".join(f"{name} {_version(name) or 'is not installed'}" for name in names)
    facts["threads"] = torch.get_num_threads()
    facts["FFT on the CPU"] = "MKL" if torch.backends.mkl.is_available() else "PocketFFT"
    cuda = torch.cuda.is_available()
    build = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "CPU build of torch"
    devices = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    facts["CUDA"] = devices if cuda else f"none ({build})"
    facts["device auto"] = "cuda" if cuda else "cpu"
    facts["missing"] = missing or "nothing"
    return facts, not missing


def requirements() -> tuple[list[str], dict[str, list[str]]]:
    """The packages that the engine needs, and those of each extra, read from the installed metadata."""
    from importlib import metadata

    needed: list[str] = []
    extras: dict[str, list[str]] = {}
    for text in metadata.requires(_DISTRIBUTION) or ():
        name, extra = _NAME.match(text), _EXTRA.search(text)
        if name is None:
            continue
        if extra is None:
            needed.append(name[0])
        elif extra[1] not in _DEVELOPERS and name[0] != _DISTRIBUTION:  # an extra may contain another
            extras.setdefault(extra[1], []).append(name[0])
    return needed, extras


def _version(name: str) -> str | None:
    from importlib import metadata

    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
