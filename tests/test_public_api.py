"""What ``import engine`` gives and does not load; documents use no other name."""

import ast
import importlib
import json
import re

import pytest

import engine
from tests.support.interpreters import done_by
from tests.support.paths import ROOT

MODULES = {
    "scenematch.bridges.mavlink": "pymavlink", "scenematch.bridges.pictures": None, "scenematch.bridges.ros": None,
    "scenematch.bridges.ros1": None, "scenematch.bridges.ros2": None, "scenematch.bridges.vehicle": None,
    "scenematch.files.flight": None, "scenematch.files.telemetry": None, "scenematch.files.track": None,
    "scenematch.files.truth": None, "engine.learned": None, "scenematch": None, "scenematch.simulator": None,
    "scenematch.simulator.loop": None, "scenematch.simulator.pilot": None, "scenematch.simulator.quadrotor": None,
}  # fmt: skip
"""Public modules besides the engine's, whose ``__all__`` counts, and the optional package that each needs."""
PACKAGES = ("engine", "scenematch")
TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "examples").rglob("*.py"))]
UNUSED = (
    "matplotlib", "rasterio", "kornia", "pyproj", "typer", "triton", "numba", "rich", "PIL", "scipy", "skimage",
)  # fmt: skip
WITHOUT_TORCH = (
    "AssumedErrors", "Budget", "Camera", "EngineError", "Fix", "Frame", "LiveOptions", "MatcherOptions",
    "NavigatorOptions", "OrthoMap", "Prior",
)  # fmt: skip


def test_importing_the_engine_prints_nothing_and_its_names_load_what_they_use_alone():
    """In a new interpreter that imports the engine, then uses it."""
    report = (
        "import json, sys, warnings; warnings.simplefilter('error'); import engine; "
        "top = lambda: sorted({name.split('.')[0] for name in sys.modules}); found = {'bare': top()}; "
        f"[getattr(engine, name) for name in {WITHOUT_TORCH}]; found['values'] = top(); "
        "[getattr(engine, name) for name in engine.__all__]; found['loaded'] = top(); import torch; "
        "found['cuda'] = torch.cuda.is_initialized(); "
        "found['modules'] = sorted(n for n in sys.modules if n.startswith(('engine', 'scenematch'))); "
        "import scenematch.runs.tracking, scenematch.runs.closed_loop, scenematch.runs.mavlink_bridge; "
        "found['rerun'] = 'rerun' in sys.modules; print('REPORT', json.dumps(found))"
    )
    done = done_by(report)
    before, _, found = done.stdout.partition("REPORT ")
    assert before + done.stderr == ""
    fresh = json.loads(found)
    assert not {"torch", "cv2", "numpy", *UNUSED}.intersection(fresh["bare"])
    assert "numpy" in fresh["values"]
    assert not {"torch", *UNUSED}.intersection(fresh["values"])
    assert not set(UNUSED).intersection(fresh["loaded"])
    assert not [name for name in fresh["modules"] if name.split(".")[0] == "scenematch"]
    assert (fresh["rerun"], fresh["cuda"]) == (False, False)


def test_there_is_nothing_but_the_public_names():
    assert dir(engine) == engine.__all__
    with pytest.raises(AttributeError, match="'engine' has no attribute 'Matcher'"):
        engine.Matcher  # noqa: B018


def public_module(name):
    """A named public module, skipped where the optional package that it needs is missing."""
    if MODULES[name] is not None:
        pytest.importorskip(MODULES[name])
    return importlib.import_module(name)


@pytest.mark.parametrize("name", sorted(MODULES))
def test_a_public_module_has_what_it_promises(name):
    module = public_module(name)
    assert all(hasattr(module, public) for public in module.__all__)


def engine_imports(path):
    """Module and name of every import of the engine in a Python file or in a page's Python blocks."""
    text = path.read_text(encoding="utf-8")
    blocks = [text] if path.suffix == ".py" else re.findall(r"(?ms)^```python\n(.*?)^```", text)
    for block in blocks:
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
                yield from ((node.module, alias.name) for alias in node.names)
            elif isinstance(node, ast.Import):
                yield from ((alias.name, None) for alias in node.names if alias.name.split(".")[0] in PACKAGES)


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_documents_and_examples_import_public_names_only(path):
    for module, name in engine_imports(path):
        if module == "engine":
            assert name is None or name in engine.__all__, f"{path.name}: engine.{name}"
            continue
        assert module in MODULES, f"{path.name}: {module} is no public module"
        assert name in public_module(module).__all__, f"{path.name}: {module}.{name}"


def test_documents_mention_public_modules_only():
    """A module that a page tells users to call, as in ``engine.set_threads(1)``, is a public one."""
    public = {*MODULES, *(f"engine.{name}" for name in engine.__all__)}
    for path in TEXTS:
        for module in re.findall(r"\b((?:engine|scenematch)(?:\.\w+)+)\.\w+\(", path.read_text(encoding="utf-8")):
            assert module in public or ".".join(module.split(".")[:2]) in public, f"{path.name}: {module}"


def test_the_reference_lists_every_public_name_and_module():
    listed = re.findall(r"^::: (\w+(?:\.\w+)*)$", (ROOT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted([*(f"engine.{name}" for name in engine.__all__), *MODULES])
