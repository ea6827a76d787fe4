"""What ``import engine`` gives, what it does not load, and that every public name is described."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys

import pytest

import engine
from tests.support.paths import ROOT

PUBLIC = [
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
UNUSED = (
    "matplotlib",
    "rasterio",
    "kornia",
    "pyproj",
    "typer",
    "triton",
    "numba",
    "rich",
    "PIL",
    "scipy",
    "skimage",
)


@pytest.fixture(scope="module")
def fresh():
    """A new interpreter that imports the engine: what it loaded and what it printed."""
    report = (
        "import json, sys, warnings; warnings.simplefilter('error'); import engine; import torch; "
        "loaded = sorted({name.split('.')[0] for name in sys.modules}); "
        "reach = [callable(engine.ncc_fft.ncc), callable(engine.features.sift)]; "
        "print('REPORT', json.dumps([loaded, reach, torch.cuda.is_initialized(), "
        "sorted(n for n in sys.modules if n.startswith('engine.'))])); "
        "import engine.features, engine.orthomap; "
        "print('LATER', json.dumps([n for n in ('kornia', 'rasterio', 'pyproj') if n in sys.modules])); "
        "import engine.runs.tracking, engine.runs.closed_loop, engine.runs.mavlink_bridge; "
        "print('RUNS', json.dumps('rerun' in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", report], capture_output=True, text=True, cwd=ROOT, check=True)
    before, _, rest = done.stdout.partition("REPORT ")
    rest, _, later = rest.partition("LATER ")
    later, _, rerun = later.partition("RUNS ")
    loaded, reach, cuda, modules = json.loads(rest)
    return {
        "later": json.loads(later),
        "rerun": json.loads(rerun),
        "printed": before + done.stderr,
        "loaded": loaded,
        "reach": reach,
        "cuda": cuda,
        "modules": modules,
    }


def test_importing_the_engine_prints_nothing(fresh):
    assert fresh["printed"] == ""


@pytest.mark.parametrize("package", UNUSED)
def test_importing_the_engine_does_not_load(fresh, package):
    assert package not in fresh["loaded"]


def test_maps_and_features_load_neither_rasters_nor_projections_nor_kornia(fresh):
    assert fresh["later"] == []


def test_nothing_of_rerun_is_loaded_where_nobody_watches(fresh):
    assert fresh["rerun"] is False


def test_importing_the_engine_does_not_touch_the_gpu(fresh):
    assert fresh["cuda"] is False


def test_importing_the_engine_loads_no_upper_floor(fresh):
    floors = ("adapters", "cli", "formats", "report", "sim")
    assert not [name for name in fresh["modules"] if name.split(".")[1] in floors]


def test_functions_on_tensors_are_reached_through_their_modules(fresh):
    assert fresh["reach"] == [True, True]


def test_the_public_names_are_these():
    assert engine.__all__ == PUBLIC


def test_the_public_names_are_sorted_and_there_is_nothing_else():
    assert engine.__all__ == sorted(engine.__all__)
    assert all(hasattr(engine, name) for name in engine.__all__)
    others = {
        name
        for name, value in vars(engine).items()
        if not name.startswith("_") and not inspect.ismodule(value) and name not in engine.__all__
    }
    assert not others


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_described(name):
    value = getattr(engine, name)
    assert inspect.getdoc(value)
    if inspect.isclass(value):
        for member, thing in vars(value).items():
            if not member.startswith("_") and (
                inspect.isfunction(thing) or isinstance(thing, property | classmethod)
            ):
                assert inspect.getdoc(thing), f"{name}.{member}"


@pytest.mark.parametrize("module", ["features", "ncc_fft"])
def test_public_functions_are_described(module):
    for name, value in vars(getattr(engine, module)).items():
        if inspect.isfunction(value) and not name.startswith("_") and value.__module__ == f"engine.{module}":
            assert inspect.getdoc(value), name
