"""scenematch: position fixes from a downward camera and a georeferenced map, where GNSS is gone."""

from engine import features, ncc_fft
from engine.acceptance import PeakRule
from engine.budget import Budget
from engine.camera import Camera
from engine.covariance import AssumedErrors
from engine.device import set_threads
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
from engine.live import Answer, Live, LiveOptions
from engine.matcher import SceneMatcher
from engine.methods.options import LearnedOptions, MatcherOptions, NccOptions, SiftOptions
from engine.navigator import Navigator
from engine.navigator_options import NavigatorOptions
from engine.navigator_state import NavigatorState
from engine.orthomap import OrthoMap
from engine.pose import PoseOptions
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
    "PeakRule",
    "PoseOptions",
    "Prior",
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
    "set_threads",
]
