"""A flight on the CPU loads no torch: the rule that keeps it so, and flights that show it."""

import ast
from collections.abc import Iterator

import pytest

from tests.support.commands import file_options
from tests.support.interpreters import done_by
from tests.support.paths import ROOT

ENGINE = ROOT / "engine"
FLIGHT = """
import sys, numpy as np
from engine import Budget, Camera, Fix, Navigator, SceneMatcher
from tests.support.ground import Ground
ground, camera = Ground(size=(450, 450)), Camera.from_fov(150, 150, 60.0)
valid = np.ones(ground.size, bool)
valid[:150, :180] = False  # within the windows, so that some are masked
for method in sys.argv[1:]:
    matcher, fixes = SceneMatcher(ground.map_of(valid=valid), camera, method, "cpu"), 0
    navigator = Navigator(matcher, ground.prior((240, 230)))
    for index in range(6):
        nadir = (240 + 4 * index, 230)
        shown, prior = ground.frame(camera, nadir, 75.0, timestamp_ns=index * 10**9), ground.prior(nadir)
        fixes += isinstance(matcher.locate(shown, prior), Fix)
        fixes += isinstance(matcher.locate(shown, prior, Budget(total_ms=60_000)), Fix)
        fixes += isinstance(navigator.update(shown), Fix)
    fixes += isinstance(matcher.locate(shown), Fix)  # of the whole map
    matcher.locate(Ground(seed=6).frame(camera, nadir, 75.0), prior)  # of no place
    print(method, fixes)
"""


def run(program, *words):
    return done_by(program + "\nimport sys; print('TORCH', 'torch' in sys.modules)", *words).stdout.split()


def imported(node: ast.AST) -> Iterator[str]:
    """Modules that this code imports when it runs; those for types alone are not run."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        yield node.module or ""
    elif not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
        for child in ast.iter_child_nodes(node):
            yield from imported(child)


def test_one_module_imports_torch():
    found = {
        str(path.relative_to(ENGINE))
        for path in ENGINE.rglob("*.py")
        if "torch" in path.read_text()  # few are worth parsing
        and any(name.split(".")[0] == "torch" for name in imported(ast.parse(path.read_text())))
    }
    assert found == {"runtime/tensors.py"}


def test_modules_of_the_way_load_no_torch():
    product = "from scenematch.runs import mavlink_bridge, tracking\nfrom scenematch.report import page"
    assert run(f"import engine.navigation.live\n{product}") == ["TORCH", "False"]


def test_a_flight_on_the_cpu_loads_no_torch():
    """By the matcher and by the navigator, with a budget and without, masked, refused, and over the whole map."""
    assert run(FLIGHT, "ncc", "sift", "auto") == ["ncc", "19", "sift", "19", "auto", "19", "TORCH", "False"]


@pytest.mark.slow
def test_tracking_loads_no_torch(flight, tmp_path):
    program = "import sys; from scenematch.cli.app import run; assert run(sys.argv[1:]) == 0"
    words = ["track", *file_options(flight), "--method=auto", "--device=cpu", f"--out={tmp_path / 'out'}"]
    assert run(program, *words)[-2:] == ["TORCH", "False"]
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.slow
def test_torch_takes_the_threads_that_were_chosen_before_it_was_loaded():
    program = (
        "import sys, engine; engine.set_threads(3); assert 'torch' not in sys.modules\n"
        "from engine.runtime.tensors import torch; print(torch.get_num_threads())"
    )
    assert run(program)[0] == "3"
