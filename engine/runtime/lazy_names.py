"""Import the public names of a package on first use: torch alone takes seconds."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

_IMPORT = re.compile(r"^from (\S+) import (\w+) as \w+$", re.MULTILINE)


def imported_on_use(package: str, file: str) -> tuple[list[str], Callable[[str], Any]]:
    """The public names of a package and its ``__getattr__`` (PEP 562).

    The stub beside the package lists them once, for type checkers and for this.

    Args:
        package: its name.
        file: its ``__init__.py``; each line of the stub is ``from MODULE import NAME as NAME``.
    """
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    modules = {name: module for module, name in _IMPORT.findall(stub)}

    def found(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if modules[name] == package:
            return import_module(f"{package}.{name}")
        return getattr(import_module(modules[name]), name)

    return sorted(modules), found
