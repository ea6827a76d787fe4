"""Docstrings of public functions that take or return arrays: they say what goes in and what comes out."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ARRAYS = re.compile(
    r"\b(NDArray|ArrayLike|Tensor|(?:Any)?Array|NamedArrays|FloatImage|Image|Mask|Gray|Float32|Heights|Pixels|Pictures)\b"
)
"""Types of numpy and torch, and their names in the engine."""
FOLDERS = (
    "engine", "engine/kernels", "engine/maps", "engine/navigation", "engine/runtime", "engine/sift",
    "scenematch/simulator",
)  # fmt: skip
CALLED = {  # by others; the steps of a method state shapes in a line
    "engine/matching": "agreement align covariance evidence matcher pnp pose",
    "scenematch/check": "availability plan self_match",
}
MODULES = sorted(
    [path for folder in FOLDERS for path in (ROOT / folder).glob("*.py")]
    + [ROOT / folder / f"{name}.py" for folder, names in CALLED.items() for name in names.split()]
)


def public_functions(path: Path) -> list[tuple[str, ast.FunctionDef]]:
    """Functions, and methods that are no properties, by name."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]
    owners = [("", tree.body), *((f"{node.name}.", node.body) for node in classes)]
    return [
        (prefix + node.name, node)
        for prefix, body in owners
        for node in body
        if isinstance(node, ast.FunctionDef)
        and not node.name.startswith("_")
        and not any("property" in ast.unparse(decorator) for decorator in node.decorator_list)
    ]


def missing_sections(function: ast.FunctionDef) -> list[str]:
    """Sections that the docstring of a function lacks, where its signature has arrays."""
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    taken = [one for one in arguments if one.arg not in ("self", "cls")]
    returned = "None" if function.returns is None else ast.unparse(function.returns)
    types = " ".join([*(ast.unparse(one.annotation) for one in taken if one.annotation is not None), returned])
    if not ARRAYS.search(types):
        return []
    sections = ["Args:"] * bool(taken) + ["Returns:"] * (returned != "None")
    return [section for section in sections if section not in (ast.get_docstring(function) or "")]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_array_functions_document_arguments_and_result(path):
    found = {name: missing_sections(function) for name, function in public_functions(path)}
    assert {name: sections for name, sections in found.items() if sections} == {}
