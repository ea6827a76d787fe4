"""scenematch: position fixes from a downward camera and a georeferenced map, where GNSS is gone."""

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
    TelemetryError,
)
from engine.matcher import SceneMatcher
from engine.methods.options import MatcherOptions
from engine.navigator import Navigator, NavigatorOptions, NavigatorState
from engine.orthomap import OrthoMap
from engine.values import Attitude, Fix, Frame, NoFix, Prior, Reason, Timings, Window

__all__ = [
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
    "MapError",
    "MatcherOptions",
    "MissingExtraError",
    "Navigator",
    "NavigatorOptions",
    "NavigatorState",
    "NoFix",
    "OptionError",
    "OrthoMap",
    "Prior",
    "Reason",
    "SceneMatcher",
    "ShapeError",
    "TelemetryError",
    "Timings",
    "Window",
    "features",
    "ncc_fft",
]
