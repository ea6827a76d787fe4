"""A map server on loopback: tiles, WMS, WMTS and files by ranges of bytes, drawn by rasterio from a raster.

It shares no code with what asks it. What should go wrong is put into ``trouble``.
"""

import io
import re
import threading
from contextlib import contextmanager
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import rasterio
from PIL import Image
from rasterio.transform import Affine
from rasterio.warp import reproject, transform_bounds

HALF_WORLD_M = 20037508.342789244
WMS_CRS = ("EPSG:32633", "EPSG:31256", "EPSG:3857", "EPSG:4326", "CRS:84")
NORTH_FIRST = ("EPSG:31256", "EPSG:4326")  # by their authority


class MapServer(ThreadingHTTPServer):
    """It keeps what was asked for.

    Args:
        raster: GeoTIFF with red, green and blue that is drawn.
        files: folder of files that ranges may be asked of.
    """

    daemon_threads = True

    def __init__(self, raster: Path, files: Path) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files, self.over = files, threading.Event()
        self.begin(raster)

    def begin(self, raster: Path) -> None:
        """As nobody has asked it yet."""
        self.raster = raster
        self.asked: list[str] = []
        self.agents: set[str] = set()
        self.trouble: list[tuple[str, object]] = []  # part of a path and what happens, once each
        self.wms_version, self.most_px, self.layers, self.kvp = "1.3.0", 200, ("ortho",), False

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    @property
    def tiles(self) -> str:
        """The address of a tile by zoom level, column and row."""
        return f"{self.url}/tiles/{{z}}/{{x}}/{{y}}.png"


@contextmanager
def serving(raster: Path, files: Path):
    """A server in a thread."""
    server = MapServer(raster, files)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.over.set()
        server.shutdown()
        server.server_close()
        thread.join()


def drawn(server: MapServer, crs: str, bounds: tuple[float, ...], width: int, height: int) -> np.ndarray:
    """(H, W, 4) of the raster on another grid, each pixel the nearest one's; transparent outside."""
    west, south, east, north = bounds
    to_crs = Affine((east - west) / width, 0.0, west, 0.0, (south - north) / height, north)
    bands, transform, source_crs = _bands(server.raster)
    out = np.zeros((4, height, width), np.uint8)
    reproject(bands, out, src_transform=transform, src_crs=source_crs, dst_transform=to_crs, dst_crs=crs)
    return np.moveaxis(out, 0, 2)


@cache
def _bands(raster: Path):
    """(4, H, W) of a raster with its mask, its transform and its CRS."""
    with rasterio.open(raster) as source:
        return np.concatenate([source.read([1, 2, 3]), source.dataset_mask()[None]]), source.transform, source.crs


def _tile_bounds(zoom: int, column: int, row: int) -> tuple[float, ...]:
    side = 2.0 * HALF_WORLD_M / 2**zoom
    west, north = column * side - HALF_WORLD_M, HALF_WORLD_M - row * side
    return west, north - side, west + side, north


class _Handler(BaseHTTPRequestHandler):
    server: MapServer

    def log_message(self, *_args) -> None:
        pass

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        self.server.agents.add(self.headers["User-Agent"])
        asked = urlsplit(self.path)
        path, query = asked.path, {name.upper(): value for name, value in parse_qsl(asked.query)}
        for index, (part, what) in enumerate(self.server.trouble):
            if part in self.path:
                del self.server.trouble[index]
                self._misbehave(what)
                return
        if path.startswith("/tiles/"):
            self._tile(*(int(n) for n in re.findall(r"\d+", path)))
        elif path.startswith("/tms/"):
            zoom, column, row = (int(n) for n in re.findall(r"\d+", path))
            self._tile(zoom, column, 2**zoom - 1 - row)
        elif path.startswith("/quadkeys/"):
            digits = path.rpartition("/")[2]
            column, row = (int("".join(str(int(d) >> axis & 1) for d in digits), 2) for axis in (0, 1))
            self._tile(len(digits), column, row)
        elif path.startswith("/wmts"):
            self._wmts(path, query)
        elif path.startswith("/wms"):
            self._wms(query)
        elif path.startswith("/files/"):
            self._file(self.server.files / Path(path).name)
        else:
            self._send(404, b"nothing", "text/plain")

    def do_HEAD(self) -> None:
        self.do_GET()

    def _misbehave(self, what) -> None:
        if what == "break":
            self._send(200, b"\x89PNG only the beginning", "image/png", {"Content-Length": "5000"})
            self.close_connection = True
        elif what == "silence":
            self.server.over.wait()
            self.close_connection = True
        elif isinstance(what, tuple):
            status, headers = what
            self._send(status, b"no", "text/plain", headers)
        else:
            self._send(200, what, "text/html")

    def _send(self, status: int, content: bytes, kind: str, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), **(headers or {})}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _picture(self, pixels: np.ndarray, kind: str = "image/png") -> None:
        file = io.BytesIO()
        if kind == "image/jpeg":
            Image.fromarray(pixels[..., :3]).save(file, "JPEG", quality=95)
        else:
            Image.fromarray(pixels).save(file, "PNG", compress_level=1)
        self._send(200, file.getvalue(), kind)

    def _tile(self, zoom: int, column: int, row: int) -> None:
        self._drawn_tile("EPSG:3857", _tile_bounds(zoom, column, row), 256)

    def _drawn_tile(self, crs: str, bounds: tuple[float, ...], side_px: int) -> None:
        pixels = drawn(self.server, crs, bounds, side_px, side_px)
        if pixels[..., 3].any():
            self._picture(pixels)
        else:
            self._send(404, b"no such tile", "text/plain")

    def _wms(self, query: dict[str, str]) -> None:
        version = self.server.wms_version
        if query.get("REQUEST") == "GetCapabilities":
            self._send(200, wms_capabilities(self.server).encode(), "text/xml")
            return
        code = query["CRS" if version == "1.3.0" else "SRS"]
        bounds = tuple(map(float, query["BBOX"].split(",")))
        if version == "1.3.0" and code in NORTH_FIRST:
            bounds = (bounds[1], bounds[0], bounds[3], bounds[2])
        width, height = int(query["WIDTH"]), int(query["HEIGHT"])
        if query["VERSION"] != version or query["LAYERS"] not in self.server.layers or width > self.server.most_px:
            fault = b"<ServiceExceptionReport><ServiceException>what?</ServiceException></ServiceExceptionReport>"
            self._send(200, fault, "application/vnd.ogc.se_xml")
            return
        crs = "OGC:CRS84" if code == "CRS:84" else code
        self._picture(drawn(self.server, crs, bounds, width, height), query["FORMAT"])

    def _wmts(self, path: str, query: dict[str, str]) -> None:
        if path.endswith(".xml") or query.get("REQUEST") == "GetCapabilities":
            self._send(200, wmts_capabilities(self.server).encode(), "application/xml")
            return
        if self.server.kvp:
            name, row, column = query["TILEMATRIX"], int(query["TILEROW"]), int(query["TILECOL"])
        else:
            name, row, column = path.removesuffix(".png").split("/")[-3:]
            row, column = int(row), int(column)
        step = MATRICES[name]
        west, north = MATRIX_CORNER[0] + column * 100 * step, MATRIX_CORNER[1] - row * 100 * step
        self._drawn_tile("EPSG:31256", (west, north - 100 * step, west + 100 * step, north), 100)

    def _file(self, file: Path) -> None:
        if not file.is_file():
            self._send(404, b"no such key", "application/xml")
            return
        content, span = file.read_bytes(), re.match(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        if span is None:
            self._send(200, content, "image/tiff", {"Accept-Ranges": "bytes"})
            return
        first, last = int(span[1]), min(int(span[2] or len(content)), len(content) - 1)
        headers = {"Content-Range": f"bytes {first}-{last}/{len(content)}", "Accept-Ranges": "bytes"}
        self._send(206, content[first : last + 1], "image/tiff", headers)


def wms_capabilities(server: MapServer) -> str:
    """As the standards have it: the layers inherit the coordinate systems of the one around them."""
    with rasterio.open(server.raster) as source:
        west, south, east, north = transform_bounds(source.crs, "EPSG:4326", *source.bounds)
    layers = "".join(f"<Layer><Name>{name}</Name><Title>{name}</Title></Layer>" for name in server.layers)
    if server.wms_version == "1.3.0":
        name, root = "WMS_Capabilities", 'version="1.3.0" xmlns="http://www.opengis.net/wms"'
        codes = "".join(f"<CRS>{code}</CRS>" for code in WMS_CRS)
        most = f"<MaxWidth>{server.most_px}</MaxWidth><MaxHeight>{server.most_px}</MaxHeight>"
        box = (
            f"<EX_GeographicBoundingBox><westBoundLongitude>{west}</westBoundLongitude><eastBoundLongitude>{east}"
            f"</eastBoundLongitude><southBoundLatitude>{south}</southBoundLatitude><northBoundLatitude>{north}"
            "</northBoundLatitude></EX_GeographicBoundingBox>"
        )
    else:
        name, root, most = "WMT_MS_Capabilities", 'version="1.1.1"', ""
        codes = "".join(f"<SRS>{code}</SRS>" for code in WMS_CRS[:-1])
        box = f'<LatLonBoundingBox minx="{west}" miny="{south}" maxx="{east}" maxy="{north}"/>'
    return f"""<{name} {root}><Service><Name>WMS</Name><Title>The town</Title><Fees>none</Fees>
<AccessConstraints>only for tests</AccessConstraints>{most}</Service>
<Capability><Request><GetMap><Format>image/jpeg</Format><Format>image/png</Format></GetMap></Request>
<Layer><Title>all</Title>{codes}{box}
<Attribution><Title>the town's surveyor</Title></Attribution>{layers}</Layer></Capability></{name}>"""


MATRICES = {"coarse": 2.0, "fine": 0.5, "finest": 0.25}
"""Metres per pixel of the levels of the WMTS, in the national grid, by name."""
MATRIX_CORNER = (-5000.0, 360000.0)  # easting and northing


def wmts_capabilities(server: MapServer) -> str:
    """Of a national grid whose authority gives northings first."""
    matrices = "".join(
        f"<TileMatrix><ows:Identifier>{name}</ows:Identifier><ScaleDenominator>{step / 0.00028}</ScaleDenominator>"
        f"<TopLeftCorner>{MATRIX_CORNER[1]} {MATRIX_CORNER[0]}</TopLeftCorner><TileWidth>100</TileWidth>"
        "<TileHeight>100</TileHeight><MatrixWidth>4000</MatrixWidth><MatrixHeight>4000</MatrixHeight></TileMatrix>"
        for name, step in MATRICES.items()
    )
    template = "/wmts/{Style}/{TileMatrixSet}/{TileMatrix}/{TileRow}/{TileCol}.png"
    address = f'<ResourceURL format="image/png" resourceType="tile" template="{server.url}{template}"/>'
    resource = "" if server.kvp else address
    return f"""<?xml version="1.0"?><Capabilities xmlns="http://www.opengis.net/wmts/1.0"
 xmlns:ows="http://www.opengis.net/ows/1.1" xmlns:xlink="http://www.w3.org/1999/xlink" version="1.0.0">
<ows:ServiceIdentification><ows:Title>Tiles</ows:Title><ows:AccessConstraints>CC BY</ows:AccessConstraints>
</ows:ServiceIdentification><ows:OperationsMetadata>
<ows:Operation name="GetTile"><ows:DCP><ows:HTTP><ows:Get
 xlink:href="{server.url}/wmts?"/></ows:HTTP></ows:DCP></ows:Operation></ows:OperationsMetadata><Contents>
<Layer><ows:Identifier>ortho</ows:Identifier>
<Style isDefault="true"><ows:Identifier>normal</ows:Identifier></Style>
<Format>image/png</Format><TileMatrixSetLink><TileMatrixSet>national</TileMatrixSet></TileMatrixSetLink>{resource}
</Layer><TileMatrixSet><ows:Identifier>national</ows:Identifier>
<ows:SupportedCRS>urn:ogc:def:crs:EPSG::31256</ows:SupportedCRS>{matrices}</TileMatrixSet></Contents></Capabilities>"""
