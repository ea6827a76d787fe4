"""A published data set that you downloaded, UAV-VisLoc or wildnav, as a flight folder.

    python -m bench.datasets uav-visloc DIR --part 03 --hfov-deg 60 --height-is amsl --ground-m 20 --out FLIGHT
    python -m bench.datasets wildnav DIR --hfov-deg 78 --interval-s 5 --out FLIGHT

Photographs are linked, the map is put together of its pieces, and the flight begins at the first true position.
The authors leave open the field of view, the times of wildnav, and what heights are counted from: a height is left
out unless it is said. UAV-VisLoc's positions are set-points, 24 to 48 m off manual labels on four of its maps.
"""

from __future__ import annotations

import argparse
import csv
import math
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from PIL import Image

from bench.command import new_folder
from engine import Camera
from engine.geo import wrap_heading_deg
from scenematch.files.flight import camera_info
from scenematch.files.geotiff import write_geotiff
from scenematch.files.telemetry import TelemetryRow, write_telemetry
from scenematch.files.truth import truth_from_telemetry, write_truth

Image.MAX_IMAGE_PIXELS = None  # the maps are large


@dataclass(frozen=True)
class Photo:
    """A photograph with its published pose."""

    path: Path
    lat_deg: float
    lon_deg: float
    height_m: float | None
    heading_deg: float | None
    roll_deg: float | None
    pitch_deg: float | None
    timestamp_ns: int | None = None


@dataclass(frozen=True)
class Piece:
    """A picture of a part of the map, with its edges in degrees."""

    path: Path
    left: float
    top: float
    right: float
    bottom: float


def read_uav_visloc(root: Path, part: str) -> tuple[list[Photo], list[Piece]]:
    """NN/NN.csv, NN/drone/*.JPG, NN/satelliteNN.tif or its pieces _RR-CC, placed by the published range."""
    folder = root / part
    photos = [
        Photo(
            folder / "drone" / row["filename"], float(row["lat"]), float(row["lon"]), _number(row, "height"),
            _number(row, "Phi1"), _number(row, "Kappa"), _number(row, "Omega"), _stamp_ns(row["date"]),
        )
        for row in _rows(folder / f"{part}.csv")
    ]  # fmt: skip
    (ranges,) = root.glob("satellite_*coordinates_range.csv")  # with a space in the archive
    edges = next(row for row in _rows(ranges) if row["mapname"] in (f"satellite{part}.tif", f"{part}.tif"))
    top, left, bottom, right = (float(edges[f"{name}_map"]) for name in ("LT_lat", "LT_lon", "RB_lat", "RB_lon"))
    if (whole := folder / f"satellite{part}.tif").is_file():
        return photos, [Piece(whole, left, top, right, bottom)]
    sizes = {tuple(map(int, path.stem.rsplit("_", 1)[1].split("-"))): path
             for path in folder.glob(f"satellite{part}_*-*.tif")}  # fmt: skip
    first_row, first_column = min(sizes)
    columns, rows = (
        np.cumsum([0, *(_size_px(sizes[key])[axis] for key in sorted(sizes) if key[axis] == fixed)])
        for axis, fixed in ((0, first_row), (1, first_column))
    )
    x, y = left + (right - left) * columns / columns[-1], top + (bottom - top) * rows / rows[-1]
    return photos, [
        Piece(path, x[j - first_column], y[i - first_row], x[j - first_column + 1], y[i - first_row + 1])
        for (i, j), path in sizes.items()
    ]


def read_wildnav(root: Path) -> tuple[list[Photo], list[Piece]]:
    """assets/query/photo_metadata.csv with DJI's gimbal angles, assets/map/map.csv; a map's pictures may lack."""
    query, ground = root / "assets" / "query", root / "assets" / "map"
    photos = [
        Photo(
            query / row["Filename"], float(row["Latitude"]), float(row["Longitude"]), _number(row, "Altitude"),
            _number(row, "Gimball_Yaw"), _number(row, "Gimball_Roll"), _number(row, "Gimball_Pitch", 90.0),
        )
        for row in _rows(query / "photo_metadata.csv")
    ]  # fmt: skip
    corners = ("Top_left_lon", "Top_left_lat", "Bottom_right_long", "Bottom_right_lat")
    pieces = [
        Piece(ground / row["Filename"], *(float(row[name]) for name in corners))
        for row in _rows(ground / "map.csv")
    ]
    return photos, [piece for piece in pieces if piece.path.is_file()]


def _size_px(path: Path) -> tuple[int, int]:
    with Image.open(path) as picture:
        return picture.size


def _rows(path: Path) -> Iterator[dict[str, str]]:
    """Rows by column; a fork of wildnav writes its header as one quoted cell."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    lines[0] = lines[0].replace('"', "")
    return csv.DictReader(lines, skipinitialspace=True)


def _number(row: dict[str, str], column: str, plus: float = 0.0) -> float | None:
    text = row.get(column) or "nan"
    return None if math.isnan(float(text)) else float(text) + plus


def _stamp_ns(text: str) -> int:
    time = datetime.fromisoformat(text)
    return round((time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp() * 1e6) * 1000


def write_flight(out: Path, photos: list[Photo], pieces: list[Piece], given: argparse.Namespace) -> int:
    """Write the flight folder; returns how many of the photographs are there."""
    photos = [photo for photo in photos if photo.path.is_file()]
    rows = [_telemetry_row(photo, k, given) for k, photo in enumerate(photos)]
    link_frames(out, [photo.path for photo in photos])
    write_telemetry(out / "telemetry.csv", rows)
    truth = [truth_from_telemetry(row, p.lat_deg, p.lon_deg) for row, p in zip(rows, photos, strict=True)]
    write_truth(out / "truth.csv", truth)
    with Image.open(photos[0].path) as first:
        camera = Camera.from_fov(*first.size, given.hfov_deg)
    (out / "camera.yaml").write_text(camera_info(camera), encoding="utf-8")
    write_map(out / "map.tif", pieces)
    return len(photos)


def link_frames(out: Path, pictures: Iterable[Path]) -> None:
    """Link pictures from a flight folder's frames."""
    (out / "frames").mkdir()
    for picture in pictures:
        (out / "frames" / picture.name).symlink_to(picture.resolve())


def _telemetry_row(photo: Photo, k: int, given: argparse.Namespace) -> TelemetryRow:
    stamp_ns = photo.timestamp_ns if given.interval_s is None else round(1e9 * given.interval_s * k)
    if stamp_ns is None:
        raise SystemExit("interval-s: expected seconds between photographs, since the data set has no times")
    height_m, above_m = photo.height_m, None
    if height_m is not None:
        level_m = 0.0 if given.height_is == "agl" else given.ground_m
        above_m = None if level_m is None or given.height_is is None else height_m - level_m
    return TelemetryRow(
        timestamp_ns=stamp_ns,
        frame=photo.path.name,
        height_agl_m=above_m,
        alt_amsl_m=height_m if given.height_is == "amsl" else None,
        heading_deg=None if photo.heading_deg is None else wrap_heading_deg(photo.heading_deg),
        roll_deg=photo.roll_deg,
        pitch_deg=photo.pitch_deg,
        lat_deg=photo.lat_deg if k == 0 else None,
        lon_deg=photo.lon_deg if k == 0 else None,
    )


def write_map(path: Path, pieces: list[Piece]) -> None:
    """Put the pieces together in EPSG:4326; alpha says where there is none."""
    from rasterio.merge import merge

    with tempfile.TemporaryDirectory(dir=path.parent) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", PendingDeprecationWarning)  # rasterio's own use of affine
        placed = [Path(folder) / f"{k}.tif" for k in range(len(pieces))]
        for piece, target in zip(pieces, placed, strict=True):
            with Image.open(piece.path) as picture:
                pixels = np.asarray(picture.convert("RGBA"))
            height, width = pixels.shape[:2]
            right, down = (piece.right - piece.left) / width, (piece.bottom - piece.top) / height
            first = piece.left + 0.5 * right, piece.top + 0.5 * down  # the middle of the first pixel
            write_geotiff(target, pixels, [[right, 0.0, first[0]], [0.0, down, first[1]]], 4326)
        merge(placed, dst_path=path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=("uav-visloc", "wildnav"))
    parser.add_argument("root", type=Path, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, metavar="FLIGHT")
    parser.add_argument("--part", help="of uav-visloc: the sequence, such as 03")
    parser.add_argument("--hfov-deg", type=float, required=True)
    parser.add_argument("--height-is", choices=("agl", "amsl"))
    parser.add_argument("--ground-m", type=float, help="level of the ground above the sea")
    parser.add_argument("--interval-s", type=float, help="between photographs without times")
    given = parser.parse_args()
    if (given.name == "uav-visloc") != (given.part is not None):
        raise SystemExit(f"part: expected a sequence with uav-visloc only, got {given.part}")
    with new_folder(given.out):
        read = read_wildnav(given.root) if given.part is None else read_uav_visloc(given.root, given.part)
        count = write_flight(given.out, *read, given)
    print(f"{given.out}: {count} of {len(read[0])} photographs")


if __name__ == "__main__":
    main()
