"""Pieces of a mosaic: fetched into a folder, where an interrupted fetch finds them again, and made one GeoTIFF."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engine.errors import MapError
from scenematch.fetch.client import Answer, Client, shown
from scenematch.fetch.mosaic import Mosaic, Piece
from scenematch.fetch.services import snippet

Pixels = NDArray[np.uint8]

_FORMATS = ("PNG", "JPEG", "WEBP")
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # Pillow's, of eight bits or fewer
_OPAQUE = 128
"""Alpha from which a pixel is valid, as where maps are read."""
_BLOCK_PX = 256


def piece_file(folder: Path, piece: Piece) -> Path:
    """Where a piece is kept: by its address, so that another fetch into the same folder finds what it shares."""
    return folder / f"{hashlib.sha256(piece.url.encode()).hexdigest()[:32]}.piece"


def fetch_pieces(mosaic: Mosaic, client: Client, folder: Path) -> Iterator[bool]:
    """Fetch what is missing in a folder.

    Args:
        mosaic: what is wanted.
        client: that asks for it.
        folder: of the pieces; a piece that the server does not have is an empty file.

    Yields:
        For each piece, in order: whether it had to be fetched.

    Raises:
        MapError: the server refuses, or sends something else. What has been fetched stays.
    """
    for piece in mosaic.pieces:
        file = piece_file(folder, piece)
        if file.is_file():
            yield False
            continue
        answer = client.get(piece.url)
        content = b"" if answer is None else answer.content
        if answer is not None and content:
            _check_picture(answer, mosaic, piece)
        elif not mosaic.gaps:
            raise MapError(f"{shown(piece.url)}: expected a picture, but the server has nothing there (404)")
        part = file.with_suffix(".part")
        part.write_bytes(content)
        os.replace(part, file)
        yield True


def _check_picture(answer: Answer, mosaic: Mosaic, piece: Piece) -> None:
    """Refuse what is no picture of the size that is expected.

    Raises:
        MapError: it is none.
    """
    try:
        pixels = _decoded(answer.content)
    except ValueError:
        what = answer.kind or "no type"
        raise MapError(
            f"{shown(piece.url)}: expected a picture, got {what} that says {snippet(answer.content)}"
            if what.startswith("text/") or "xml" in what or "json" in what
            else f"{shown(piece.url)}: expected a picture of {', '.join(_FORMATS)} with 8 bits, got {what} that "
            "cannot be read as one"
        ) from None
    (width, height), got = mosaic.piece_px, (pixels.shape[1], pixels.shape[0])
    if got != (width, height):
        hint = f"; give `tile_px` {got[0]}" if mosaic.kind == "XYZ" and got[0] == got[1] else ""
        raise MapError(
            f"{shown(piece.url)}: expected a picture of {width} x {height} px, got {got[0]} x {got[1]} px{hint}"
        )


def _decoded(content: bytes) -> Pixels:
    """Red, green, blue and alpha (h, w, 4) of a picture.

    Raises:
        ValueError: it is none, or has more than 8 bits.
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content), formats=_FORMATS) as picture:
            if picture.mode not in _MODES:
                raise ValueError(picture.mode)
            return np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(str(error)) from None


def _pixels(folder: Path, piece: Piece, mosaic: Mosaic) -> Pixels:
    """Red, green, blue and alpha (h, w, 4) of a fetched piece; zeros where the server has none."""
    content = piece_file(folder, piece).read_bytes()
    return _decoded(content) if content else np.zeros((*mosaic.piece_px[::-1], 4), np.uint8)


def write_map(mosaic: Mosaic, folder: Path, out: Path, tags: Mapping[str, object]) -> float:
    """Join the pieces of a folder: a tiled, losslessly compressed GeoTIFF with a mask where it has gaps.

    Args:
        mosaic: all of whose pieces are there.
        folder: of the pieces.
        out: the file, replaced in one step.
        tags: metadata items.

    Returns:
        Share of the pixels without data.

    Raises:
        MapError: no pixel has data, or the file cannot be written.
    """
    import rasterio
    from rasterio.errors import RasterioError

    known = sum(int((_pixels(folder, piece, mosaic)[..., 3] >= _OPAQUE).sum()) for piece in mosaic.pieces)
    share = 1.0 - known / (len(mosaic.pieces) * mosaic.piece_px[0] * mosaic.piece_px[1])
    if known == 0:
        raise MapError(
            f"source: the server has no data there on level {mosaic.level!r}, {mosaic.gsd_m_per_px:.3g} m/px; it "
            "may have some with a larger `gsd_m_per_px`"
        )
    part = out.with_name(f"{out.name}.part")
    try:
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(part, "w", **_profile(mosaic)) as file,
        ):
            for piece in mosaic.pieces:
                _write_piece(file, piece, mosaic, _pixels(folder, piece, mosaic), masked=share > 0.0)
            file.update_tags(**{name: str(value) for name, value in tags.items()})
        os.replace(part, out)
    except (RasterioError, OSError) as error:
        part.unlink(missing_ok=True)
        raise MapError(f"{out}: cannot be written: {str(error).splitlines()[0]}") from None
    return share


def _profile(mosaic: Mosaic) -> dict[str, Any]:
    from rasterio.crs import CRS
    from rasterio.transform import Affine

    (x, y), (step_x, step_y), (width, height) = mosaic.corner, mosaic.step, mosaic.size_px
    return {
        "driver": "GTiff",
        "dtype": "uint8",
        "count": 3,
        "width": width,
        "height": height,
        "crs": CRS.from_wkt(mosaic.crs.to_wkt()),
        "transform": Affine(step_x, 0.0, x, 0.0, -step_y, y),
        "photometric": "RGB",
        "tiled": True,
        "blockxsize": _BLOCK_PX,
        "blockysize": _BLOCK_PX,
        "compress": "deflate",
        "predictor": 2,
        "BIGTIFF": "IF_SAFER",
    }


def _write_piece(file: Any, piece: Piece, mosaic: Mosaic, pixels: Pixels, *, masked: bool) -> None:
    from rasterio.windows import Window

    width, height = mosaic.piece_px
    window = Window(piece.column * width, piece.row * height, width, height)
    valid = pixels[..., 3] >= _OPAQUE
    file.write(np.moveaxis(pixels[..., :3] * valid[..., None], 2, 0), window=window)
    if masked:
        file.write_mask(valid.astype(np.uint8) * np.uint8(255), window=window)


@contextmanager
def kept_pieces(folder: Path) -> Iterator[None]:
    """A folder of pieces, which stays for a later fetch where anything is left in it."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        if not any(folder.iterdir()):
            folder.rmdir()


def remove_pieces(folder: Path) -> None:
    """Remove the pieces of a folder."""
    for pattern in ("*.piece", "*.part"):
        for file in folder.glob(pattern):
            file.unlink()
