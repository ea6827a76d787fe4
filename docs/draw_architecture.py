"""Draws docs/architecture.md from the code: its floors and imports, and img/architecture.svg.

``python docs/draw_architecture.py`` rewrites both; a test compares them with the code.
"""

from __future__ import annotations

import ast
import re
import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE, PICTURE = ROOT / "docs" / "architecture.md", ROOT / "docs" / "img" / "architecture.svg"
PACKAGES = ("engine", "scenematch")
WIDTH_PX, BOX_PX, GAP_PX, ROW_PX, LETTER_PX = 960, 26, 10, 46, 7.3  # of the picture


def floors(root: Path = ROOT) -> list[list[str]]:
    """Modules and packages of each floor, the top first, as import-linter keeps them."""
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    layers = next(contract["layers"] for contract in settings["contracts"] if contract["type"] == "layers")
    return [[part.strip() for part in re.split(r"[|:]", layer)] for layer in layers]


def members(root: Path = ROOT) -> dict[str, Path]:
    """The file that says what each module or package at the top of the two packages is, by its dotted name."""
    found = {}
    for package in PACKAGES:
        files = [*(root / package).glob("*.py"), *(root / package).glob("*/__init__.py")]
        found |= {_member(path.relative_to(root)): path for path in files if path.parent.name != path.stem}
    return {name: path for name, path in found.items() if name not in PACKAGES and path.stem != "__main__"}


def _member(path: Path) -> str:
    """The member that a file is, or lies in."""
    parts = path.with_suffix("").parts
    return ".".join(part for part in parts[:2] if part != "__init__")


def first_line(path: Path) -> str:
    """The first sentence of a file's docstring, without its full stop."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    sentence = re.split(r"(?<=[a-z0-9)`])\.(?:\s|$)", " ".join(text.split("\n\n")[0].split()), maxsplit=1)[0]
    return re.sub(r":\w+:`([^`]*)`", r"`\1`", sentence.replace("``", "`")).rstrip(".")


def imports(root: Path = ROOT) -> dict[str, set[str]]:
    """Which members each member imports, wherever in its files."""
    found: dict[str, set[str]] = {name: set() for name in members(root)}
    for path in _files(root):
        member = _member(path.relative_to(root))
        if member in found:
            found[member] |= {name for name in _imported(path) if name in found and name != member}
    return found


def _files(root: Path) -> list[Path]:
    return sorted(path for package in PACKAGES for path in (root / package).rglob("*.py"))


def _imported(path: Path) -> set[str]:
    """Members that a file imports when it runs; what it imports for its types alone is left out."""
    names = set()
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        pending += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module in PACKAGES:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return {".".join(name.split(".")[:2]) for name in names if name.split(".")[0] in PACKAGES}


def direct(graph: dict[str, set[str]]) -> dict[str, list[str]]:
    """The graph without imports that follow from others: those that something a member imports leads to."""
    reached: dict[str, set[str]] = {}
    for name in graph:
        pending, reached[name] = set(graph[name]), set()
        while pending:
            other = pending.pop()
            reached[name].add(other)
            pending |= graph[other] - reached[name]
    return {
        name: sorted(below for below in found if not any(below in reached[other] for other in found - {below}))
        for name, found in graph.items()
    }


def table(root: Path = ROOT) -> str:
    """A row for each module or package, floor by floor."""
    files, below = members(root), direct(imports(root))
    lines = ["| floor | module or package | what | imports |", "|---|---|---|---|"]
    layers = floors(root)
    for number, names in zip(range(len(layers), 0, -1), layers, strict=True):
        for name in sorted(names):
            shown = f"`{name}/`" if files[name].name == "__init__.py" else f"`{name}`"
            imported = ", ".join(other.removeprefix("engine.") for other in below[name])
            lines.append(f"| {number} | {shown} | {first_line(files[name])} | {imported} |")
    return "\n".join(lines)


def picture(root: Path = ROOT) -> str:
    """The floors as bands, with a line for each direct import, as SVG."""
    boxes: dict[str, tuple[float, float]] = {}
    bands, y = [], float(GAP_PX)
    for names in floors(root):
        top = y
        for row in _rows(sorted(names)):
            x = (WIDTH_PX - sum(_width(name) + GAP_PX for name in row) + GAP_PX) / 2
            for name in row:
                boxes[name] = (x, y + (ROW_PX - BOX_PX) / 2)
                x += _width(name) + GAP_PX
            y += ROW_PX
        bands.append(f'<rect class="band" x="4" y="{top:g}" width="{WIDTH_PX - 8}" height="{y - top:g}" rx="6"/>')
        y += GAP_PX
    lines = [_line(boxes, name, other) for name, below in sorted(direct(imports(root)).items()) for other in below]
    style = (
        ".band{fill:#eef2f6}.box{fill:#fff;stroke:#456}path{fill:none;stroke:#27609080;stroke-width:1}"
        "text{font:13px sans-serif;text-anchor:middle;fill:#123}"
    )
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {y:g}"><style>{style}</style>'
    return "\n".join([head, *bands, *lines, *(_box(name, *boxes[name]) for name in sorted(boxes)), "</svg>\n"])


def _rows(names: list[str]) -> list[list[str]]:
    """The boxes of a floor, in as many rows as it takes."""
    rows: list[list[str]] = [[]]
    for name in names:
        if sum(_width(other) + GAP_PX for other in [*rows[-1], name]) > WIDTH_PX - 4 * GAP_PX:
            rows.append([])
        rows[-1].append(name)
    return rows


def _width(name: str) -> int:
    return round(LETTER_PX * len(name) + 18)  # whole: sums of floats differ between Python 3.11 and 3.12


def _line(boxes: dict[str, tuple[float, float]], name: str, other: str) -> str:
    (x, y), (x_below, y_below) = boxes[name], boxes[other]
    x, x_below, y = x + _width(name) / 2, x_below + _width(other) / 2, y + BOX_PX
    middle = (y + y_below) / 2
    return f'<path d="M{x:.1f} {y:g}C{x:.1f} {middle:g} {x_below:.1f} {middle:g} {x_below:.1f} {y_below:g}"/>'


def _box(name: str, x: float, y: float) -> str:
    place = f'x="{x:.1f}" y="{y:g}" width="{_width(name):g}" height="{BOX_PX}" rx="4"'
    text = f'x="{x + _width(name) / 2:.1f}" y="{y + BOX_PX - 8:g}"'
    return f'<rect class="box" {place}/><text {text}>{escape(name)}</text>'


def drawn(text: str, root: Path = ROOT) -> str:
    """The page with what stands between its markers drawn anew."""
    begin, end = "<!-- drawn: floors -->", "<!-- end: floors -->"
    before, rest = text.split(begin)
    return f"{before}{begin}\n\n{table(root)}\n\n{end}{rest.split(end)[1]}"


if __name__ == "__main__":
    PAGE.write_text(drawn(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    PICTURE.write_text(picture(), encoding="utf-8")
