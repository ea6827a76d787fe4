"""Every error that the engine raises, as one tree.

::

    EngineError
    ├── ShapeError        (ValueError)  an array of the wrong shape
    ├── DtypeError        (TypeError)   an array of the wrong element type
    ├── OptionError       (ValueError)  an option or argument outside its range, or an unknown name
    ├── DeviceError                     a device that was asked for and is not there
    ├── MapError                        a map or surface model that cannot be read or placed on the Earth
    ├── CalibrationError                a camera file that cannot be read, or does not fit its frames
    ├── TelemetryError                  telemetry, truth or frames that cannot be read or contradict each other
    ├── StateError        (RuntimeError) a call at the wrong time, such as to something that was closed
    └── BackendError                    a fast path that could not do its work

A message is one line and names the argument, what was expected and what came.
A frame that cannot be matched is no error: it is the value :class:`engine.values.NoFix`.
"""


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
    """A fast path could not do its work."""
