"""scenematch: position fixes without GNSS, from a downward camera and a georeferenced map."""

from typing import TYPE_CHECKING

from engine.runtime.lazy_names import imported_on_use

_NAMES = {
    "engine": "features ncc_fft",
    "engine.assumed_errors": "AssumedErrors",
    "engine.budget": "Budget",
    "engine.camera": "Camera",
    "engine.runtime.threads": "set_threads",
    "engine.errors": "BackendError CalibrationError DeviceError DtypeError EngineError MapError MissingExtraError "
    "OptionError ShapeError StateError TelemetryError",
    "engine.navigation.live": "Answer Live LiveOptions",
    "engine.matching.matcher": "SceneMatcher",
    "engine.options": "LearnedOptions MatcherOptions NavigatorOptions NccOptions PoseOptions SiftOptions",
    "engine.navigation.navigator": "Navigator NavigatorState",
    "engine.orthomap": "OrthoMap",
    "engine.runtime.realtime": "Realtime set_realtime",
    "engine.values": "Attitude Fix Frame NoFix Prior Reason Timings Window",
}
"""The public names by module. A module is imported when one of its names is used: torch alone takes seconds."""

__all__ = sorted(" ".join(_NAMES.values()).split())

if TYPE_CHECKING:  # the same names for type checkers; `as` makes them public
    from engine import features as features
    from engine import ncc_fft as ncc_fft
    from engine.assumed_errors import AssumedErrors as AssumedErrors
    from engine.budget import Budget as Budget
    from engine.camera import Camera as Camera
    from engine.errors import BackendError as BackendError
    from engine.errors import CalibrationError as CalibrationError
    from engine.errors import DeviceError as DeviceError
    from engine.errors import DtypeError as DtypeError
    from engine.errors import EngineError as EngineError
    from engine.errors import MapError as MapError
    from engine.errors import MissingExtraError as MissingExtraError
    from engine.errors import OptionError as OptionError
    from engine.errors import ShapeError as ShapeError
    from engine.errors import StateError as StateError
    from engine.errors import TelemetryError as TelemetryError
    from engine.matching.matcher import SceneMatcher as SceneMatcher
    from engine.navigation.live import Answer as Answer
    from engine.navigation.live import Live as Live
    from engine.navigation.live import LiveOptions as LiveOptions
    from engine.navigation.navigator import Navigator as Navigator
    from engine.navigation.navigator import NavigatorState as NavigatorState
    from engine.options import LearnedOptions as LearnedOptions
    from engine.options import MatcherOptions as MatcherOptions
    from engine.options import NavigatorOptions as NavigatorOptions
    from engine.options import NccOptions as NccOptions
    from engine.options import PoseOptions as PoseOptions
    from engine.options import SiftOptions as SiftOptions
    from engine.orthomap import OrthoMap as OrthoMap
    from engine.runtime.realtime import Realtime as Realtime
    from engine.runtime.realtime import set_realtime as set_realtime
    from engine.runtime.threads import set_threads as set_threads
    from engine.values import Attitude as Attitude
    from engine.values import Fix as Fix
    from engine.values import Frame as Frame
    from engine.values import NoFix as NoFix
    from engine.values import Prior as Prior
    from engine.values import Reason as Reason
    from engine.values import Timings as Timings
    from engine.values import Window as Window
else:  # type checkers see the names above and reject others
    __getattr__ = imported_on_use(__name__, _NAMES)


def __dir__() -> list[str]:
    return __all__
