"""WMS 1.1.1 and 1.3.0: a map that the server draws in pieces on the requested grid."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING
from xml.etree import ElementTree as Xml

from scenematch.fetch.crs import chosen_crs, chosen_name, crs_of
from scenematch.fetch.grid import Grid, Place, Wanted, gdal_xml
from scenematch.fetch.services import OWN_WORDS, chosen_format, query_value, stated, text_of, with_query

if TYPE_CHECKING:
    from pyproj import CRS

_MAX_PX = 1024  # of a piece, if the server allows it


def plan_wms(root: Xml.Element, url: str, wanted: Wanted) -> Grid:
    """A map that the server draws on a grid in pixels of the size asked for."""
    layers = _asked_layers(root, wanted.settings.layer or query_value(url, "layers"))
    place, first_layer = wanted.place, next(iter(layers.values()))
    code = chosen_crs(wanted.settings.crs, _offered_crs(root, first_layer), place)
    crs = crs_of(code)
    corner, step, size = _grid(place, crs, wanted.gsd_m_per_px)
    across, down = (
        _piece_px(side, root.findtext(f".//{{*}}Max{name}"))
        for side, name in zip(size, ("Width", "Height"), strict=True)
    )
    asked_format = wanted.settings.image_format or query_value(url, "format")
    window = {
        "UpperLeftX": corner[0], "UpperLeftY": corner[1], "LowerRightX": corner[0] + size[0] * step[0],
        "LowerRightY": corner[1] - size[1] * step[1], "SizeX": size[0], "SizeY": size[1],
    }  # fmt: skip
    service = _service(root, url, code, ",".join(layers)) | {
        "ImageFormat": (kind := chosen_format(asked_format, root.iterfind(".//{*}GetMap/{*}Format"))),
        "Transparent": "TRUE" if "png" in kind else "FALSE",
    }
    source = gdal_xml(
        "GDAL_WMS",
        {
            'Service name="WMS"': service, "DataWindow": window, "Projection": crs.to_string(),
            "BlockSizeX": across, "BlockSizeY": down, "OverviewCount": 0,
        } | wanted.elements(),
    )  # fmt: skip
    credited = dict.fromkeys(text_of(one, "Title") for one in root.iterfind(".//{*}Attribution"))
    states = stated(root.find("{*}Service")) | ({"Attribution": "; ".join(credited)} if credited else {})
    return Grid(
        kind="WMS", level=code, source=source, size_px=size, tile_px=(across, down), corner=corner, step=step,
        crs=crs, gsd_m_per_px=place.gsd_m_per_px(step, crs), states=states,
    )  # fmt: skip


def _asked_layers(root: Xml.Element, asked: str | None) -> dict[str, Xml.Element]:
    """The layers requested by name, or the only one that has a name.

    Raises:
        OptionError: one does not exist, or there are several and none was requested.
    """
    layers = {name: layer for layer in root.iterfind(".//{*}Layer") if (name := text_of(layer, "Name"))}
    leaves = [name for name, layer in layers.items() if layer.find("{*}Layer") is None]
    names = (asked or chosen_name("layer", None, leaves, "one that the server has")).split(",")
    return {name: layers[chosen_name("layer", name, list(layers), "one that the server has")] for name in names}


def _offered_crs(root: Xml.Element, layer: Xml.Element) -> list[str]:
    """The codes of a layer, including those inherited from its parents."""
    around = [one for one in root.iterfind(".//{*}Layer") if any(inner is layer for inner in one.iter())]
    elements = [e for one in around for tag in ("CRS", "SRS") for e in one.iterfind(f"{{*}}{tag}")]
    return list(dict.fromkeys(code for element in elements for code in (element.text or "").split()))


def _service(root: Xml.Element, url: str, code: str, names: str) -> dict[str, str]:
    """GDAL's request for a map; from 1.3.0 on, axes are in the authority's order."""
    version = root.get("version", "1.3.0")
    new = version.startswith("1.3")
    north_first = new and code.startswith("EPSG:") and crs_of(code).axis_info[0].direction.lower() == "north"
    return {
        "Version": version, "ServerUrl": with_query(url, {}, without=OWN_WORDS).rstrip("?") + "?",
        "CRS" if new else "SRS": code, "Layers": names, "Styles": query_value(url, "styles") or "",
        "BBoxOrder": "yxYX" if north_first else "xyXY",
    }  # fmt: skip


def _grid(
    place: Place, crs: CRS, gsd_m_per_px: float
) -> tuple[tuple[float, float], tuple[float, float], tuple[int, int]]:
    """Corner, step and size of a grid over a place, whose pixels begin at multiples of their size."""
    west, south, east, north = place.bounds(crs)
    metres = place.metres_per_unit(crs)
    step = gsd_m_per_px / metres[0], gsd_m_per_px / metres[1]
    x, y = math.floor(west / step[0]), math.ceil(north / step[1])
    size = math.ceil(east / step[0]) - x, y - math.floor(south / step[1])
    return (x * step[0], y * step[1]), step, size


def _piece_px(side: int, stated: str | None) -> int:
    """Side of a piece, so that all are of about one size."""
    most = min(_MAX_PX, int(stated)) if stated and stated.strip().isdecimal() and int(stated) else _MAX_PX
    return math.ceil(side / math.ceil(side / most))
