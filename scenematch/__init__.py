"""The product around the engine, as a library: track flights, compare methods, simulate, bridge to autopilots.

::

    from scenematch import FlightFiles, TrackSettings, track

    files = FlightFiles.in_folder("flight")
    summary = track(files, "out", TrackSettings(method="sift"))

Nothing here prints: a run reports to its :class:`Progress`. Error messages name the argument at fault.
"""

import re
from pathlib import Path

from engine.runtime.lazy_names import imported_on_use

_NAMES: dict[str, str] = {}
"""The public names by module, as the stub has them; a module is imported only when one of its names is used."""

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
for _module, _name in re.findall(r"^from (\S+) import (\w+)", _STUB, re.MULTILINE):
    _NAMES[_module] = f"{_NAMES.get(_module, '')} {_name}"

__all__ = sorted(" ".join(_NAMES.values()).split())
__getattr__ = imported_on_use(__name__, _NAMES)


def __dir__() -> list[str]:
    return __all__
