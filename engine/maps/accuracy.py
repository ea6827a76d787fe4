"""How accurate a map is: the standard deviations that its user, or its file's metadata, states.

If neither states one, the assumed errors of :class:`engine.AssumedErrors` hold.
"""

from __future__ import annotations

import math
from typing import Any

from engine.errors import MapError, OptionError
from engine.maps.raster_formats import OWN_TAGS
from engine.maps.rasters import Source
from engine.values import MAX_SIGMA_M

GEOREFERENCE_TAG = "SCENEMATCH_GEOREFERENCE_SIGMA_M"
"""Metadata item of a GeoTIFF: its georeferencing accuracy, one standard deviation in metres per axis."""
SLOPE_TAG = "SCENEMATCH_SLOPE_SIGMA_DEG"
"""Metadata item of a surface model: its slope accuracy, one standard deviation in degrees."""


def stated_sigma(given: float | None, source: Source | None, tag: str) -> float | None:
    """The given accuracy, else the one in a file's metadata, else None.

    Args:
        given: the user's value.
        source: the file with the metadata.
        tag: metadata item; the name of ``given`` in messages follows from it.

    Raises:
        OptionError: ``given`` is not above 0, or larger than any map.
        MapError: the metadata item is not such a number.
    """
    stated: Any = source.dataset.tags().get(tag) if given is None and source is not None else given
    if stated is None:
        return None
    try:
        value = float(stated)
    except ValueError:
        value = math.nan
    if 0.0 < value <= MAX_SIGMA_M:
        return value
    expected = f"expected a number above 0 and at most {MAX_SIGMA_M:g}"
    if given is None and source is not None:
        raise MapError(f"{source.path}: {expected} as {tag}, got {stated!r}")
    raise OptionError(f"{tag.removeprefix(OWN_TAGS).lower()}: {expected}, got {given}")
