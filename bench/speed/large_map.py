"""A flight over a map of 100,000 x 100,000 pixels and over the small map of the same town: memory, time, accuracy.

    python -m bench.speed.large_map [--side 100000] [--folder DIR] [--docs DIR]

Builds a sparse cloud-optimised GeoTIFF with a simulated town in the midst of others, and a surface model of that
size, follows a flight in rounds with `scenematch track` on each, watches each process from outside, and writes
the table of docs/results/large-maps.md. Takes some fifteen minutes; `--folder` keeps what was built.
"""

from __future__ import annotations

import contextlib
import csv
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.command import parser_on_one_thread
from bench.inputs.scenes import mosaic
from bench.live.growth import resident_mb
from bench.pages.text import fill, machine, paragraph, table_of

AT = (0.61234, 0.38765)
"""Where the town lies on the large map, as shares of its side: not in its middle."""
AROUND_PX = 6000
"""Side of the square of other towns around it; the rest of the map is nodata and takes no space."""
TILE_PX = 1024
MINUTES = 4
"""Of the flight, in rounds over the town at five frames a second."""
NODATA = -9999.0
_FACTORS = [2**k for k in range(1, 9)]
_POLL_S = 0.03


@dataclass(frozen=True)
class Run:
    """One `scenematch track`, watched.

    Attributes:
        name: what the map is.
        method: "ncc" or "auto".
        start_s: from the start of the process to the first frame.
        summary: summary.json.
        rss_mb: the most that the process held.
        growth_mb: median of the last third of the frames less that of the first.
        first_ms: of the first frame.
    """

    name: str
    method: str
    start_s: float
    summary: dict[str, Any]
    rss_mb: float
    growth_mb: float
    first_ms: float


# ------------------------------------------------------------------------------------------------- building


def build(folder: Path, side: int) -> None:
    """The flight, the large map and the large surface model; what is there already stays."""
    flight, corner = folder / "flight", [round(side * share) for share in AT]
    if not flight.exists():
        _run("simulate", "--closed-loop", "--minutes", str(MINUTES), "--method", "ncc", "--out", str(flight))
    if not (folder / "map.tif").exists():
        gray = np.maximum(mosaic(AROUND_PX), 1)
        _write_large(folder / "map.tif", flight / "map.tif", side, corner, np.repeat(gray[None], 3, axis=0), 0)
    if not (folder / "dsm.tif").exists():
        level = np.zeros((1, AROUND_PX, AROUND_PX), np.float32)
        _write_large(folder / "dsm.tif", flight / "dsm.tif", side, corner, level, NODATA)
    if not (folder / "tiles").exists():
        _write_tiles(folder / "tiles", folder / "map.tif", side, corner)


def _write_large(path: Path, small: Path, side: int, corner: list[int], around: Any, nodata: float) -> None:
    """A sparse COG with a small raster at a corner (x, y), in the middle of a picture around it."""
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.shutil import copy, delete
    from rasterio.windows import Window

    base = path.with_suffix(".base.tif")
    options = {"GDAL_CACHEMAX": 2**28, "SPARSE_OK_OVERVIEW": "ON", "GDAL_TIFF_OVR_BLOCKSIZE": 512}
    with rasterio.Env(**options), rasterio.open(small) as town:
        profile = {"driver": "GTiff", "width": side, "height": side, "count": town.count, "dtype": town.dtypes[0]}
        profile |= {"tiled": True, "blockxsize": 512, "blockysize": 512, "compress": "deflate", "sparse_ok": True}
        t = town.transform
        moved = rasterio.Affine(t.a, t.b, t.c - corner[0] * t.a, t.d, t.e, t.f - corner[1] * t.e)
        with rasterio.open(
            base, "w", crs=town.crs, transform=moved, nodata=nodata, bigtiff="yes", **profile
        ) as large:
            large.update_tags(**{k: v for k, v in town.tags().items() if k.startswith("SCENEMATCH_")})
            x, y = (
                v + size // 2 - AROUND_PX // 2 for v, size in zip(corner, (town.width, town.height), strict=True)
            )
            large.write(around, window=Window(x, y, AROUND_PX, AROUND_PX))
            data = town.read() if nodata else np.maximum(town.read(), 1)
            large.write(data, window=Window(*corner, town.width, town.height))
        with rasterio.open(base, "r+") as large:
            large.build_overviews(_FACTORS, Resampling.average)
        copy(base, path, driver="COG", SPARSE_OK="YES", COMPRESS="DEFLATE", BIGTIFF="YES", OVERVIEWS="AUTO")
        delete(base)


def _write_tiles(folder: Path, path: Path, side: int, corner: list[int]) -> None:
    """A folder of tiles around the town, and one in two corners of the map, so that it has the same extent."""
    import rasterio
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    folder.mkdir()
    first = [(v - AROUND_PX // 2) // TILE_PX for v in corner]
    count = AROUND_PX // TILE_PX + 2
    places = {(first[0] + i, first[1] + j) for i in range(count) for j in range(count)}
    with rasterio.open(path) as large:
        for column, row in sorted(places | {(0, 0), ((side - 1) // TILE_PX,) * 2}):
            x, y = column * TILE_PX, row * TILE_PX
            part = Window(x, y, min(TILE_PX, side - x), min(TILE_PX, side - y))
            profile = {**large.profile, "driver": "GTiff", "width": part.width, "height": part.height}
            profile |= {"transform": large.window_transform(part), "tiled": True}
            with rasterio.open(folder / f"{row:03d}-{column:03d}.tif", "w", **profile) as tile:
                tile.write(large.read(window=part))
                tile.update_tags(**{k: v for k, v in large.tags().items() if k.startswith("SCENEMATCH_")})
                tile.build_overviews(_FACTORS[:6], Resampling.average)


def _run(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "scenematch", *arguments], check=True, capture_output=True)


# ------------------------------------------------------------------------------------------------- watching


def watch(name: str, site: Path, surface: Path, flight: Path, method: str) -> Run:
    """Run `scenematch track` and look at its memory from outside while it writes its rows."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        command = [sys.executable, "-m", "scenematch", "track", "--method", method, "--device", "cpu"]
        files = {"map": site, "surface": surface, "camera": flight / "camera.yaml", "frames": flight / "frames"}
        files |= {"telemetry": flight / "telemetry.csv", "out": out}
        for option, path in files.items():
            command += [f"--{option}", str(path)]
        begin = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        seen: list[tuple[int, float]] = []  # rows so far, memory
        start_s = None
        while process.poll() is None:
            rows = _rows(out / "track.csv")
            if rows and start_s is None:
                start_s = time.perf_counter() - begin
            with contextlib.suppress(OSError, IndexError):  # it has just ended
                seen.append((rows, resident_mb(process.pid)))
            time.sleep(_POLL_S)
        if process.returncode or start_s is None:
            raise RuntimeError(f"{' '.join(command)}: {process.communicate()[1]}")
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        with (out / "track.csv").open(newline="") as stream:
            first_ms = float(next(csv.DictReader(stream))["latency_ms"])
    count = summary["frames"]
    early, late = (
        [mb for rows, mb in seen if low < rows < high] for low, high in ((0, count / 3), (2 * count / 3, count))
    )
    growth_mb = float(np.median(late) - np.median(early))
    return Run(name, method, start_s, summary, max(mb for _, mb in seen), growth_mb, first_ms)


def _rows(path: Path) -> int:
    """Frames that are in track.csv."""
    return max(0, path.read_bytes().count(b"\n") - 1) if path.exists() else 0


# --------------------------------------------------------------------------------------------------- the page


def section(runs: list[Run], side: int) -> list[str]:
    """What stands between the markers."""
    rows = [
        {
            **run.summary,
            **run.summary["latency_ms"],
            "found": "{fixes} of {frames}".format(**run.summary),
            **asdict(run),
        }
        for run in runs
    ]
    which = (("map", "name", "s"), ("method", "method", "s"), ("fixes", "found", "s"), ("RMS m", "rms_m", ".3f"))
    times = (("p50 ms", "p50", ".1f"), ("p95 ms", "p95", ".1f"), ("max ms", "max", ".0f"))
    first = (("first frame ms", "first_ms", ".0f"), ("to the first frame s", "start_s", ".1f"))
    memory = (("RSS MB", "rss_mb", ".0f"), ("growth MB", "growth_mb", "+.0f"))
    lines = table_of(rows, *which, ("false", "false_fixes", "d"), *times, *first, *memory)
    lines += paragraph(f"Measured on {machine()}, one thread; the large map is {side:,} x {side:,} px.")
    return lines


def main() -> None:
    """Build, fly, and put the table between the page's markers."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--side", type=int, default=100_000)
    parser.add_argument("--folder", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = asked.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        build(folder, asked.side)
        flight = folder / "flight"
        small, town = flight / "map.tif", flight / "dsm.tif"
        ways = [
            ("small", small, town, "ncc"),
            ("large COG", folder / "map.tif", town, "ncc"),
            ("large COG and surface", folder / "map.tif", folder / "dsm.tif", "ncc"),
            ("large folder of tiles", folder / "tiles", town, "ncc"),
            ("small", small, town, "auto"),
            ("large COG and surface", folder / "map.tif", folder / "dsm.tif", "auto"),
        ]
        runs = []
        for name, site, surface, method in ways:
            runs.append(watch(name, site, surface, flight, method))
            print(section(runs[-1:], asked.side)[2])
    fill(asked.docs / "large-maps.md", {"large map": section(runs, asked.side)})


if __name__ == "__main__":
    main()
