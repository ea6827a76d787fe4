"""What an installation takes: room on disk, memory, and the time to its first fix, with and without caches.

``PYTHON -m bench.live.footprint``, by the interpreter that is measured; no extra is needed.
"""

from __future__ import annotations

import sysconfig
from importlib import metadata
from pathlib import Path

from bench.live.startup import startup

LARGE_MB = 15.0


def sizes_mb(folder: Path) -> dict[str, float]:
    """Room on disk of each entry of a folder, as ``du`` counts it; links are not followed."""
    return {entry.name: _used_mb(entry) for entry in folder.iterdir()}


def _used_mb(place: Path) -> float:
    inside = place.rglob("*") if place.is_dir() and not place.is_symlink() else ()
    return sum(512.0 * file.lstat().st_blocks for file in (place, *inside)) / 2**20


def main() -> None:
    """Print the sizes and the starts, as Markdown."""
    sizes = sizes_mb(Path(sysconfig.get_path("purelib")))
    print(f"{sum(sizes.values()):.0f} MB in {len(list(metadata.distributions()))} packages, of which:\n")
    print("| folder | MB |\n|---|---|")
    for name, size_mb in sorted(sizes.items(), key=lambda item: -item[1]):
        if size_mb >= LARGE_MB:
            print(f"| {name} | {size_mb:.0f} |")
    print("\n| method | caches | to the first fix s | of it warm-up s | imports s | on a core s | memory MB |")
    print("|---|---|---|---|---|---|---|")
    for row in startup():
        parts = row["parts_s"]
        print(
            f"| {row['method']} | {row['kept']} | {row['total_s']:.2f} | {parts['warm-up']:.2f} "
            f"| {parts['import engine']:.2f} | {row['core_s']:.2f} | {row['resident_mb']:.0f} |"
        )


if __name__ == "__main__":
    main()
