"""WMTS 1.0.0: the tiles of a level that a server describes, as GDAL reads them."""

from __future__ import annotations

from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit
from xml.etree import ElementTree as Xml

from engine.errors import MapError
from scenematch.fetch.crs import chosen_crs, chosen_name, code_of, crs_of, is_known
from scenematch.fetch.grid import FINE_ENOUGH, Grid, Wanted, gdal_xml, part_of, reason_of
from scenematch.fetch.services import OWN_WORDS, chosen_format, query_value, stated, text_of, with_query
from scenematch.fetch.urls import shown

_HREF = "{http://www.w3.org/1999/xlink}href"


def plan_wmts(root: Xml.Element, url: str, wanted: Wanted) -> Grid:
    """The level of a WMTS that is fine enough, over a place."""
    import rasterio
    from rasterio.errors import RasterioError

    layers = {text_of(layer, "Identifier"): layer for layer in root.iterfind("{*}Contents/{*}Layer")}
    asked = wanted.settings.layer or query_value(url, "layer")
    name = chosen_name("layer", asked, list(layers), "one that the server has")
    sets = _matrix_sets(root, layers[name])
    code, place = chosen_crs(wanted.settings.crs, list(sets), wanted.place), wanted.place
    is_document = url.partition("?")[0].lower().endswith(".xml")
    query = {"SERVICE": "WMTS", "REQUEST": "GetCapabilities"}
    elements: dict[str, Any] = {
        "GetCapabilitiesUrl": url if is_document else with_query(url, query),
        "ExtraQueryParameters": _extra_query(root, url), "Layer": name, "TileMatrixSet": sets[code],
        "Format": chosen_format(wanted.settings.image_format, layers[name].iterfind("{*}Format")),
    }  # fmt: skip
    source, crs = gdal_xml("GDAL_WMTS", elements | wanted.elements()), crs_of(code)
    try:
        with rasterio.open(source) as raster:
            t, sizes = raster.transform, (raster.width, raster.height)
            factors = [1, *raster.overviews(1)]
    except RasterioError as error:
        raise MapError(f"{shown(url)}: cannot be read as a WMTS: {shown(reason_of(error))}") from None
    gsds = [place.gsd_m_per_px((t.a * factor, -t.e * factor), crs) for factor in factors]
    chosen = max((k for k, gsd in enumerate(gsds) if gsd <= wanted.gsd_m_per_px * FINE_ENOUGH), default=0)
    step = t.a * factors[chosen], -t.e * factors[chosen]
    size = sizes[0] // factors[chosen], sizes[1] // factors[chosen]
    overview, states = chosen - 1 if chosen else None, stated(root.find("{*}ServiceIdentification"))
    return part_of("WMTS", code, source, (t.c, t.f), step, place, crs, size, overview=overview, states=states)


def _matrix_sets(root: Xml.Element, layer: Xml.Element) -> dict[str, str]:
    """A layer's first tile matrix set for each known coordinate system."""
    linked = [text_of(link, "TileMatrixSet") for link in layer.iterfind("{*}TileMatrixSetLink")]
    sets: dict[str, str] = {}
    for one in root.iterfind("{*}Contents/{*}TileMatrixSet"):
        code = code_of(text_of(one, "SupportedCRS"))
        if text_of(one, "Identifier") in linked and is_known(code):
            sets.setdefault(code, text_of(one, "Identifier"))
    return sets


def _extra_query(root: Xml.Element, url: str) -> str:
    """Other query parameters of the user's URL, such as a key: sent only to the same host."""
    elements = [*root.iterfind(".//{*}Operation[@name='GetTile']//{*}Get"), *root.iterfind(".//{*}ResourceURL")]
    hosts = {urlsplit(one.get(_HREF) or one.get("template", "")).netloc for one in elements} - {""}
    if not hosts <= {urlsplit(url).netloc}:
        return ""
    return urlencode([pair for pair in parse_qsl(urlsplit(url).query) if pair[0].lower() not in OWN_WORDS])
