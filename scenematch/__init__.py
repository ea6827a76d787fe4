"""The product around the engine, as a library: track flights, compare methods, simulate, bridge to autopilots.

::

    from scenematch import FlightFiles, TrackSettings, track

    files = FlightFiles.in_folder("flight")
    summary = track(files, "out", TrackSettings(method="sift"))

Nothing here prints: a run reports to its :class:`Progress`. Error messages name the argument at fault.
"""

from engine.runtime.lazy_names import imported_on_use

__all__, __getattr__ = imported_on_use(__name__, __file__)


def __dir__() -> list[str]:
    return __all__
