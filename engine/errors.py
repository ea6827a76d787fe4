"""Every error that the engine raises, as one tree.

::

    EngineError
    ├── ShapeError        (ValueError)  an array of the wrong shape
    ├── DtypeError        (TypeError)   an array of the wrong element type
    ├── OptionError       (ValueError)  an option or argument outside its range, or an unknown name
    ├── DeviceError                     a device that was requested but is missing
    ├── MapError                        a map or surface model that cannot be read or placed on the Earth
    ├── CalibrationError                a camera file that cannot be read, or does not fit its frames
    ├── TelemetryError                  telemetry, truth or frames that cannot be read or contradict each other
    ├── StateError        (RuntimeError) a call at the wrong time, such as to something that was closed
    └── BackendError                    something outside the engine that could not do its work
        └── MissingExtraError           a package of an extra that is not installed

A message is one line and names the argument, what was expected and what it got.
A frame that cannot be matched is not an error: the result is :class:`engine.values.NoFix`.
"""

from __future__ import annotations

import importlib
from typing import Any


class EngineError(Exception):
    """Base of every error that the engine raises on purpose."""


class ShapeError(EngineError, ValueError):
    """An array has the wrong shape."""


class DtypeError(EngineError, TypeError):
    """An array has the wrong element type."""


class OptionError(EngineError, ValueError):
    """An option or argument is outside its range, or its name is unknown."""


class DeviceError(EngineError):
    """The requested device is not available."""


class MapError(EngineError):
    """A map or surface model cannot be read or placed on the Earth."""


class CalibrationError(EngineError):
    """A camera description cannot be read, or does not fit the frames."""


class TelemetryError(EngineError):
    """Telemetry, truth or frames cannot be read or contradict each other."""


class StateError(EngineError, RuntimeError):
    """A call came at the wrong time."""


class BackendError(EngineError):
    """Something outside the engine, such as a link, a cluster or a kernel, could not do its work."""


class MissingExtraError(BackendError):
    """A package from an extra of the distribution is not installed."""


def require(module: str, extra: str, package: str | None = None) -> Any:
    """Import an optional module.

    Args:
        module: its full name.
        extra: of the distribution that installs it.
        package: that contains it, if it differs from the module's name before its first dot.

    Returns:
        The module.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        name = package or module.partition(".")[0]
        raise MissingExtraError(
            f"expected {name} to be installed, got none: pip install 'scenematch-engine[{extra}]'"
        ) from None
