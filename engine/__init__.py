"""scenematch: position fixes without GNSS, from a downward camera and a georeferenced map."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from engine.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from engine import features, ncc_fft
    from engine.budget import Budget
    from engine.camera import Camera
    from engine.errors import (
        BackendError,
        CalibrationError,
        DeviceError,
        DtypeError,
        EngineError,
        MapError,
        MissingExtraError,
        OptionError,
        ShapeError,
        StateError,
        TelemetryError,
    )
    from engine.matching.matcher import SceneMatcher
    from engine.navigation.live import Answer, Live, LiveOptions
    from engine.navigation.navigator import Navigator
    from engine.navigation.state import NavigatorState
    from engine.options import (
        AssumedErrors,
        LearnedOptions,
        MatcherOptions,
        NavigatorOptions,
        NccOptions,
        PoseOptions,
        SiftOptions,
    )
    from engine.orthomap import OrthoMap
    from engine.runtime.realtime import Realtime, set_realtime
    from engine.runtime.threads import set_threads
    from engine.values import Attitude, Fix, Frame, NoFix, Prior, Reason, Timings, Window

__all__ = [
    "Answer",
    "AssumedErrors",
    "Attitude",
    "BackendError",
    "Budget",
    "CalibrationError",
    "Camera",
    "DeviceError",
    "DtypeError",
    "EngineError",
    "Fix",
    "Frame",
    "LearnedOptions",
    "Live",
    "LiveOptions",
    "MapError",
    "MatcherOptions",
    "MissingExtraError",
    "Navigator",
    "NavigatorOptions",
    "NavigatorState",
    "NccOptions",
    "NoFix",
    "OptionError",
    "OrthoMap",
    "PoseOptions",
    "Prior",
    "Realtime",
    "Reason",
    "SceneMatcher",
    "ShapeError",
    "SiftOptions",
    "StateError",
    "TelemetryError",
    "Timings",
    "Window",
    "features",
    "ncc_fft",
    "set_realtime",
    "set_threads",
]

_NAMES = {
    "engine.budget": "Budget",
    "engine.camera": "Camera",
    "engine.runtime.threads": "set_threads",
    "engine.errors": "BackendError CalibrationError DeviceError DtypeError EngineError MapError MissingExtraError "
    "OptionError ShapeError StateError TelemetryError",
    "engine.navigation.live": "Answer Live LiveOptions",
    "engine.matching.matcher": "SceneMatcher",
    "engine.options": "AssumedErrors LearnedOptions MatcherOptions NavigatorOptions NccOptions "
    "PoseOptions SiftOptions",
    "engine.navigation.navigator": "Navigator",
    "engine.navigation.state": "NavigatorState",
    "engine.orthomap": "OrthoMap",
    "engine.runtime.realtime": "Realtime set_realtime",
    "engine.values": "Attitude Fix Frame NoFix Prior Reason Timings Window",
}
"""The public names by module. A module is imported when one of its names is used: torch alone takes seconds."""

_imported = imported_on_use(__name__, _NAMES)

if not TYPE_CHECKING:  # type checkers see the names above and reject others

    def __getattr__(name: str) -> Any:
        if name in ("features", "ncc_fft"):  # public modules
            return import_module(f"engine.{name}")
        return _imported(name)


def __dir__() -> list[str]:
    return __all__
