"""Map servers as rasters that GDAL opens: tiles by a template, WMS and WMTS, on the grid that suits a place.

GDAL requests the pictures. This module chooses layer, coordinate system and level, from the service's
capabilities.
"""

from __future__ import annotations

from engine.errors import OptionError
from scenematch.fetch.grid import Access, Grid
from scenematch.fetch.place import Wanted
from scenematch.fetch.services import capabilities
from scenematch.fetch.wms import plan_wms
from scenematch.fetch.wmts import plan_wmts
from scenematch.fetch.xyz import is_template, plan_xyz


def plan(url: str, wanted: Wanted, tile_px: int, access: Access) -> Grid:
    """Plan the requests; a service is first asked for its capabilities.

    Raises:
        OptionError: the address or the request is invalid, or there are more pieces than allowed.
        MapError: the server refuses, or is not a supported service.
    """
    if is_template(url):
        grid = plan_xyz(url, wanted, tile_px, access)
    else:
        root = capabilities(url, access.timeout_s)
        service = root.tag.rpartition("}")[2]
        grid = (plan_wmts if service == "Capabilities" else plan_wms)(root, url, wanted, access)
    if grid.tiles > wanted.max_tiles:
        raise OptionError(
            f"max_tiles: expected at most {wanted.max_tiles} tiles, but the area has {grid.tiles}; choose a "
            "smaller `radius_m` or a larger `gsd_m_per_px`, or allow them if the server's terms do"
        )
    return grid
